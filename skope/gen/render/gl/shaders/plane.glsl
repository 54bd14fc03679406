uniform vec4 u_plane;  // plane of the road, in world axes relative to the camera: unit normal, distance of the camera

float over_plane(vec3 world) { return dot(u_plane.xyz, world) + u_plane.w; }
