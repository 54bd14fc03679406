// Depth only; of LEAVES with the gaps between them.
#version 430
#include "leaves.glsl"
in vec3 v_local;

void main() {
#ifdef LEAVES
    if (leaf_gap(v_local)) discard;
#endif
}
