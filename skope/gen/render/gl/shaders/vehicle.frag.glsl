// Colour of a vehicle: paint under a clear coat, glass, rubber, chrome and lamps. Sun and sky light it and are mirrored.
// SOLID: everything except the panes. PANES: only the panes, over what is visible through them. PEEL: a plain image of
// the objects behind the visible vehicle. REFLECTION: its mirror image on wet ground. LAMPS: street lights burn.
// SNOW: there is snow on the ground.
#version 430
#include "common.glsl"
#include "display.glsl"
in vec3 v_world;
in vec3 v_normal;
in vec3 v_scenery_sun_at;
in vec3 v_vehicle_sun_at;
in vec3 v_local;
in float v_open;
flat in int v_material;
uniform vec3 u_paint;
uniform vec3 u_livery;          // second colour: stripe, box, lower half
uniform int u_plate;            // seed of the plates' text
uniform int u_lamps;
uniform float u_dirt;           // dirt on the lower half of the body, 0 to 1
#ifdef SNOW
uniform float u_snow;           // share of level ground that snow covers
#endif
uniform float u_id;
uniform sampler2D u_front;      // depth, slopes, id of the vehicle that the image shows
uniform sampler2D u_mirror;     // octahedral map of the surroundings, for reflections
uniform sampler2DShadow u_scenery_sun_map;
uniform sampler2DShadow u_vehicle_sun_map;
uniform float u_lamp_radiance;  // radiance of lamps, as a multiple of the value by day
#ifdef LAMPS
uniform vec3 u_street_light;    // radiant intensity of a street light
uniform float u_own_lamp;       // radiant intensity of the camera's own lamp
uniform float u_beam;           // irradiance from a headlight nearby
in vec4 v_lamps;
#endif
#ifdef REFLECTION
#include "plane.glsl"
uniform vec3 u_viewer;          // position of the viewer
#endif
out vec4 out_color;

vec3 mirror(vec3 d) {
    vec2 at = d.xy / (abs(d.x) + abs(d.y) + abs(d.z));
    if (d.z < 0.0) at = (1.0 - abs(at.yx)) * vec2(at.x < 0.0 ? -1.0 : 1.0, at.y < 0.0 ? -1.0 : 1.0);
    return textureLod(u_mirror, at * 0.5 + 0.5, 0.0).rgb;
}

// Light from inside a bus through its windows: bright at the top, with seats and some passengers in front of it on each deck.
float lit_inside() {
    float upper = step(2.75, v_local.z), height = v_local.z - 1.95 * upper, row = v_local.x / 0.78, place = fract(row);
    float taken = step(0.45, fract(0.618 * (row - place + float(u_plate) + 3.0 * upper) + 0.3 * step(0.0, v_local.y)));
    vec2 from = vec2(3.2 * (place - 0.5), 2.4 * (height - 1.42));
    float dark = max(0.45 * step(height, 1.5) * step(place, 0.62), 0.8 * taken * step(dot(from, from), 1.0));
    return (0.35 + 0.65 * fract(0.618 * float(u_plate))) * clamp(0.45 * height - 0.15, 0.3, 1.0) * (1.0 - dark);
}

// Emission of a lamp in an image that stays linear light, as a share of its colour in the table below. The table is made
// for images that are viewed. Luminances in cd/m2, 10,000 for a share of 1: tail lamps 1500, brake lamps 6000,
// marker lamps 600, signs 600, displays 1000, a bus's ceiling 2000 and its visible interior 60.
vec3 shining(vec3 color, float share) {
#ifdef LINEAR
    return color * share;
#else
    return color;
#endif
}

