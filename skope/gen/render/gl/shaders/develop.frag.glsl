// The scenery's light before the camera's curve, with haze, exposure and lens shading applied.
#version 430
#include "display.glsl"
in vec2 v_pixel;
uniform sampler2D u_ambient_light;    // scenery's light, by part
uniform sampler2D u_sunlit_light;
uniform sampler2D u_geometry;         // depth, and a mask of hit pixels
uniform mat3 u_camera_from_pixel;
layout(location = 0) out vec4 out_ambient;  // w: albedo
layout(location = 1) out vec4 out_sun;
#ifdef WET
#include "blur.glsl"
#include "plane.glsl"
uniform mat3 u_world_from_camera;
uniform vec3 u_horizon;
uniform sampler2D u_mirrored_light;   // mirror image of the road, blurred
layout(location = 2) out vec4 out_reflected;  // w: share that the road mirrors, negative where water stands
#endif

void main() {
    ivec2 pixel = ivec2(v_pixel);
    vec3 ray = u_camera_from_pixel * vec3(floor(v_pixel) + 0.5, 1.0);
    vec4 geometry = texelFetch(u_geometry, pixel, 0);
    float metres = geometry.a > 0.0 ? geometry.r * length(ray) : 0.0, cosine = 1.0 / length(ray);
    vec4 ambient = texelFetch(u_ambient_light, pixel, 0), sunlit = texelFetch(u_sunlit_light, pixel, 0);
    out_ambient = vec4(exposed(ambient.rgb, metres, cosine), ambient.a);
    // The other part already contains the light of the air.
    vec3 air = exposed(vec3(0.0), metres, cosine);
    out_sun = vec4(exposed(sunlit.rgb, metres, cosine) - air, 1.0);
#ifdef WET
    float share = sunlit.a;
    vec2 size = vec2(textureSize(u_geometry, 0));
    vec3 sum = vec3(0.0);
    for (int i = 0; i < 24; ++i) sum += textureLod(u_mirrored_light, (v_pixel + blurred(v_pixel, i, 24, share < 0.0)) / size, share < 0.0 ? 0.0 : 2.0).rgb;
    // Ground outside the plane mirrors something else: far away, the sky above the horizon.
    float off = abs(over_plane(u_world_from_camera * ray * geometry.r));
    sum = mix(sum, 24.0 * u_horizon, smoothstep(0.25, 1.0, off));
    out_reflected = vec4((exposed(sum / 24.0, metres, cosine) - air) * abs(share), share);
#endif
}
