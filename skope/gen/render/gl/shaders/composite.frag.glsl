// The picture: scenery, in the vehicles' shadow where SHADOWS, with vehicles over it where VEHICLES; LAMPS when it is
// dark, WET when the road mirrors, REFLECTIONS where it mirrors vehicles; BLUR around a vehicle that
// moves; HAZE when the air between shows within the reach of vehicles' shadows.
#version 430
#include "display.glsl"
in vec2 v_pixel;
in vec3 v_ray;
in vec3 v_sun_ray;
uniform sampler2D u_ambient;      // scenery's light, by part, exposed
uniform sampler2D u_sunlit;
uniform sampler2D u_background;   // depth of the scenery, 0 for sky
uniform sampler2D u_vehicles;     // the vehicles' picture and coverage, 2 x 2 samples per pixel
uniform sampler2D u_open;         // share of the sky that the vehicles leave the road
uniform sampler2DShadow u_vehicle_sun_map;
uniform vec3 u_sun_at;            // in that map: the camera, lifted a little
uniform vec2 u_open_at;           // in the map of the open sky: the camera
uniform float u_open_scale;       // maps per metre
uniform float u_eye_height;       // metres above the road
uniform float u_texel;            // of the vehicles' sun map, per 4 cm
out vec4 out_color;
#ifdef LAMPS
uniform sampler2D u_beams;        // irradiance of the road by headlights
uniform vec3 u_beam_light;        // their colour, exposed
#endif
#ifdef BLUR
uniform sampler2D u_front;        // depth, slopes, id of the nearest vehicle
uniform vec2 u_way;               // of this one while the shutter is open, pixels
uniform float u_id;
uniform float u_nearest;          // its least depth
#endif
#ifdef WET
#include "blur.glsl"
uniform sampler2D u_reflected;    // what the road mirrors of the scenery, exposed; w: which share it mirrors
uniform sampler2D u_reflections;  // the vehicles' mirror images and coverage, exposed, half as fine as the image
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
    // Beyond the map nothing is taken; its rim would stretch to the horizon.
    bool on_map = all(lessThan(abs(open_at - 0.5), vec2(0.5)));
    float open = on_map ? texture(u_open, open_at).r : 1.0;
    // The map holds for the road; walls and poles beside a vehicle see more of the sky the higher up they are.
    float above = clamp((v_ray.z * depth + u_eye_height) * 0.8 - 0.1, 0.0, 1.0);
    float kept = mix(open, 1.0, above), through = 1.0;
#ifdef HAZE
    // A vehicle takes nothing from the air before the road.
    float away = length(v_ray), metres = max(depth, 0.0) * away;
    vec3 air = exposed(vec3(0.0), metres, 1.0 / away);
    ambient = air + (ambient - air) * kept;
    through = exp(-metres * u_haze_density);
#else
    ambient *= kept;
#endif
#ifdef LAMPS
    float beam = (on_map ? texture(u_beams, open_at).r : 0.0) * (1.0 - above);
    ambient += u_beam_light * (beam * scenery.a * through);
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
    vec3 color = display(light);
#ifdef VEHICLES
    vec4 front = texture(u_vehicles, (floor(v_pixel) + 0.5) / vec2(textureSize(u_ambient, 0)));
    vec3 still = color * (1.0 - front.a) + front.rgb;
#ifdef BLUR
    if (depth <= 0.0 || depth > u_nearest) {
        vec3 behind = texelFetch(u_front, pixel, 0).a == u_id ? color : still, sum = vec3(0.0);
        float noise = fract(52.9829189 * fract(dot(floor(v_pixel), vec2(0.06711056, 0.00583715))));
        for (int i = 0; i < 8; ++i) {
            vec2 at = v_pixel + u_way * ((float(i) + noise) / 8.0 - 0.5);
            vec4 passing = texture(u_vehicles, (floor(at) + 0.5) / vec2(textureSize(u_ambient, 0)));
            sum += texelFetch(u_front, ivec2(at), 0).a == u_id ? behind * (1.0 - passing.a) + passing.rgb : behind;
        }
        still = sum / 8.0;
    }
#endif
    color = still;
#endif
    out_color = vec4(color, 1.0);
}
