// Depth only. LEAVES: with the gaps between leaves. MIRRORED: only objects that are on the road.
#version 430
#include "leaves.glsl"
in vec3 v_local;
#ifdef MIRRORED
in vec3 v_world;
#include "plane.glsl"
#endif

void main() {
#ifdef MIRRORED
    if (over_plane(v_world) < 0.25) discard;
#endif
#ifdef LEAVES
    if (leaf_gap(v_local)) discard;
#endif
}
