// Compose the image from scenery and vehicles. SHADOWS: shadows of vehicles. VEHICLES: vehicles over the scenery. LAMPS: at
// night. WET: the road mirrors. REFLECTIONS: it mirrors vehicles. BLUR: around a vehicle that
// moves. HAZE: the air is visible within the reach of vehicles' shadows. LINEAR: an image at night, which stays
// linear light: red, green and blue of two blended exposures, and in alpha the light at which their blend is full.
#version 430
#include "display.glsl"
in vec2 v_pixel;
in vec3 v_ray;
in vec3 v_sun_ray;
uniform sampler2D u_ambient;      // scenery's light, by part, exposed
uniform sampler2D u_sunlit;
uniform sampler2D u_background;   // depth of the scenery, 0 for sky
uniform sampler2D u_vehicles;     // colour and coverage of the vehicles, 2 x 2 samples per pixel
uniform sampler2D u_open;         // share of the sky that is visible from the road between vehicles
uniform sampler2DShadow u_vehicle_sun_map;
uniform vec3 u_sun_at;            // position of the camera in that map, slightly raised
uniform vec2 u_open_at;           // position of the camera in the map of the open sky
uniform float u_open_scale;       // maps per metre
uniform float u_eye_height;       // height of the camera above the road, metres
uniform float u_texel;            // 4 cm in the vehicles' sun map, texture coordinates
out vec4 out_color;
#ifdef LAMPS
uniform sampler2D u_beams;        // irradiance of the road from headlights; from rear lamps
uniform vec3 u_beam_light;        // colour of the lamps, exposed
uniform vec3 u_wash_light;
#endif
#ifdef BLUR
uniform sampler2D u_front;        // depth, slopes, id of the nearest vehicle
uniform vec2 u_way;               // motion of this vehicle while the shutter is open, pixels
uniform vec2 u_open_during;       // start and end of the exposure before the labelled moment, as shares of its length
uniform float u_id;
uniform float u_nearest;          // minimum depth of this vehicle
#endif
#ifdef WET
#include "blur.glsl"
uniform sampler2D u_reflected;    // mirror image of the scenery on the road, exposed; w: share that the road mirrors
uniform sampler2D u_reflections;  // the vehicles' mirror images and coverage, exposed, at half the image's resolution
#endif

#ifdef LINEAR
uniform float u_full;             // light at which the long exposure saturates
uniform vec2 u_short;             // share of the short exposure in the blend; ratio of its range to that of the long exposure
#ifdef BLUR
uniform float u_pulses;           // pulses of this vehicle's lamps while the shutter is open; 0 for a steady light
#endif

float brightest(vec3 light) { return max(light.r, max(light.g, light.b)); }

// Light at which the blend of both exposures saturates, for this light in each exposure.
float full_at(vec3 long_exposed, vec3 short_exposed) {
    return mix(min(brightest(long_exposed), u_full), min(brightest(short_exposed), u_full * u_short.y), u_short.x);
}
#endif
const int TAPS = 3;

// Share of a disc around a point that a shadow map leaves lit (Vogel's spiral).
float lit(sampler2DShadow map, vec3 at, float radius) {
    float sum = 0.0;
    for (int i = 0; i < TAPS; ++i) {
        float angle = 2.399963 * float(i), reach = radius * sqrt((float(i) + 0.5) / float(TAPS));
        sum += texture(map, at + vec3(reach * cos(angle), reach * sin(angle), 0.0));
    }
    return sum / float(TAPS);
}

