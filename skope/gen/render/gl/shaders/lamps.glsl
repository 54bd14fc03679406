// Light at night: street lights, the camera's own lamp, lit windows.
uniform vec3 u_street_light;             // radiant intensity of each light
uniform vec4 u_luminaires[MOST_LAMPS];        // positions of the lights; w: 1
uniform vec2 u_lamp_arms[MOST_LAMPS];     // directions of the arms that hold them, from pole to light; 0 without an arm
uniform int u_lamp_count;
uniform bool u_all_lit;                  // whether all street lights burn, not only those of u_luminaires
uniform mat4 u_lamp_map_from[SHADOWED_LAMPS];
uniform int u_shadowed;                  // number of lights with shadow maps, side by side in one texture
uniform sampler2DShadow u_lamp_maps;
uniform float u_own_lamp;                // radiant intensity of the camera's own lamp
uniform float u_lit_windows;

// Intensity of a street light towards a point: highest at 65 degrees from straight down, so that the road is lit evenly, and
// almost none above 75. `down` is the cosine of that angle.
float luminaire(float down) { return smoothstep(0.2, 0.42, down) * (2.1 - 1.6 * down); }

// Share of the light that goes towards a point behind the pole: road lights shield the side that is not the road.
float house_side(vec3 l, vec2 arm) { return mix(1.0, BACK_LIGHT, smoothstep(0.0, 0.5, dot(l.xy, arm))); }

// Irradiance of one lamp without shadows.
float from_lamp(vec3 lamp, vec2 arm, vec3 at, vec3 n) {
    vec3 to = lamp - at;
    float square = max(dot(to, to), 0.05);
    vec3 l = to * inversesqrt(square);
    float wide = luminaire(l.z) * house_side(l, arm);
#ifdef LEAVES
    return wide * 0.55 / square;
#else
    return wide * max(dot(n, l), 0.0) / square;
#endif
}

vec3 lamplight(vec3 at, vec3 n) {
    float sum = 0.0;
    for (int i = 0; i < u_shadowed; ++i) {
        vec4 clip = u_lamp_map_from[i] * vec4(at, 1.0);
        vec3 uvz = clip.xyz / max(clip.w, 1e-3);
        vec2 cell = vec2(i % LAMP_CELLS, i / LAMP_CELLS);
        uvz.xy = (cell + clamp(uvz.xy, 0.002, 0.998)) / float(LAMP_CELLS);
        sum += from_lamp(u_luminaires[i].xyz, u_lamp_arms[i], at, n) * texture(u_lamp_maps, uvz);
    }
    for (int i = u_shadowed; i < u_lamp_count; ++i) sum += from_lamp(u_luminaires[i].xyz, u_lamp_arms[i], at, n);
    float square = dot(at, at);
    return u_street_light * sum + vec3(u_own_lamp * max(dot(n, -at) * inversesqrt(square), 0.0) / square);
}

#if defined(GROUND) && defined(POOLS)
uniform vec4 u_pools[MOST_POOLS];        // patches of light on the road: middle, and the direction in which they fade
uniform vec4 u_pool_shapes[MOST_POOLS];  // half length, half width, height
uniform vec4 u_pool_light[MOST_POOLS];   // irradiance

// Light of lamps outside the image: an edge that is sharp on the near side, and a long tail.
vec3 pool_light(vec3 at) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < MOST_POOLS; ++i) {
        vec2 from = at.xy - u_pools[i].xy, axis = u_pools[i].zw;
        vec2 share = vec2(dot(from, axis), dot(from, vec2(-axis.y, axis.x))) / u_pool_shapes[i].xy;
        float along = smoothstep(-1.0, -0.7, share.x) * smoothstep(1.0, -0.5, share.x), low = step(abs(at.z - u_pool_shapes[i].z), 1.5);
        sum += u_pool_light[i].rgb * along * exp(-2.0 * share.y * share.y) * low;
    }
    return sum;
}
#endif

vec3 emission(vec3 p, vec3 n) {
    if (v_material == M_LUMINAIRE) {
        bool lit = u_all_lit;
        for (int i = 0; i < u_lamp_count && !lit; ++i) lit = distance(u_luminaires[i].xyz, p - u_eye) < 1.0;
        // The lamp's own faces and its arm scatter a little light in all directions.
        float down = normalize(p - u_eye).z;
        return lit ? u_street_light * (1.0 + 4.0 * luminaire(down)) : vec3(0.0);
    }
#ifdef LEAVES
    // Lit from below by lamps as strong as the town's: brightest on surfaces that face down.
    if (v_material == M_LEAVES_LIT) return u_albedo[v_material].rgb * u_street_light * 0.014 * leaf_tone(v_local) * smoothstep(1.0, -0.7, n.z);
#endif
#if defined(GROUND) && defined(POOLS)
    return u_albedo[v_material].rgb * pool_light(p - u_eye) * max(n.z, 0.0) / PI;
#endif
#ifdef OTHERS
    if (v_material == M_WOODS) {
        // Lamps of distant buildings, in one of 50 squares of 9 m.
        vec2 square = floor(p.xy / 9.0);
        vec4 luck = fract(sin(dot(square, vec2(12.9898, 78.233))) * vec4(43758.5453, 9137.31, 3517.7, 771.13));
        bool lamp = luck.x < 0.02 && distance(p.xy, 9.0 * (square + 0.2 + 0.6 * luck.yz)) < 0.7;
        return lamp ? mix(vec3(1.0, 0.55, 0.25), vec3(0.9, 0.95, 1.0), luck.w) * 6.0 : vec3(0.0);
    }
    if (v_material >= M_SIGN_RED && v_material <= M_LIT_DIM) {
        // Signs return the light of headlamps. Boxes and dots must stay readable. Lamps are overexposed.
        if (v_material >= M_LAMP_WHITE && v_material <= M_LAMP_RED) return u_albedo[v_material].rgb * 14.0;
        float radiance = v_material <= M_SIGN_GREEN ? 0.012 : v_material == M_LIT_DIM ? 0.02 : 0.06;
        // Boards are dimmed in darker towns.
        return u_albedo[v_material].rgb * radiance * min(0.25 + 0.09 * u_street_light.g, 1.2);
    }
    bool shop = v_material == M_SHOP_WINDOW, cloth = v_material == M_CURTAIN || v_material == M_BLIND;
    if (!shop && !cloth && v_material != M_WINDOW) return vec3(0.0);
    vec2 at = vec2(dot(p.xy, normalize(vec2(-n.y, n.x) + 1e-6)), p.z);
    vec2 room = floor(at / vec2(2.8, 2.9));
    float chance = fract(sin(dot(room, vec2(12.9898, 78.233)) + floor(dot(p.xy, n.xy))) * 43758.5453), tint = fract(chance * 91.7);
    if (!shop && chance > u_lit_windows) return vec3(0.0);
    vec3 warm = mix(vec3(1.0, 0.56, 0.24), vec3(0.95, 0.88, 0.75), tint);
    float inside = 0.55 + 0.9 * texture(u_noise, floor(at / vec2(0.37, 0.52)) * 0.231).g;
    if (shop) return mix(warm, vec3(1.0, 0.95, 0.85), 0.6) * inside * 0.008 * (0.35 + u_lit_windows);
    return warm * (cloth ? 0.0025 : 0.005 * inside) * (0.5 + tint);
#else
    return vec3(0.0);
#endif
}
