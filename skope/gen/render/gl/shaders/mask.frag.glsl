// Mask of all pixels that are drawn.
#version 430
out vec4 out_mask;

void main() { out_mask = vec4(1.0); }
