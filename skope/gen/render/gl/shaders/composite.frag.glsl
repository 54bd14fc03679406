// The picture: scenery in the vehicles' shadow, vehicles over it, exposure, filmic curve, lens shading, sRGB.
#version 430
in vec2 v_pixel;
uniform sampler2D u_ambient;      // scenery's light, by part
uniform sampler2D u_sunlit;
uniform sampler2D u_background;   // depth of the scenery, 0 for sky
uniform sampler2D u_vehicles;     // linear colour, alpha; SCALE x SCALE samples per pixel
uniform mat3 u_world_from_camera;
uniform mat3 u_camera_from_pixel;
uniform mat4 u_vehicle_sun_map_from;
uniform mat4 u_vehicle_top_map_from;
uniform sampler2DShadow u_vehicle_sun_map;
uniform sampler2DShadow u_vehicle_top_map;
uniform float u_exposure;
uniform vec3 u_fog;               // radiance of the haze
uniform float u_fog_density;      // 1 / m
uniform vec2 u_size;
uniform float u_texel;            // metres per texel of the vehicles' shadow maps
out vec4 out_color;

// Narkowicz' fit of the ACES filmic curve.
vec3 filmic(vec3 x) { return clamp((x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0); }

vec3 srgb(vec3 x) { return mix(12.92 * x, 1.055 * pow(max(x, 1e-5), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x)); }

const int TAPS = 5;

// Share of a disc around a point that a shadow map leaves lit (Vogel's spiral).
float lit(sampler2DShadow map, vec3 at, float radius) {
    float sum = 0.0;
    for (int i = 0; i < TAPS; ++i) {
        float angle = 2.399963 * float(i), reach = radius * sqrt((float(i) + 0.5) / float(TAPS));
        sum += texture(map, at + vec3(reach * cos(angle), reach * sin(angle), 0.0));
    }
    return sum / float(TAPS);
}

vec3 display(vec3 linear, float depth) {
    float haze = depth > 0.0 ? 1.0 - exp(-depth * u_fog_density) : 0.0;
    vec3 color = mix(linear, u_fog, haze) * u_exposure;
    vec2 off = (v_pixel / u_size - 0.5) * vec2(1.0, u_size.y / u_size.x);
    color *= 1.0 - 0.45 * dot(off, off);
    return srgb(filmic(color));
}

void main() {
    ivec2 pixel = ivec2(v_pixel);
    float depth = texelFetch(u_background, pixel, 0).r;
    vec3 ambient = texelFetch(u_ambient, pixel, 0).rgb, sunlit = texelFetch(u_sunlit, pixel, 0).rgb;
#ifdef SHADOWS
    if (depth > 0.0) {
        vec3 world = u_world_from_camera * (u_camera_from_pixel * vec3(floor(v_pixel) + 0.5, 1.0)) * depth;
        vec3 sun_at = (u_vehicle_sun_map_from * vec4(world + vec3(0.0, 0.0, 0.02), 1.0)).xyz;
        vec3 top_at = (u_vehicle_top_map_from * vec4(world, 1.0)).xyz;
        sunlit *= lit(u_vehicle_sun_map, sun_at, 0.04 * u_texel);
        // The sky that a vehicle takes from the road: near and under it most of it.
        ambient *= 0.15 + 0.85 * lit(u_vehicle_top_map, top_at, 0.9 * u_texel);
    }
#endif
    vec4 front = vec4(0.0);
    for (int y = 0; y < SCALE; ++y)
        for (int x = 0; x < SCALE; ++x) front += texelFetch(u_vehicles, pixel * SCALE + ivec2(x, y), 0);
    front /= float(SCALE * SCALE);
    out_color = vec4(display(ambient + sunlit, depth) * (1.0 - front.a), 1.0);
    if (front.a > 0.0) out_color.rgb += front.a * display(front.rgb / front.a, depth);
}
