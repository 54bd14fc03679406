// Leaves, identical in colour, depth, ids and shadows: one in each cell of two grids that fill space.
uint leaf_bits(vec3 p) {
    uvec3 q = uvec3(ivec3(floor(p)) + 4096) * uvec3(1597334673u, 3812015801u, 2798796415u);
    uint n = (q.x ^ q.y ^ q.z) * 1597334673u;
    return n ^ (n >> 15);
}

// Return whether a point is outside its cell's leaf, an ellipsoid with a random position and direction.
bool beside_leaf(vec3 p) {
    uint n = leaf_bits(p);
    vec3 random = vec3(n & 1023u, (n >> 10) & 1023u, (n >> 20) & 1023u) / 1023.0 - 0.5;
    vec3 from = fract(p) - 0.5 - 0.3 * random;
    float along = dot(from, normalize(random.zxy + 0.001));
    return dot(from, from) - 0.72 * along * along > 0.075;
}

// The grids are rotated relative to walls, ground and each other, which hides rows of leaves.
vec3 first_grid(vec3 p) { return mat3(0.79, 0.47, -0.39, -0.61, 0.65, -0.45, 0.04, 0.60, 0.80) * p * 7.5; }

vec3 second_grid(vec3 p) { return mat3(0.55, -0.62, 0.56, 0.80, 0.58, -0.15, -0.23, 0.53, 0.82) * p * 9.5; }

bool leaf_gap(vec3 p) { return beside_leaf(first_grid(p)) && beside_leaf(second_grid(p)); }

// One value in 0..1 per leaf.
float leaf_tone(vec3 p) {
    vec3 cell = beside_leaf(first_grid(p)) ? second_grid(p) : first_grid(p);
    return float(leaf_bits(cell) >> 24) / 255.0;
}
