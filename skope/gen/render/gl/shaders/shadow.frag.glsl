// Depth only, with the gaps between leaves.
#version 430
#include "leaves.glsl"
in vec3 v_local;
flat in int v_material;

void main() {
    if (v_material == M_LEAVES && leaf_gap(v_local)) discard;
}
