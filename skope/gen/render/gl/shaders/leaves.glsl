// Leaves, the same in colour, depth, ids and shadows: one in each cell of two grids that fill space.
uint leaf_bits(vec3 p) {
    uvec3 q = uvec3(ivec3(floor(p)) + 4096) * uvec3(1597334673u, 3812015801u, 2798796415u);
    uint n = (q.x ^ q.y ^ q.z) * 1597334673u;
    return n ^ (n >> 15);
}

// Whether a point is outside its cell's leaf, an ellipsoid somewhere in the cell, pointing anywhere.
bool beside_leaf(vec3 p) {
    uint n = leaf_bits(p);
    vec3 random = vec3(n & 1023u, (n >> 10) & 1023u, (n >> 20) & 1023u) / 1023.0 - 0.5;
    vec3 from = fract(p) - 0.5 - 0.3 * random;
    float along = dot(from, normalize(random.zxy + 0.001));
    return dot(from, from) - 0.72 * along * along > 0.075;
}

bool leaf_gap(vec3 p) { return beside_leaf(p * 7.5) && beside_leaf(p.yzx * 9.5 + 0.37); }

// 0..1, one value for each leaf.
float leaf_tone(vec3 p) {
    uint n = beside_leaf(p * 7.5) ? leaf_bits(p.yzx * 9.5 + 0.37) : leaf_bits(p * 7.5);
    return float(n >> 24) / 255.0;
}
