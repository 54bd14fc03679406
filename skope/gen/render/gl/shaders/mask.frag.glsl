// Where anything is drawn at all.
#version 430
out vec4 out_mask;

void main() { out_mask = vec4(1.0); }
