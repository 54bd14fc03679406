uniform float u_pixels;  // image pixels per pixel of a 1920 pixels wide image
// Offset in pixels of the mirror image at a pixel of wet ground: much larger vertically than horizontally, because ripples
// and grains tilt the mirror. Standing water has little offset.
vec2 blurred(vec2 pixel, int tap, int taps, bool stands) {
    vec3 p = fract(floor(pixel).xyx * vec3(0.1031, 0.1030, 0.0973));  // Hoskins' hash
    p += dot(p, p.yzx + 33.33);
    float noise = fract((p.x + p.y) * p.z);
    float along = (float(tap) + noise) / float(taps) * 2.0 - 1.0, across = fract(noise * 7.31 + float(tap) * 0.618) * 2.0 - 1.0;
    return (stands ? vec2(0.6, 1.5) : vec2(7.0, 64.0 * abs(along))) * vec2(across, along) * u_pixels;
}
