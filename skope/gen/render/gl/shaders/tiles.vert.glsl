// Rectangles of the image; v_pixel counts image pixels.
#version 430
in vec2 in_corner;
uniform vec2 u_size;
out vec2 v_pixel;

void main() {
    v_pixel = in_corner;
    gl_Position = vec4(2.0 * in_corner / u_size - 1.0, 0.0, 1.0);
}
