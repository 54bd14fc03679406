// Irradiance of the road by a vehicle's low beams: brightest some metres ahead, cut off far ahead, farther on the right.
#version 430
in vec2 v_local;   // metres ahead of the bumper and to the left
flat in vec3 v_size;
out vec4 out_light;

float lamp(vec2 at, float half_apart) {
    float across = at.y - half_apart, right = smoothstep(2.0, -2.0, at.y);
    float wide = 0.7 + 0.17 * at.x;
    return exp(-across * across / (wide * wide)) * smoothstep(0.0, 5.0, at.x) * exp(-at.x / mix(9.0, 13.0, right)) * smoothstep(v_size.x, 0.6 * v_size.x, at.x);
}

void main() { out_light = vec4(lamp(v_local, 0.75 * v_size.y) + lamp(v_local, -0.75 * v_size.y)); }
