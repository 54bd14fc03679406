// Surroundings for reflections, over all directions in an octahedral map (Cigolle et al. 2014).
#version 430
#include "common.glsl"
in vec2 v_pixel;
uniform vec2 u_size;
out vec4 out_light;

void main() {
    vec2 at = v_pixel / u_size * 2.0 - 1.0;
    vec3 d = vec3(at, 1.0 - abs(at.x) - abs(at.y));
    if (d.z < 0.0) d.xy = (1.0 - abs(d.yx)) * vec2(d.x < 0.0 ? -1.0 : 1.0, d.y < 0.0 ? -1.0 : 1.0);
    out_light = vec4(surroundings(normalize(d)), 1.0);
}
