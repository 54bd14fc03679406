// A vehicle's colour, SCALE x SCALE samples per image pixel: paint under a clear coat, glass, rubber, chrome, lamps; lit by sun and sky, mirroring both.
#version 430
#include "common.glsl"
in float v_depth;
in vec3 v_world;
in vec3 v_local;
in vec3 v_normal;
flat in int v_material;
uniform vec3 u_paint;
uniform int u_lamps;
uniform float u_wheel;          // 1 for a wheel
uniform float u_id;
uniform sampler2D u_front;      // depth, slopes, id of what the image shows; depth 0 where no vehicle is
uniform sampler2D u_background; // depth of the scenery
uniform mat4 u_scenery_sun_map_from;
uniform sampler2DShadow u_scenery_sun_map;
uniform mat4 u_vehicle_sun_map_from;
uniform sampler2DShadow u_vehicle_sun_map;
out vec4 out_color;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy) / SCALE;
    float scenery = texelFetch(u_background, pixel, 0).r;
    if (scenery > 0.0 && v_depth > scenery) discard;
#ifdef PEEL
    if (texelFetch(u_front, pixel, 0).a == u_id) discard;
#endif

    vec3 n = normalize(v_normal), view = normalize(-v_world);
    if (dot(n, view) < 0.0) n = -n;
    vec3 base = v_material == M_PAINT ? u_paint : u_albedo[v_material].rgb;
    float facing = max(dot(n, u_sun_direction), 0.0);
    // Near the road and under the body there is less sky.
    float height = u_wheel > 0.5 ? 0.3 : v_local.z;
    float open = clamp(0.35 + 0.65 * height / 0.9, 0.25, 1.0) * (0.55 + 0.45 * clamp(n.z * 0.5 + 0.5, 0.0, 1.0));
    vec3 ambient = open * mix(u_ground, 0.65 * u_zenith + 0.35 * u_horizon, clamp(0.5 + 0.5 * n.z, 0.0, 1.0));

#ifdef PEEL
    // What stands behind is only held against what stands before it: no shadows, no mirror images.
    out_color = vec4(base * (ambient + u_sun / PI * facing), 1.0);
    return;
#else
    vec3 lifted = v_world + n * 0.05;
    float sun = texture(u_scenery_sun_map, (u_scenery_sun_map_from * vec4(lifted, 1.0)).xyz);
    sun *= texture(u_vehicle_sun_map, (u_vehicle_sun_map_from * vec4(lifted, 1.0)).xyz);
    vec3 mirrored = reflect(-view, n);
    float f0 = 0.04, coat = 0.0, metal = 0.0;
    if (v_material == M_PAINT) coat = 1.0;
    if (v_material == M_GLASS) { coat = 1.0; f0 = 0.08; }
    if (v_material == M_HEADLIGHT || v_material == M_TAILLIGHT) { coat = 1.0; f0 = 0.06; }
    if (v_material == M_CHROME || v_material == M_RIM) metal = 1.0;
    if (v_material == M_TRIM || v_material == M_GRILLE) coat = 0.25;

    float f = fresnel(dot(n, view), f0);
    vec3 color = base * (ambient + u_sun / PI * facing * sun) * (1.0 - metal * 0.8);
    color = mix(color, surroundings(mirrored) * open, coat * f);
    color += metal * base * surroundings(mirrored) * 0.55 * open;
    color += (coat * f + metal * base) * ggx(n, view, u_sun_direction, max(u_albedo[v_material].a, 0.12)) * u_sun * sun;
    if (v_material == M_TAILLIGHT && (u_lamps & LAMP_BRAKE) != 0) color += vec3(1.1, 0.03, 0.02);
    if (v_material == M_HEADLIGHT && (u_lamps & LAMP_LOW_BEAM) != 0) color += vec3(1.6, 1.55, 1.45);
    out_color = vec4(color, 1.0);
#endif
}
