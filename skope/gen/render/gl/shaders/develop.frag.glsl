// Scenery's light as the camera will show it before its curve: haze, exposure and lens shading taken in.
#version 430
#include "display.glsl"
in vec2 v_pixel;
uniform sampler2D u_a;                // scenery's light, by part
uniform sampler2D u_b;
uniform sampler2D u_geometry;         // depth, and where something was hit
uniform mat3 u_camera_from_pixel;
layout(location = 0) out vec4 out_ambient;
layout(location = 1) out vec4 out_sun;

void main() {
    ivec2 pixel = ivec2(v_pixel);
    vec3 ray = u_camera_from_pixel * vec3(floor(v_pixel) + 0.5, 1.0);
    vec4 geometry = texelFetch(u_geometry, pixel, 0);
    float metres = geometry.a > 0.0 ? geometry.r * length(ray) : 0.0, cosine = 1.0 / length(ray);
    out_ambient = vec4(exposed(texelFetch(u_a, pixel, 0).rgb, metres, cosine), 1.0);
    // The air's own light is in the other part already.
    vec3 air = exposed(vec3(0.0), metres, cosine);
    out_sun = vec4(exposed(texelFetch(u_b, pixel, 0).rgb, metres, cosine) - air, 1.0);
}
