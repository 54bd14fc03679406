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

#include "surface.glsl"

void main() {
#ifdef LEAVES
    if (leaf_gap(v_local)) discard;
#endif
    vec3 n = normalize(v_normal), view = normalize(-v_world);
    if (dot(n, view) < 0.0) n = -n;
    float gloss;
    vec3 color = albedo(v_world + u_eye, n, gloss);

    vec3 lifted = v_world + n * 0.04;
    float sun = texture(u_sun_map, (u_sun_map_from * vec4(lifted, 1.0)).xyz);
    float open = texture(u_sky_map, (u_sky_map_from * vec4(lifted, 1.0)).xyz);
    float facing = max(dot(n, u_sun_direction), 0.0), up = max(dot(n, u_sky_direction), 0.0);
#ifdef LEAVES
    // Light comes through them and from all sides.
    facing = 0.35 + 0.4 * facing;
    up = 0.3 + 0.4 * up;
#endif

    // One direction, drawn evenly over the hemisphere, stands for all of it.
    vec3 light = 2.0 * u_sky_radiance * up * open + u_ground * 0.5 * (1.0 - n.z);
    vec3 mirrored = reflect(-view, n);
    float f = gloss * fresnel(dot(n, view), 0.06);
    out_ambient = vec4(color * light * (1.0 - f) + f * surroundings(mirrored), 1.0);
    out_sun = vec4((color / PI * facing * (1.0 - f) + gloss * f * 2.0 * pow(max(dot(mirrored, u_sun_direction), 0.0), 400.0)) * u_sun * sun, 1.0);
}
