// From light to the image: exposure, haze, lens shading, filmic curve, sRGB.

uniform vec3 u_exposure;         // with the white balance
uniform vec3 u_haze;             // radiance of the air
uniform float u_haze_density;    // 1 / m
uniform float u_vignetting;      // share of the light that is lost 45 degrees off the axis

// Far above any exposure, but small enough that a sum of several fits into half precision. An infinite value would become
// NaN when it is weighted with 0, and spread as glare.
const float MOST_LIGHT = 1.5e4;

// `cosine`: cosine of the angle off the axis.
vec3 exposed(vec3 light, float metres, float cosine) {
    float shade = 1.0 - 2.0 * u_vignetting * (1.0 - cosine * cosine);
    // At thin edges, interpolated values may lie outside the range of the corners; light must not become negative.
    return clamp(mix(u_haze, light, exp(-metres * u_haze_density)) * u_exposure * shade, 0.0, MOST_LIGHT);
}

// Narkowicz' fit of the ACES filmic curve, then sRGB's own curve by square roots (error under 0.1 of 255).
vec3 display(vec3 x) {
    x = clamp((x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0);
    vec3 root = sqrt(x);
    vec3 curve = 0.83372982 * root + 0.29813085 * sqrt(root) - 0.05531277 * x - 0.07690884;
    return mix(12.92 * x, curve, step(0.0031308, x));
}

#ifdef LINEAR
// The image stays linear light; the camera's exposures and its curve follow on the processor.
vec3 shown(vec3 light) { return light; }
#else
vec3 shown(vec3 light) { return display(light); }
#endif
