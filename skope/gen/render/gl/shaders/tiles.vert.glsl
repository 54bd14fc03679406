// Rectangles of the image; v_pixel counts image pixels, the rays are for a depth of one metre.
#version 430
in vec2 in_corner;
uniform vec2 u_size;
uniform mat3 u_world_from_pixel;
uniform mat4 u_sun_map_from;
out vec2 v_pixel;
out vec3 v_ray;
out vec3 v_sun_ray;

void main() {
    v_pixel = in_corner;
    v_ray = u_world_from_pixel * vec3(in_corner, 1.0);
    v_sun_ray = mat3(u_sun_map_from) * v_ray;
    gl_Position = vec4(2.0 * in_corner / u_size - 1.0, 0.0, 1.0);
}
