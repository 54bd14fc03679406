// One sample of the scenery's light: what one direction of the sky and one point of the sun's disc send to the camera.
// Averaged over many samples with jittered pixels this is anti-aliased, with soft shadows and true sky occlusion.
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
uniform sampler2DShadow u_sun_map;
uniform sampler2DShadow u_sky_map;
layout(location = 0) out vec4 out_ambient;
layout(location = 1) out vec4 out_sun;

vec4 noise(vec2 at, float metres) { return texture(u_noise, at / metres); }

// Albedo with the pattern of its material; tangent coordinates run along a wall and up it.
vec3 albedo(vec3 p, vec3 n, out float gloss) {
    vec3 color = u_albedo[v_material].rgb;
    gloss = 0.0;
    float footprint = length(fwidth(p));  // metres that a pixel covers: patterns finer than that fade to their mean
    vec2 wall = vec2(dot(p, normalize(vec3(-n.y, n.x, 0.0) + 1e-6)), p.z);
    if (v_material == M_ASPHALT) {
        vec4 broad = noise(p.xy, 37.0), middle = noise(p.xy, 6.0), fine = noise(p.xy, 0.7);
        color *= 0.72 + 0.35 * broad.r + 0.22 * (middle.g - 0.5) + 0.5 * (fine.b - 0.5);
        color = mix(color, 0.55 * color, smoothstep(0.62, 0.66, noise(p.xy + 31.0, 23.0).a) * 0.6);
        float crack = abs(noise(p.xy, 11.0).r - 0.5);
        color *= 0.75 + 0.25 * smoothstep(0.0, 0.012, crack);
    } else if (v_material == M_MARKING) {
        color *= 0.7 + 0.35 * noise(p.xy, 1.5).g;
        color = mix(color, vec3(0.1), smoothstep(0.66, 0.74, noise(p.xy, 0.9).b) * 0.7);
    } else if (v_material == M_SIDEWALK || v_material == M_KERB) {
        vec2 slab = fract(p.xy / 0.75);
        float joint = min(min(slab.x, 1.0 - slab.x), min(slab.y, 1.0 - slab.y));
        float tone = texture(u_noise, floor(p.xy / 0.75) * 0.137).r;
        color *= (0.8 + 0.3 * tone) * (0.9 + 0.3 * (noise(p.xy, 0.8).g - 0.5)) * mix(0.65 + 0.35 * smoothstep(0.0, 0.025, joint), 0.97, smoothstep(0.04, 0.15, footprint));
    } else if (v_material == M_GRASS) {
        vec4 broad = noise(p.xy, 19.0), fine = noise(p.xy, 0.6);
        color *= 0.55 + 0.5 * broad.r + 0.8 * (fine.g - 0.35);
        color = mix(color, color * vec3(1.5, 1.15, 0.7), smoothstep(0.45, 0.8, noise(p.xy, 9.0).b) * 0.6);
    } else if (v_material == M_BRICK) {
        float row = floor(wall.y / 0.075);
        vec2 brick = vec2(fract(wall.x / 0.25 + 0.5 * mod(row, 2.0)), fract(wall.y / 0.075));
        float mortar = step(0.05, brick.x) * step(0.14, brick.y);
        float tone = texture(u_noise, vec2(floor(wall.x / 0.25 + 0.5 * mod(row, 2.0)), row) * 0.173).g;
        vec3 laid = mix(vec3(0.42, 0.40, 0.37), color * (0.65 + 0.7 * tone), mortar);
        color = mix(laid, mix(vec3(0.42, 0.40, 0.37), color, 0.8), smoothstep(0.015, 0.05, footprint));
        color *= 0.8 + 0.35 * noise(wall, 9.0).r;
    } else if (v_material == M_PLASTER || v_material == M_STONE) {
        color *= 0.82 + 0.25 * noise(wall, 7.0).r + 0.16 * (noise(wall, 0.9).g - 0.5);
        color *= 1.0 - 0.25 * smoothstep(0.55, 0.8, noise(vec2(wall.x, wall.y * 0.25), 2.5).b);
    } else if (v_material == M_TILES || v_material == M_SLATE) {
        float slope = p.z * 1.7;
        float course = fract(slope / 0.28);
        float tone = texture(u_noise, vec2(floor(wall.x / 0.3), floor(slope / 0.28)) * 0.211).r;
        float laid = (0.65 + 0.6 * tone) * (0.6 + 0.4 * smoothstep(0.0, 0.2, course));
        color *= mix(laid, 0.87, smoothstep(0.06, 0.2, footprint));
    } else if (v_material == M_LEAVES) {
        color *= 0.55 + 0.9 * leaf_hash(v_local * 5.0) * (0.5 + leaf_hash(v_local * 1.3));
    } else if (v_material == M_WINDOW) {
        gloss = 1.0;
        color *= 0.4 + 0.9 * texture(u_noise, floor(wall / vec2(1.4, 3.0)) * 0.319).r;
    }
    return color;
}

void main() {
    if (v_material == M_LEAVES && leaf_gap(v_local)) discard;
    vec3 n = normalize(v_normal), view = normalize(-v_world);
    bool thin = v_material == M_LEAVES;
    if (dot(n, view) < 0.0) n = -n;
    float gloss;
    vec3 color = albedo(v_world + u_eye, n, gloss);

    vec3 lifted = v_world + n * 0.04;
    float sun = texture(u_sun_map, (u_sun_map_from * vec4(lifted, 1.0)).xyz);
    float open = texture(u_sky_map, (u_sky_map_from * vec4(lifted, 1.0)).xyz);
    float facing = max(dot(n, u_sun_direction), 0.0), up = max(dot(n, u_sky_direction), 0.0);
    if (thin) { facing = 0.35 + 0.4 * facing; up = 0.3 + 0.4 * up; }

    // One direction, drawn evenly over the hemisphere, stands for all of it.
    vec3 light = 2.0 * u_sky_radiance * up * open + u_ground * 0.5 * (1.0 - n.z);
    vec3 mirrored = reflect(-view, n);
    float f = gloss * fresnel(dot(n, view), 0.06);
    out_ambient = vec4(color * light * (1.0 - f) + f * surroundings(mirrored), 1.0);
    out_sun = vec4((color / PI * facing * (1.0 - f) + gloss * f * 2.0 * pow(max(dot(mirrored, u_sun_direction), 0.0), 400.0)) * u_sun * sun, 1.0);
}