vec3 glow(int material, int lamps) {
    if ((lamps & LAMP_LOW_BEAM) != 0) {
        if (material == M_MARKER_WHITE) return shining(vec3(1.3, 1.25, 1.15), 0.05);
        if (material == M_MARKER_AMBER) return shining(vec3(1.2, 0.42, 0.03), 0.05);
        if (material == M_MARKER_RED) return shining(vec3(1.2, 0.04, 0.025), 0.05);
        if (material == M_SIGN_TAXI_RED) return shining(vec3(1.6, 0.05, 0.04), 0.05);
        if (material == M_SIGN_TAXI_GREEN) return shining(vec3(0.08, 1.3, 0.32), 0.05);
        if (material == M_DISPLAY) return shining(vec3(1.1, 0.52, 0.05), 0.1);
        if (material == M_CABIN_LIGHT) return shining(vec3(0.95, 0.95, 0.9), 0.2);
        if (material == M_SEAT_LIT) return shining(vec3(0.06, 0.06, 0.07), 0.05);
        if (material == M_GLASS_LIT) return shining(vec3(0.36, 0.35, 0.31) * lit_inside(), 0.016);
    }
    if (material == M_BRAKE_LIGHT && (lamps & LAMP_BRAKE) != 0) return shining(vec3(1.5, 0.05, 0.03), 0.4);
    if ((material == M_TAILLIGHT || material == M_BRAKE_LIGHT) && (lamps & LAMP_LOW_BEAM) != 0)
        return shining(vec3(0.32, 0.01, 0.007), 0.5);
    if (material == M_INDICATOR_LEFT && (lamps & LAMP_INDICATOR_LEFT) != 0) return shining(vec3(1.5, 0.52, 0.03), 0.5);
    if (material == M_INDICATOR_RIGHT && (lamps & LAMP_INDICATOR_RIGHT) != 0) return shining(vec3(1.5, 0.52, 0.03), 0.5);
    if (material == M_REVERSE_LIGHT && (lamps & LAMP_REVERSE) != 0) return vec3(1.0, 0.98, 0.94);
    if (material == M_HEADLIGHT && (lamps & LAMP_LOW_BEAM) != 0) return vec3(1.6, 1.55, 1.45);
    if (material == M_DAYLIGHT) return vec3(0.55, 0.58, 0.6) * ((lamps & LAMP_LOW_BEAM) != 0 ? 1.0 : 0.3);
    if (material == M_SIGN && (lamps & LAMP_LOW_BEAM) != 0) return shining(vec3(1.2, 0.72, 0.14), 0.05);
    return vec3(0.0);
}

// 1 where a pattern of period 1 is below a share of its period, filtered to the resolution of a pixel.
float stripes(float at, float share) {
    float wide = max(fwidth(at), 1e-4), place = abs(fract(at) - 0.5);
    return mix(1.0 - smoothstep(0.5 * share - 0.5 * wide, 0.5 * share + 0.5 * wide, place), share, clamp(wide - 0.5, 0.0, 1.0));
}

// Bars and meshes of a grille in front of a dark background.
float grille(int material) {
    if (material == M_GRILLE_SLATS) return stripes(v_local.z / 0.042, 0.34);
    if (material == M_GRILLE_BARS) return stripes(v_local.y / 0.038, 0.34);
    vec2 at = vec2(v_local.y + v_local.z, v_local.y - v_local.z) / 0.044;
    return max(stripes(at.x, 0.3), stripes(at.y, 0.3));
}

uint scrambled(uint x) {
    x = (x ^ (x >> 16)) * 0x45d9f3bu;
    x = (x ^ (x >> 16)) * 0x45d9f3bu;
    return x ^ (x >> 16);
}

#include "number_plate.glsl"

// Share of a point of the body that dust and mud cover: more at the bottom, in blotches, most around the wheels.
float dirt_at(vec3 at) {
    float low = 1.0 - smoothstep(0.15, 0.95, at.z);
    float blotch = 0.5 + 0.25 * sin(at.x * 3.1 + at.z * 7.0 + 2.0 * sin(at.x * 1.3)) + 0.25 * sin(at.x * 11.0 - at.z * 5.0 + at.y * 4.0);
    return u_dirt * (0.08 + 0.72 * low * (0.55 + 0.45 * blotch));
}

