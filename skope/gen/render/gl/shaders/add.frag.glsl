// Add a share of two textures to the targets (with additive blending).
#version 430
in vec2 v_pixel;
uniform sampler2D u_a;
uniform sampler2D u_b;
uniform float u_share;
layout(location = 0) out vec4 out_a;
layout(location = 1) out vec4 out_b;

void main() {
    out_a = u_share * texelFetch(u_a, ivec2(v_pixel), 0);
    out_b = u_share * texelFetch(u_b, ivec2(v_pixel), 0);
}
