// The camera's output for light from 2^u_low to 2^u_high, one value per column.
#version 430
#include "display.glsl"
in vec2 v_pixel;
uniform vec2 u_size;
uniform float u_low;
uniform float u_high;
out vec4 out_color;

void main() {
    out_color = vec4(display(vec3(exp2(mix(u_low, u_high, (v_pixel.x - 0.5) / (u_size.x - 1.0))))), 1.0);
}