void main() {
    ivec2 pixel = ivec2(v_pixel);
    vec4 scenery = texelFetch(u_ambient, pixel, 0);
    vec3 ambient = scenery.rgb, sunlit = texelFetch(u_sunlit, pixel, 0).rgb;
#ifdef SHADOWS
    float depth = texelFetch(u_background, pixel, 0).r;
    sunlit *= lit(u_vehicle_sun_map, u_sun_at + v_sun_ray * depth, u_texel);
    vec2 open_at = u_open_at + v_ray.xy * (depth * u_open_scale);
    // No sky is hidden outside the map; otherwise its edge would extend to the horizon.
    bool on_map = all(lessThan(abs(open_at - 0.5), vec2(0.5)));
    float open = on_map ? texture(u_open, open_at).r : 1.0;
    // The map applies to the road; walls and poles beside a vehicle see more of the sky the higher they are.
    float above = clamp((v_ray.z * depth + u_eye_height) * 0.8 - 0.1, 0.0, 1.0);
    float kept = mix(open, 1.0, above), through = 1.0;
#ifdef HAZE
    // A vehicle does not reduce the light of the air in front of the road.
    float away = length(v_ray), metres = max(depth, 0.0) * away;
    vec3 air = exposed(vec3(0.0), metres, 1.0 / away);
    ambient = air + (ambient - air) * kept;
    through = exp(-metres * u_haze_density);
#else
    ambient *= kept;
#endif
#ifdef LAMPS
    vec2 beams = (on_map ? texture(u_beams, open_at).rg : vec2(0.0)) * ((1.0 - above) * scenery.a * through);
    ambient += u_beam_light * beams.x + u_wash_light * beams.y;
#endif
#endif
    vec3 light = ambient + sunlit;
#ifdef WET
    vec4 reflected = texelFetch(u_reflected, pixel, 0);
#ifdef REFLECTIONS
    vec4 mirrored = vec4(0.0);
    vec2 size = vec2(textureSize(u_ambient, 0));
    for (int i = 0; i < 5; ++i) mirrored += texture(u_reflections, (v_pixel + blurred(v_pixel, i, 5, reflected.a < 0.0)) / size);
    mirrored /= 5.0;
    reflected.rgb = reflected.rgb * (1.0 - mirrored.a) + mirrored.rgb * abs(reflected.a);
#endif
    light += reflected.rgb;
#endif
    vec3 color = shown(light);
#ifdef LINEAR
    vec3 short_exposed = color;
#endif
#ifdef VEHICLES
    vec4 front = texture(u_vehicles, (floor(v_pixel) + 0.5) / vec2(textureSize(u_ambient, 0)));
    vec3 still = color * (1.0 - front.a) + front.rgb;
#ifdef LINEAR
    short_exposed = still;
#endif
#ifdef BLUR
    if (depth <= 0.0 || depth > u_nearest) {
        vec3 behind = texelFetch(u_front, pixel, 0).a == u_id ? color : still, sum = vec3(0.0);
        float noise = fract(52.9829189 * fract(dot(floor(v_pixel), vec2(0.06711056, 0.00583715))));
#ifdef LINEAR
        int taps = int(clamp(0.4 * length(u_way), 8.0, 24.0));
#else
        const int taps = 8;
#endif
        for (int i = 0; i < taps; ++i) {
            float when = (float(i) + noise) / float(taps);
            vec2 at = v_pixel + u_way * mix(u_open_during.x, u_open_during.y, when);
            vec4 passing = texture(u_vehicles, (floor(at) + 0.5) / vec2(textureSize(u_ambient, 0)));
            vec3 then = texelFetch(u_front, ivec2(at), 0).a == u_id ? behind * (1.0 - passing.a) + passing.rgb : behind;
#ifdef LINEAR
            // Only lamps exceed this brightness; they pulse, bodies do not.
            if (u_pulses > 0.0 && brightest(then) > 4.0 * u_full) then *= 2.0 * step(0.5, fract(when * u_pulses));
#endif
            sum += then;
        }
        still = sum / float(taps);
    }
#endif
    color = still;
#endif
#ifdef LINEAR
    out_color = vec4(mix(color, short_exposed, u_short.x), full_at(color, short_exposed));
#else
    out_color = vec4(color, 1.0);
#endif
}
