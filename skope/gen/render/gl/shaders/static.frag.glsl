// One sample of the scenery's light: what it receives from one direction of the sky, one point of the sun's disc and the
// street lights, and sends to the camera. Averaged over many samples with jittered pixels this is anti-aliased, with soft shadows and true
// sky occlusion. LAMPS: street lights burn. WET: wet ground. SNOW: snow on the ground. MIRRORED: mirror image on wet ground.
#version 430
#include "leaves.glsl"
#include "common.glsl"
in vec3 v_world;
in vec3 v_local;
in vec3 v_normal;
flat in int v_material;
uniform mat4 u_sun_map_from;  // world axes, relative to the camera -> shadow map
uniform mat4 u_sky_map_from;
uniform vec3 u_sky_direction;
uniform vec3 u_sky_radiance;
uniform vec3 u_viewer;        // position of the viewer
uniform sampler2DShadow u_sun_map;
uniform sampler2DShadow u_sky_map;
layout(location = 0) out vec4 out_ambient;  // light; w: albedo
layout(location = 1) out vec4 out_sun;      // light; w: share that water mirrors, plus u_standing where water stands

#include "surface.glsl"
#ifdef LAMPS
#include "lamps.glsl"
#endif
#ifdef MIRRORED
#include "plane.glsl"
uniform vec3 u_haze;
uniform float u_haze_density;
#endif

void main() {
#ifdef MIRRORED
    if (over_plane(v_world) < 0.03) discard;
#endif
#ifdef LEAVES
    if (leaf_gap(v_local)) discard;
#endif
    vec3 n = normalize(v_normal), view = normalize(u_viewer - v_world);
    // Opposite normals of neighbouring corners cancel out halfway between them.
    if (!(dot(n, n) > 0.5)) n = view;
    if (dot(n, view) < 0.0) n = -n;
    float gloss;
    vec3 color = albedo(v_world + u_eye, n, gloss);

    vec3 lifted = v_world + n * 0.04;
    float sun = texture(u_sun_map, (u_sun_map_from * vec4(lifted, 1.0)).xyz);
    float open = texture(u_sky_map, (u_sky_map_from * vec4(lifted, 1.0)).xyz);
    float facing = max(dot(n, u_sun_direction), 0.0), up = max(dot(n, u_sky_direction), 0.0);
#ifdef LEAVES
    // Light passes through leaves and comes from all sides.
    facing = 0.35 + 0.4 * facing;
    up = 0.3 + 0.4 * up;
#endif

    // One direction, sampled uniformly over the hemisphere, represents all of it.
    vec3 light = 2.0 * u_sky_radiance * up * open + u_ground * 0.5 * (1.0 - n.z);
#ifdef LAMPS
    vec3 lamps = lamplight(lifted, n) / PI;
#ifdef GROUND
    if (between(M_MEADOW, M_GRASS)) lamps *= GRASS_SHARE;
#endif
    light += lamps;
#endif
    vec3 mirrored = reflect(-view, n);
    float f = gloss * fresnel(dot(n, view), 0.06), water = 0.0;
    vec3 sun_glint = vec3(0.0);
#if defined(GROUND) && defined(WET)
    vec2 film = water_on(v_world + u_eye, n);  // wetness, and whether water stands
    color *= mix(1.0, v_material == M_MARKING ? 0.8 : 0.52, film.x);
    water = fresnel(dot(n, view), 0.045) * mix(0.9, 1.0, film.y) * film.x;
    sun_glint = water * ggx(n, view, u_sun_direction, mix(0.32, 0.12, film.y)) * u_sun * sun;
    f = 0.0;
#endif
    out_ambient = vec4(color * light * (1.0 - f - water) + f * surroundings(mirrored), dot(color, vec3(0.2126, 0.7152, 0.0722)));
    out_sun.rgb = (color / PI * facing * (1.0 - f - water) + gloss * f * 2.0 * pow(max(dot(mirrored, u_sun_direction), 0.0), 400.0)) * u_sun * sun + sun_glint;
    out_sun.a = water;
#if defined(GROUND) && defined(WET)
    // The offset can be separated from the mean of the samples; a negative sign would cancel out if samples differ.
    if (film.y > 0.5) out_sun.a += u_standing;
#endif
#ifdef LAMPS
    out_ambient.rgb += emission(v_world + u_eye, n);
#endif
#ifdef MIRRORED
    float clear = exp(-u_haze_density * length(u_viewer - v_world));
    out_ambient.rgb = mix(u_haze, out_ambient.rgb, clear);
    out_sun.rgb *= clear;
#endif
}
