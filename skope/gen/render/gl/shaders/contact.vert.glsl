// Ground around a vehicle, in the map of the open sky.
#version 430
in vec2 in_at;        // position in the map, -1..1
in vec2 in_local;     // position in the vehicle's axes, metres from the middle of its footprint
in vec3 in_size;      // half the vehicle's length, half its width, its height, metres
out vec2 v_local;
flat out vec3 v_size;

void main() {
    v_local = in_local;
    v_size = in_size;
    gl_Position = vec4(in_at, 0.0, 1.0);
}
