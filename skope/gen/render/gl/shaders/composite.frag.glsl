// The picture: scenery, in the vehicles' shadow where SHADOWS, with vehicles over it where VEHICLES.
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
    vec3 ambient = texelFetch(u_ambient, pixel, 0).rgb, sunlit = texelFetch(u_sunlit, pixel, 0).rgb;
#ifdef SHADOWS
    float depth = texelFetch(u_background, pixel, 0).r;
    sunlit *= lit(u_vehicle_sun_map, u_sun_at + v_sun_ray * depth, u_texel);
    float open = texture(u_open, u_open_at + v_ray.xy * (depth * u_open_scale)).r;
    // The map holds for the road; walls and poles beside a vehicle see more of the sky the higher up they are.
    ambient *= mix(open, 1.0, clamp((v_ray.z * depth + u_eye_height) * 0.8 - 0.1, 0.0, 1.0));
#endif
    vec3 color = display(ambient + sunlit);
#ifdef VEHICLES
    vec4 front = texture(u_vehicles, (floor(v_pixel) + 0.5) / vec2(textureSize(u_ambient, 0)));
    color = color * (1.0 - front.a) + front.rgb;
#endif
    out_color = vec4(color, 1.0);
}
