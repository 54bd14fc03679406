// Irradiance of the road from a vehicle's lamps. Red: from its low beams, which light an area with a sharp near edge, where
// the bumper cuts them off, and the road ahead, farther on the right. Green with WASH: from its rear lamps.
#version 430
in vec2 v_local;   // metres ahead of the bumper (with WASH behind it, negative) and to the left
flat in vec3 v_size;
out vec4 out_light;

#ifdef WASH
void main() {
    float behind = -v_local.x, wide = 1.1 * v_size.y + 0.2 * behind, across = v_local.y / wide;
    out_light = vec4(0.0, v_size.x * smoothstep(0.0, 1.2, behind) * exp(-behind / 3.0 - across * across), 0.0, 0.0);
}
#else
float lamp(vec2 at, float half_apart) {
    float across = at.y - half_apart, right = smoothstep(2.0, -2.0, at.y);
    float wide = 0.7 + 0.17 * at.x;
    return exp(-across * across / (wide * wide)) * smoothstep(0.0, 5.0, at.x) * exp(-at.x / mix(9.0, 13.0, right)) * smoothstep(v_size.x, 0.6 * v_size.x, at.x);
}

float pool(vec2 at) {
    float near = 0.9 * v_size.z, along = smoothstep(near, near + 0.5, at.x) * exp(-max(at.x - near, 0.0) / (2.0 * v_size.z));
    return along * (1.0 - smoothstep(1.1 * v_size.y, 2.0 * v_size.y + 0.08 * at.x, abs(at.y)));
}

void main() {
    float beams = lamp(v_local, 0.75 * v_size.y) + lamp(v_local, -0.75 * v_size.y);
    out_light = vec4(0.55 * beams + 0.45 * pool(v_local), 0.0, 0.0, 0.0);
}
#endif
