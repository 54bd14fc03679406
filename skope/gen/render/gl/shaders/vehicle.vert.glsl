// Place a vehicle's body, trailer and wheels for their colour. Slowly varying values are computed at the vertices.
#version 430
in vec3 in_position;
in vec3 in_normal;
in float in_material;
in float in_part;
uniform mat4 u_model[PARTS];   // mesh -> camera frame
uniform mat4 u_world[PARTS];   // mesh -> world axes, relative to the camera
uniform mat4 u_project;
uniform mat4 u_scenery_sun_map_from;
uniform mat4 u_vehicle_sun_map_from;
out vec3 v_world;
out vec3 v_normal;
out vec3 v_scenery_sun_at;
out vec3 v_vehicle_sun_at;
out vec3 v_local;
out float v_open;
flat out int v_material;
const int TRAILER = 5;          // part number of the trailer, as in model.py
#ifdef LAMPS
uniform sampler2D u_lamp_vectors;   // vectors of street light on the ground
uniform vec2 u_lamp_vectors_at;     // position of the camera in that map
uniform float u_lamp_vectors_scale; // maps per metre
uniform sampler2D u_beams;          // irradiance of the road from headlights
uniform vec2 u_open_at;
uniform float u_open_scale;
uniform vec4 u_plane;
out vec4 v_lamps;                   // vector of street light; headlights of other vehicles
#endif

void main() {
    int part = int(in_part + 0.5);
    vec4 camera = u_model[part] * vec4(in_position, 1.0);
    v_local = in_position;
    v_world = (u_world[part] * vec4(in_position, 1.0)).xyz;
    v_normal = mat3(u_world[part]) * in_normal;
    vec4 lifted = vec4(v_world + v_normal * 0.05, 1.0);
    v_scenery_sun_at = (u_scenery_sun_map_from * lifted).xyz;
    v_vehicle_sun_at = (u_vehicle_sun_map_from * lifted).xyz;
    // Less sky is visible near the road and under the body.
    float height = part > 0 && part != TRAILER ? 0.3 : in_position.z;
    v_open = clamp(0.35 + 0.65 * height / 0.9, 0.25, 1.0);
    v_material = int(in_material + 0.5);
#ifdef LAMPS
    float over = dot(u_plane.xyz, v_world) + u_plane.w;
    v_lamps.xyz = textureLod(u_lamp_vectors, u_lamp_vectors_at + v_world.xy * u_lamp_vectors_scale, 0.0).xyz;
    v_lamps.w = textureLod(u_beams, u_open_at + v_world.xy * u_open_scale, 0.0).r * (1.0 - smoothstep(0.6, 1.1, over));
#endif
    gl_Position = u_project * camera;
}
