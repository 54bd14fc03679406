// One triangle over the whole target; v_pixel counts image pixels.
#version 430
uniform vec2 u_size;
uniform vec2 u_jitter;
out vec2 v_pixel;

void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    v_pixel = (corner * 0.5 + 0.5) * u_size + u_jitter;
    gl_Position = vec4(corner, 1.0 - 1e-6, 1.0);
}
