// Functions of all programs: sky radiance, materials and their patterns, noise.
// Units: metres and linear light; world axes x east, y north, z up; positions relative to the camera.

uniform vec3 u_eye;            // camera position in the world
uniform vec3 u_sun_direction;  // towards the sun
uniform vec3 u_sun;            // irradiance of the sun on a surface that faces it
uniform vec3 u_zenith;         // sky radiance overhead
uniform vec3 u_horizon;        // sky radiance at the horizon
uniform vec3 u_afterglow;      // extra radiance of the horizon above the sun after sunset
uniform vec2 u_sunset;         // direction of the afterglow
uniform vec3 u_ground;         // radiance of the ground seen from above
uniform vec3 u_bounced;        // mean radiance of the surroundings that street lights light
uniform float u_cloud;         // 0 clear sky .. 1 overcast
uniform sampler2D u_noise;     // four independent value noises, tileable
uniform vec4 u_albedo[MATERIAL_COUNT];  // linear colour; w: roughness

const float PI = 3.14159265;

// Linear colour and roughness; colours as material names are numbers with four bits per channel (see context.py).
vec4 albedo_of(int material) {
    if (material < MATERIAL_COUNT) return u_albedo[material];
    int own = material - MATERIAL_COUNT;
    return vec4(pow(vec3((own >> 8) & 15, (own >> 4) & 15, own & 15) / 15.0, vec3(2.2)), 0.35);
}

// Clear and overcast sky: a gradient from horizon to zenith with the sun's glow (after Preetham's qualitative shape).
vec3 open_sky(vec3 d) {
    vec3 color = mix(u_horizon, u_zenith, pow(max(d.z, 0.0), 0.45));
    float glow = max(dot(d, u_sun_direction), 0.0), toward = 0.5 + 0.5 * dot(d.xy, u_sunset);
    color += u_afterglow * toward * toward * exp(-5.0 * max(d.z, 0.0));
    return color + (1.0 - u_cloud) * u_sun * (0.02 * pow(glow, 8.0) + 0.06 * pow(glow, 64.0));
}

vec3 sky(vec3 d) {
    float up = max(d.z, 0.0);
    vec3 color = open_sky(d);
    vec2 at = d.xy / (up + 0.12);
    float clouds = texture(u_noise, at * 0.045).r * 0.6 + texture(u_noise, at * 0.11).g * 0.4;
    float cover = smoothstep(0.52 - 0.4 * u_cloud, 0.75, clouds) * smoothstep(0.02, 0.25, up) * (0.55 + 0.4 * u_cloud);
    vec3 cloud = 0.35 * (u_zenith + 2.2 * u_horizon) + 0.05 * u_sun * max(u_sun_direction.z, 0.1) * (1.0 - u_cloud);
    return mix(color, cloud, cover);
}

// Surroundings in a direction: sky above, street and walls below and at the horizon.
vec3 surroundings(vec3 d) {
    vec3 above = open_sky(vec3(d.xy, max(d.z, 0.02)));
    vec3 walls = 0.45 * u_ground + 0.08 * u_horizon;
    float wall = smoothstep(0.16, 0.05, d.z) * (0.6 + 0.4 * texture(u_noise, d.xy * 0.4).b);
    return mix(mix(above, walls, wall), u_ground, smoothstep(0.02, -0.08, d.z));
}

float fresnel(float cosine, float f0) { return f0 + (1.0 - f0) * pow(1.0 - clamp(cosine, 0.0, 1.0), 5.0); }

// Specular reflection of the sun: GGX distribution (Walter et al. 2007) with Karis' visibility term.
float ggx(vec3 n, vec3 v, vec3 l, float roughness) {
    vec3 h = normalize(v + l);
    float a = max(roughness * roughness, 0.002), a2 = a * a;
    float nh = max(dot(n, h), 0.0), nl = max(dot(n, l), 0.0), nv = max(dot(n, v), 1e-3);
    float d = nh * nh * (a2 - 1.0) + 1.0;
    float k = 0.5 * a;
    return nl * a2 / (PI * d * d) / (4.0 * (nl * (1.0 - k) + k) * (nv * (1.0 - k) + k) + 1e-4);
}
