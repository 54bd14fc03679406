// The sky behind everything.
#version 430
#include "common.glsl"
in vec2 v_pixel;
uniform mat3 u_world_from_camera;
uniform mat3 u_camera_from_pixel;
layout(location = 0) out vec4 out_ambient;
layout(location = 1) out vec4 out_sun;

void main() {
    vec3 ray = u_world_from_camera * (u_camera_from_pixel * vec3(v_pixel, 1.0));
    out_ambient = vec4(sky(normalize(ray)), 0.0);
    out_sun = vec4(0.0);
}
