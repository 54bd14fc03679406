// Share of the sky that is visible from the road near a vehicle: beside it as beside a wall of its height, under it little.
#version 430
in vec2 v_local;
flat in vec3 v_size;
out vec4 out_open;

const float REACH = CONTACT;

float wall(float away, float height) { return 0.5 - 0.5 * away / sqrt(away * away + height * height); }

void main() {
    const float corner = 0.35;
    vec2 q = abs(v_local) - v_size.xy + corner;
    float away = length(max(q, 0.0)) + min(max(q.x, q.y), 0.0) - corner;
    // Bodies are slanted and end above the road, so they hide less of the sky than a wall.
    float height = 0.75 * v_size.z;
    float hidden = away > 0.0 ? wall(away, height) - wall(REACH, height) : 0.5 - wall(REACH, height) + 0.45 * (1.0 - exp(away * 5.0));
    out_open = vec4(1.0 - max(hidden, 0.0));
}
