// Gaps between leaves, the same in colour, depth, ids and shadows: a hash of small cells of the crown.
float leaf_hash(vec3 p) {
    uvec3 q = uvec3(ivec3(floor(p)) + 4096) * uvec3(1597334673u, 3812015801u, 2798796415u);
    uint n = (q.x ^ q.y ^ q.z) * 1597334673u;
    return float(n >> 8) / 16777216.0;
}

bool leaf_gap(vec3 p) {
    return leaf_hash(p * 9.0) * 0.7 + leaf_hash(p * 4.0 + 17.0) * 0.5 > 0.72;
}
