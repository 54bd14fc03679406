// Planar depth at the pixel's centre, its exact change per pixel on the visible triangle, and the instance.
#version 430
#include "leaves.glsl"
in vec3 v_local;
uniform float u_id;
out vec4 out_geometry;  // depth, change to the right, change downwards, id

void main() {
#ifdef LEAVES
    if (leaf_gap(v_local)) discard;
#endif
    // Inverse depth (1 / w in clip space) is linear in the image on a plane. Its differences are exact wherever they
    // are taken, and it is more accurate than a depth interpolated between distant corners.
    float inverse = gl_FragCoord.w, depth = 1.0 / inverse;
    out_geometry = vec4(depth, -vec2(dFdx(inverse), dFdy(inverse)) * depth * depth, u_id);
}
