// A vehicle's picture: paint under a clear coat, glass, rubber, chrome, lamps; lit by sun and sky, mirroring both.
// SOLID is everything but the panes, PANES those alone, over what is seen through them; PEEL a plain picture of what
// stands behind the vehicle shown.
#version 430
#include "common.glsl"
#include "display.glsl"
in vec3 v_world;
in vec3 v_normal;
in vec3 v_scenery_sun_at;
in vec3 v_vehicle_sun_at;
in float v_open;
flat in int v_material;
uniform vec3 u_paint;
uniform int u_lamps;
uniform float u_id;
uniform sampler2D u_front;      // depth, slopes, id of the vehicle that the image shows
uniform sampler2D u_mirror;     // octahedral map of what a mirror sees
uniform sampler2DShadow u_scenery_sun_map;
uniform sampler2DShadow u_vehicle_sun_map;
out vec4 out_color;

vec3 mirror(vec3 d) {
    vec2 at = d.xy / (abs(d.x) + abs(d.y) + abs(d.z));
    if (d.z < 0.0) at = (1.0 - abs(at.yx)) * vec2(at.x < 0.0 ? -1.0 : 1.0, at.y < 0.0 ? -1.0 : 1.0);
    return textureLod(u_mirror, at * 0.5 + 0.5, 0.0).rgb;
}

vec3 glow(int material, int lamps) {
    if (material == M_BRAKE_LIGHT && (lamps & LAMP_BRAKE) != 0) return vec3(1.5, 0.05, 0.03);
    if ((material == M_TAILLIGHT || material == M_BRAKE_LIGHT) && (lamps & LAMP_LOW_BEAM) != 0)
        return vec3(0.32, 0.01, 0.007);
    if (material == M_INDICATOR_LEFT && (lamps & LAMP_INDICATOR_LEFT) != 0) return vec3(1.5, 0.52, 0.03);
    if (material == M_INDICATOR_RIGHT && (lamps & LAMP_INDICATOR_RIGHT) != 0) return vec3(1.5, 0.52, 0.03);
    if (material == M_REVERSE_LIGHT && (lamps & LAMP_REVERSE) != 0) return vec3(1.0, 0.98, 0.94);
    if (material == M_HEADLIGHT && (lamps & LAMP_LOW_BEAM) != 0) return vec3(1.6, 1.55, 1.45);
    return vec3(0.0);
}

// Linear colour and roughness; colours of a model's own are numbers with four bits a channel (see context.py).
vec4 albedo_of(int material) {
    if (material < MATERIAL_COUNT) return u_albedo[material];
    int own = material - MATERIAL_COUNT;
    return vec4(pow(vec3((own >> 8) & 15, (own >> 4) & 15, own & 15) / 15.0, vec3(2.2)), 0.35);
}

void main() {
#ifdef PEEL
    if (texelFetch(u_front, ivec2(gl_FragCoord.xy), 0).a == u_id) discard;
#endif
    float metres = length(v_world), cosine = 1.0 / (gl_FragCoord.w * metres);
    vec3 n = normalize(v_normal), view = -v_world / metres;
    if (dot(n, view) < 0.0) n = -n;
    vec4 albedo = albedo_of(v_material);
    vec3 base = v_material == M_PAINT ? u_paint : albedo.rgb;
    // The inside of the body, seen through its windows.
    if (!gl_FrontFacing) base = vec3(0.03);
    float facing = max(dot(n, u_sun_direction), 0.0);
    float open = v_open * (0.55 + 0.45 * clamp(n.z * 0.5 + 0.5, 0.0, 1.0));
    vec3 ambient = open * mix(u_ground, 0.65 * u_zenith + 0.35 * u_horizon, clamp(0.5 + 0.5 * n.z, 0.0, 1.0));
#ifdef PEEL
    // It is only held against what stands before it: no shadows, no mirror images.
    vec3 color = base * (ambient + u_sun / PI * facing);
#else
    float sun = texture(u_scenery_sun_map, v_scenery_sun_at) * texture(u_vehicle_sun_map, v_vehicle_sun_at);
    float f0 = 0.04, coat = 0.0, metal = 0.0;
    if (v_material == M_PAINT) coat = 1.0;
    if (v_material >= MATERIAL_COUNT) coat = 0.4;
    if (v_material >= M_GLASS && v_material <= M_GLASS_MIRROR) { coat = 1.0; f0 = 0.08; }
    if (v_material >= M_LAMP_CLEAR && v_material <= M_REVERSE_LIGHT) { coat = 1.0; f0 = 0.06; }
    if (v_material == M_CHROME || v_material == M_RIM) metal = 1.0;
    if (v_material == M_TRIM || v_material == M_GRILLE || v_material == M_BOX) coat = 0.25;

    if (!gl_FrontFacing) coat = metal = 0.0;

    float f = coat * fresnel(dot(n, view), f0);
    vec3 mirrored = mirror(reflect(-view, n)) * open;
    vec3 color = base * (ambient + u_sun / PI * facing * sun) * (1.0 - metal * 0.8);
    color = mix(color, mirrored, f) + metal * 0.55 * base * mirrored;
    color += (f + metal * base) * ggx(n, view, u_sun_direction, max(albedo.a, 0.12)) * u_sun * sun;
    color += glow(v_material, u_lamps);
#endif
#ifdef PANES
    // What a pane mirrors is screened over what it lets through.
    vec3 seen = display(exposed(mirrored * f + (color - mirrored * f) * 0.4, metres, cosine));
    float through = (v_material == M_GLASS_TINTED ? 0.35 : 0.72) * (1.0 - dot(seen, vec3(0.3, 0.5, 0.2)));
    out_color = vec4(seen, 1.0 - through);
#else
    out_color = vec4(display(exposed(color, metres, cosine)), 1.0);
#endif
}