void main() {
#ifdef REFLECTION
    if (over_plane(v_world) < 0.0) discard;
#endif
#ifdef PEEL
    if (texelFetch(u_front, ivec2(gl_FragCoord.xy), 0).a == u_id) discard;
#endif
    float metres = length(v_world), cosine = 1.0 / (gl_FragCoord.w * metres);
    vec3 n = normalize(v_normal), view = -v_world / metres;
#ifdef REFLECTION
    view = normalize(u_viewer - v_world);
#endif
    // Opposite normals of neighbouring corners cancel out halfway between them.
    if (!(dot(n, n) > 0.5)) n = view;
    if (dot(n, view) < 0.0) n = -n;
    vec4 albedo = albedo_of(v_material);
    vec3 base = v_material == M_PAINT ? u_paint : v_material == M_LIVERY ? u_livery : albedo.rgb;
    if (v_material == M_SEAM) base = 0.3 * u_paint;
#ifndef PANES
    if (v_material >= M_GRILLE_SLATS && v_material <= M_GRILLE_MESH) base = mix(vec3(0.004), vec3(0.09), grille(v_material));
    if (v_material == M_PLATE || v_material == M_PLATE_YELLOW) {
        vec3 text = plate();
        if (text.r >= 0.0) base = text;
    }
#endif
    float dirt = u_dirt == 0.0 ? 0.0 : dirt_at(v_local);
    // Wheels have their own axes; their dirt is even around them.
    if (v_material >= M_TYRE && v_material <= M_DISC) dirt = 0.35 * u_dirt;
    base = mix(base, vec3(0.17, 0.145, 0.115), dirt);
#ifdef SNOW
    // Some vehicles carry snow that fell while they were parked; wind and warmth remove it from hoods first.
    float kept = u_snow * 1.3 * float(scrambled(uint(u_plate)) & 255u) / 255.0 - 0.45 - 0.35 * float(v_local.z < 1.2);
    float flat_enough = smoothstep(0.8, 0.95, n.z) * float(v_material < M_TYRE || v_material > M_DISC);
    float lies = flat_enough * smoothstep(0.0, 0.25, kept + 0.12 * sin(v_local.x * 5.0 + 2.0 * sin(v_local.y * 4.0)));
    base = mix(base, vec3(0.78, 0.80, 0.84), lies);
#else
    const float lies = 0.0;
#endif
    // The interior, visible through the windows.
    if (!gl_FrontFacing) base = vec3(0.03);
#ifdef LAMPS
    // Street light replaces the sun; a part of it arrives from all directions.
    vec3 toward = normalize(v_lamps.xyz + vec3(0.0, 0.0, 1e-5)), direct = u_street_light * length(v_lamps.xyz);
#else
    vec3 toward = u_sun_direction, direct = u_sun;
#endif
    float facing = max(dot(n, toward), 0.0);
    float open = v_open * (0.55 + 0.45 * clamp(n.z * 0.5 + 0.5, 0.0, 1.0));
    vec3 ambient = open * mix(u_ground, u_bounced + 0.65 * u_zenith + 0.35 * u_horizon, clamp(0.5 + 0.5 * n.z, 0.0, 1.0));
#ifdef LAMPS
    ambient += open * (0.10 * direct + vec3(0.2 * u_beam * v_lamps.w + u_own_lamp * max(dot(n, view), 0.0) / (PI * metres * metres)));
#endif
#ifdef PEEL
    // This image is only compared with the image of the vehicle in front: no shadows, no mirror images.
    vec3 color = base * (ambient + direct / PI * facing);
#else
#ifdef LAMPS
    const float sun = 1.0;
#else
    float sun = texture(u_scenery_sun_map, v_scenery_sun_at) * texture(u_vehicle_sun_map, v_vehicle_sun_at);
#endif
    float f0 = 0.04, coat = 0.0, metal = 0.0;
    if (v_material == M_PAINT || v_material == M_LIVERY) coat = 1.0;
    if (v_material >= MATERIAL_COUNT) coat = 0.4;
    if (v_material >= M_GLASS && v_material <= M_GLASS_MIRROR) { coat = 1.0; f0 = 0.08; }
    if (v_material >= M_LAMP_CLEAR && v_material <= M_REVERSE_LIGHT) { coat = 1.0; f0 = 0.06; }
    if (v_material == M_CHROME || v_material == M_RIM) metal = 1.0;
    if (v_material == M_TRIM || v_material == M_GRILLE || v_material == M_BOX) coat = 0.25;

    coat *= (1.0 - dirt) * (1.0 - lies);
    metal *= 1.0 - dirt;
    if (!gl_FrontFacing) coat = metal = 0.0;

    float f = coat * fresnel(dot(n, view), f0);
    vec3 mirrored = mirror(reflect(-view, n)) * open;
    vec3 color = base * (ambient + direct / PI * facing * sun) * (1.0 - metal * 0.8);
    color = mix(color, mirrored, f) + metal * 0.55 * base * mirrored;
    color += (f + metal * base) * ggx(n, view, toward, max(albedo.a, 0.12)) * direct * sun;
    // Reflectors behind red glass return light to its source.
    if (v_material == M_TAILLIGHT || v_material == M_BRAKE_LIGHT) color += base * 0.35 * u_ground;
#ifdef LINEAR
    // Lamps shine forwards; a camera above them receives a part of the light.
    color += glow(v_material, u_lamps) * u_lamp_radiance * mix(0.15, 1.0, pow(max(dot(n, view), 0.0), 6.0));
#else
    color += glow(v_material, u_lamps) * u_lamp_radiance;
#endif
#endif
#if defined(REFLECTION)
    out_color = vec4(exposed(color, metres, cosine), 1.0);
#elif defined(PANES)
    // The reflection of a pane is screen-blended over the light that passes through.
    vec3 light = exposed(mirrored * f + (color - mirrored * f) * 0.4, metres, cosine);
    float through = (v_material == M_GLASS_TINTED ? 0.35 : 0.72) * (1.0 - dot(display(light), vec3(0.3, 0.5, 0.2)));
    out_color = vec4(shown(light), 1.0 - through);
#else
    out_color = vec4(shown(exposed(color, metres, cosine)), 1.0);
#endif
}
