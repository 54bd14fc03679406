// Planar depth at the pixel's centre, its exact change per pixel on the triangle shown, and the instance.
#version 430
#include "leaves.glsl"
in float v_depth;
in vec3 v_world;
in vec3 v_local;
flat in int v_material;
uniform float u_id;
out vec4 out_geometry;  // depth, change to the right, change downwards, id

void main() {
    if (v_material == M_LEAVES && leaf_gap(v_local)) discard;
    // Inverse depth is linear in the image on a plane, so its differences are exact wherever they are taken.
    float inverse = 1.0 / v_depth;
    vec2 change = vec2(dFdx(inverse), dFdy(inverse));
    out_geometry = vec4(v_depth, -change * v_depth * v_depth, u_id);
}
