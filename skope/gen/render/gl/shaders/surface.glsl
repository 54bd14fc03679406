// Albedo of the scenery's materials with their patterns, which all use the noise texture. There is one program each for
// GROUND, WALLS, LEAVES and OTHERS, because a processor evaluates every compiled branch at every pixel.
vec4 noise(vec2 at, float metres) { return texture(u_noise, at / metres); }

bool between(int first, int last) { return v_material >= first && v_material <= last; }

// 1 along the edges of cells, with `at` in cells and `width` the share of a cell that a joint covers.
float joints(vec2 at, vec2 width) {
    vec2 edge = min(fract(at), 1.0 - fract(at));
    return 1.0 - step(width.x, edge.x) * step(width.y, edge.y);
}

#if defined(GROUND) && defined(WET)
uniform float u_wetness;
uniform float u_puddles;
uniform float u_standing;

// Wetness of level ground, and whether water stands there. Ground that drains last dries last.
vec2 water_on(vec3 p, vec3 n) {
    mat2 turn = mat2(0.82, 0.57, -0.57, 0.82);
    // Water smooths small details.
    vec4 hollows = textureLod(u_noise, turn * p.xy / 23.0, 3.5), dips = textureLod(u_noise, (turn * turn * p.xy + 1.3) / 8.0, 4.0);
    float low = 0.6 * hollows.b + 0.4 * dips.r;
    float level = smoothstep(0.8, 0.97, n.z), soaks = float(between(M_MEADOW, M_GRASS) || v_material == M_SOIL || v_material == M_GRAVEL);
    float wet = smoothstep(0.95 - 1.1 * u_wetness, 1.25 - 1.1 * u_wetness, low + 0.15 * dips.g);
    float stands = smoothstep(0.0, 0.03, low - (0.70 - 0.38 * u_puddles)) * level * (1.0 - soaks) * step(0.001, u_puddles);
    float film = wet * mix(0.6, 1.0, level) * (1.0 - 0.8 * soaks);
    return vec2(max(film, stands * smoothstep(0.1, 0.4, u_wetness)), stands);
}
#endif

#ifdef SNOW
uniform float u_snow;

// Share of a point that snow covers: level ground first, roads last, because wheels clear tracks. `bare`: melted share.
float snow_on(vec3 p, vec3 n, out float slush) {
    float broad = noise(p.xy, 19.0).r, fine = noise(p.xy, 2.3).g, bare = 0.0;
    slush = 0.0;
#ifdef GROUND
    if (between(M_ASPHALT, M_ASPHALT_OLD) || v_material == M_MARKING || v_material == M_GUTTER || v_material == M_COVER) {
        bare = 0.62;
        slush = smoothstep(0.35, 0.6, fine) * 0.55;
    } else if (v_material == M_SIDEWALK || v_material == M_KERB || v_material == M_PAVING || v_material == M_TACTILE) {
        bare = 0.3;
    }
#endif
#ifdef LEAVES
    n.z = 0.62;
    bare = 0.25;
#endif
    float lies = u_snow * 1.25 - bare + 0.5 * (broad - 0.5) + 0.35 * (fine - 0.5);
    return smoothstep(0.05, 0.3, lies) * smoothstep(0.45, 0.8, n.z);
}
#endif

void leaf_color(vec3 p, inout vec3 color) {
    float tone = leaf_tone(v_local), clump = noise(p.xy + p.z * 0.7, 3.1).g, tree = noise(p.xy, 41.0).b;
    color *= (0.45 + 0.75 * tone) * (0.7 + 0.6 * clump);
    color *= mix(vec3(0.85, 1.0, 0.95), vec3(1.35, 1.12, 0.75), smoothstep(0.25, 0.75, tree));
}

#ifdef PATTERNS
uniform vec4 u_pattern_first[MATERIAL_COUNT];   // linear colour; w: size, metres
uniform vec4 u_pattern_second[MATERIAL_COUNT];  // linear colour; w: motif (see materials.py) and turn, 0 for no pattern

// Random two-colour pattern of a material, with the wear of its own colour.
vec3 patterned(vec2 at, float footprint, vec3 own) {
    vec4 first = u_pattern_first[v_material], second = u_pattern_second[v_material];
    int motif = int(second.w);
    if (motif == 0) return own;
    float angle = 2.0 * PI * fract(second.w), share = 0.0;
    vec2 cell = mat2(cos(angle), sin(angle), -sin(angle), cos(angle)) * at / first.w;
    if (motif == 2) share = mod(floor(cell.x) + floor(cell.y), 2.0);
    else if (motif == 3) share = step(0.5, fract(cell.x));
    else if (motif == 4) share = abs(2.0 * fract(cell.x / 8.0) - 1.0);
    else if (motif == 5) share = texture(u_noise, cell / 12.0).r;
    else if (motif == 6) share = smoothstep(0.45, 0.55, texture(u_noise, cell / 16.0).g);
    if (motif == 2 || motif == 3) share = mix(share, 0.5, smoothstep(0.3, 1.0, footprint / first.w));
    vec3 usual = u_albedo[v_material].rgb;
    float worn = clamp(dot(own, vec3(1.0)) / max(dot(usual, vec3(1.0)), 1e-3), 0.5, 1.5);
    return mix(first.rgb, second.rgb, share) * worn;
}
#endif

// Tangent coordinates run along a wall and up it; gloss is the reflectance relative to one face of a glass pane.
vec3 albedo(vec3 p, vec3 n, out float gloss) {
#ifdef OTHERS
    vec3 color = albedo_of(v_material).rgb;
#else
    vec3 color = u_albedo[v_material].rgb;
#endif
    gloss = 0.0;
    float footprint = length(fwidth(p));  // metres that a pixel covers: patterns finer than that fade to their mean
    bool level = abs(n.z) > 0.75;
    vec2 at = level ? p.xy : vec2(dot(p.xy, normalize(vec2(-n.y, n.x) + 1e-6)), p.z);
    // The noises are rotated relative to each other, walls and streets, which hides their tiling.
    mat2 turn = mat2(0.82, 0.57, -0.57, 0.82);
    vec4 broad = noise(turn * at, 31.0), middle = noise(turn * turn * at + 3.7, 5.9), fine = noise(turn * turn * turn * at, 2.1);
    vec4 streaks = noise(vec2(at.x, at.y * 0.22) + 11.0, 2.7);
    float above = p.z - 0.12;  // the sidewalk
#if defined(GROUND)
    if (between(M_ASPHALT, M_ASPHALT_OLD)) {
        float grit = noise(turn * at, 0.57).g * noise(turn * turn * at, 0.83).r * 2.0;
        color *= 0.84 + 0.16 * broad.r + 0.14 * middle.g + 0.22 * (fine.b - 0.5) + 0.25 * (grit - 0.5);
        color = mix(color, color * 0.72, smoothstep(0.70, 0.80, noise(at, 13.0).a) * 0.5);  // oil and damp
        float crack = abs(noise(at, 17.0).r - 0.5) + 0.05 * smoothstep(0.45, 0.6, broad.b);
        color *= 0.78 + 0.22 * smoothstep(0.0, 0.006 + 0.5 * footprint / 17.0, crack);
    } else if (v_material == M_BITUMEN) {
        color *= 0.8 + 0.5 * fine.g;
    } else if (v_material == M_GUTTER) {
        float dirt = smoothstep(0.35, 0.75, 0.6 * middle.b + 0.5 * fine.g);
        color *= (0.85 + 0.25 * broad.r) * mix(1.0, 0.62, dirt);
    } else if (v_material == M_COVER) {
        float ribs = joints(at / 0.07, vec2(0.22));
        color *= mix(0.75 + 0.6 * ribs, 1.0, smoothstep(0.02, 0.06, footprint)) * (0.7 + 0.6 * middle.g);
    } else if (v_material == M_MARKING) {
        color *= 0.78 + 0.28 * fine.g;
        float worn = smoothstep(0.60, 0.78, 0.6 * noise(turn * at, 0.9).b + 0.4 * middle.r);
        color = mix(color, u_albedo[M_ASPHALT].rgb, worn * 0.6);
    } else if (v_material == M_SIDEWALK || v_material == M_KERB || v_material == M_PAVING) {
        vec2 size = v_material == M_PAVING ? vec2(0.2, 0.1) : v_material == M_KERB ? vec2(0.9) : vec2(0.6, 0.6);
        vec2 cell = at / size;
        if (v_material != M_KERB) cell.x += 0.5 * mod(floor(cell.y), 2.0);
        float tone = texture(u_noise, floor(cell) * 0.137).r, other = texture(u_noise, floor(cell) * 0.071 + 0.4).b;
        float joint = mix(joints(cell, 0.011 / size), 0.05, smoothstep(0.02, 0.08, footprint));
        color *= (0.80 + 0.24 * tone) * (0.90 + 0.16 * broad.g + 0.2 * (fine.g - 0.5));
        if (v_material == M_SIDEWALK) color *= mix(vec3(1.0), vec3(0.80, 0.79, 0.78), smoothstep(0.72, 0.76, other));
        color *= 1.0 - 0.45 * joint;
        color *= 1.0 - 0.3 * smoothstep(0.52, 0.75, middle.a);                                        // stains
        color *= 1.0 - 0.25 * smoothstep(0.84, 0.90, noise(turn * at, 0.7).r) * smoothstep(0.05, 0.01, footprint);  // gum
    } else if (v_material == M_TACTILE) {
        color *= (0.85 + 0.3 * middle.r) * (1.0 - 0.3 * mix(joints(at / 0.1, vec2(0.2)), 0.5, smoothstep(0.02, 0.08, footprint)));
    } else if (v_material == M_GRAVEL || v_material == M_SOIL) {
        color *= 0.6 + 0.35 * middle.g + 0.5 * noise(at, 0.31).b;
    } else if (between(M_MEADOW, M_GRASS)) {
        float blades = noise(turn * at, 0.61).g * noise(turn * turn * at, 0.97).r * 2.0;
        color *= 0.62 + 0.26 * broad.r + 0.28 * middle.g + 0.55 * (fine.g - 0.4) + 0.45 * (blades - 0.5);
        color = mix(color, color * vec3(1.25, 1.08, 0.80), smoothstep(0.40, 0.75, 0.5 * broad.b + 0.5 * middle.b));
        color = mix(color, color * vec3(0.78, 0.95, 0.80), smoothstep(0.55, 0.7, middle.r));
        color = mix(color, u_albedo[M_SOIL].rgb * (0.7 + 0.6 * fine.b), smoothstep(0.70, 0.80, 0.6 * middle.a + 0.4 * fine.a) * 0.4);
    }
#elif defined(WALLS)
    if (between(M_BRICK, M_BRICK_PAINTED)) {
        float row = floor(at.y / 0.075);
        vec2 cell = vec2(at.x / 0.225 + 0.5 * mod(row, 2.0), at.y / 0.075);
        float tone = texture(u_noise, floor(cell) * 0.173).g, other = texture(u_noise, floor(cell) * 0.097).b;
        bool painted = v_material == M_BRICK_PAINTED;
        vec3 mortar = painted ? color * 0.9 : mix(vec3(0.36, 0.34, 0.31), color, 0.25);
        vec3 face = color * (painted ? 0.97 : 0.66 + 0.68 * tone);
        if (!painted) face = mix(face, face * vec3(0.62, 0.58, 0.60), smoothstep(0.66, 0.74, other));
        float joint = joints(cell, vec2(0.025, 0.075));
        color = mix(mix(face, mortar, joint), mix(color * 0.97, mortar, 0.17), smoothstep(0.02, 0.07, footprint));
        color *= 0.86 + 0.22 * broad.r + 0.1 * (middle.g - 0.5);
        color *= 1.0 - 0.16 * smoothstep(0.55, 0.75, streaks.b);
    } else if (between(M_PLASTER, M_CONCRETE)) {
        color *= 0.92 + 0.1 * broad.r + 0.05 * (middle.g - 0.5) + 0.05 * (fine.g - 0.5);
        color *= 1.0 - 0.10 * smoothstep(0.60, 0.9, streaks.b) - 0.08 * smoothstep(0.6, 0.8, middle.a);
        if (v_material == M_CONCRETE) color *= 1.0 - 0.25 * mix(joints(at / vec2(2.4, 1.2), vec2(0.006, 0.012)), 0.02, smoothstep(0.05, 0.2, footprint));
    } else if (between(M_STONE, M_SANDSTONE)) {
        float row = floor(at.y / 0.28);
        float shift = texture(u_noise, vec2(row * 0.37, 0.5)).r * 3.0;
        vec2 cell = vec2(at.x / 0.52 + shift, at.y / 0.28);
        float tone = texture(u_noise, floor(cell) * 0.191).r;
        float joint = mix(joints(cell, vec2(0.02, 0.035)), 0.05, smoothstep(0.03, 0.12, footprint));
        color *= (0.78 + 0.4 * tone) * (0.9 + 0.2 * middle.g + 0.25 * (fine.b - 0.5)) * (1.0 - 0.35 * joint);
        color *= 1.0 - 0.2 * smoothstep(0.55, 0.8, streaks.b);
    } else if (v_material == M_DRESSING) {
        color *= 0.84 + 0.2 * middle.r + 0.12 * (fine.g - 0.5);
    }
    if (above < 1.2) {
        // Rain splashes dirt on the foot of walls.
        color *= mix(vec3(0.66, 0.62, 0.55), vec3(1.0), smoothstep(0.0, 0.25 + 0.7 * middle.r, above));
    }
#elif defined(LEAVES)
    leaf_color(p, color);
#else
    if (between(M_TILES, M_SLATE)) {
        vec2 down = normalize(vec2(n.x, n.y) + 1e-6);
        float slope = p.z / max(sqrt(1.0 - n.z * n.z), 0.2), across = dot(p.xy, vec2(-down.y, down.x));
        bool slate = v_material == M_SLATE;
        vec2 cell = vec2(across, slope) / (slate ? vec2(0.3, 0.22) : vec2(0.27, 0.32));
        if (slate) cell.x += 0.5 * mod(floor(cell.y), 2.0);
        float tone = texture(u_noise, floor(cell) * 0.211).r, course = fract(cell.y), wave = abs(fract(cell.x) - 0.5);
        float laid = (0.70 + 0.5 * tone) * (0.55 + 0.45 * smoothstep(0.0, 0.22, course));
        if (!slate) laid *= 0.72 + 0.4 * smoothstep(0.5, 0.3, wave);
        color *= mix(laid, slate ? 0.9 : 0.88, smoothstep(0.05, 0.2, footprint));
        color *= 0.82 + 0.28 * broad.r + 0.12 * middle.g;
        color = mix(color, vec3(0.20, 0.22, 0.12), 0.45 * smoothstep(0.60, 0.82, 0.7 * middle.b + 0.3 * streaks.g));  // moss
    } else if (between(M_CLADDING_WHITE, M_CLADDING_RED)) {
        float rib = mix(smoothstep(0.1, 0.3, abs(fract(at.x / 0.33) - 0.5)), 0.7, smoothstep(0.05, 0.2, footprint));
        color *= (0.82 + 0.2 * rib) * (0.9 + 0.14 * broad.r + 0.08 * (middle.g - 0.5)) * (1.0 - 0.14 * smoothstep(0.55, 0.85, streaks.b));
    } else if (between(M_SHUTTER_GREEN, M_SHUTTER_BROWN)) {
        color *= 0.75 + 0.4 * mix(fract(at.y / 0.06), 0.5, smoothstep(0.015, 0.05, footprint));
    } else if (between(M_AWNING_RED, M_AWNING_GREEN)) {
        float stripe = step(0.5, fract(dot(p.xy, normalize(vec2(-n.y, n.x) + 1e-6)) / 0.5));
        color = mix(color, vec3(0.78, 0.76, 0.70), stripe) * (0.9 + 0.15 * middle.g);
    } else if (v_material == M_TIMBER) {
        float board = texture(u_noise, vec2(floor(at.x / 0.14) * 0.137, 0.3)).r;
        color *= (0.7 + 0.5 * board) * (0.85 + 0.3 * noise(vec2(at.x * 6.0, at.y * 0.4), 2.0).g);
        color *= 1.0 - 0.4 * mix(step(0.93, fract(at.x / 0.14)), 0.07, smoothstep(0.02, 0.06, footprint));
    } else if (v_material == M_HEDGE) {
        leaf_color(p, color);
    } else if (v_material == M_WOODS) {
        vec2 crown = vec2(at.x, p.z) / 7.0;
        color *= 0.3 + 0.7 * texture(u_noise, turn * crown).g + 0.6 * texture(u_noise, crown * 3.7).b;
    } else if (v_material >= MATERIAL_COUNT) {
        color *= (0.86 + 0.2 * broad.r + 0.1 * (middle.g - 0.5)) * (1.0 - 0.2 * smoothstep(0.55, 0.85, streaks.b));
    } else if (v_material == M_BARK || v_material == M_CABINET || v_material == M_ZINC) {
        color *= 0.8 + 0.35 * fine.g;
    } else if (v_material == M_WINDOW || v_material == M_SHOP_WINDOW) {
        // A dark room, lighter where its walls and furniture catch the daylight.
        bool shop = v_material == M_SHOP_WINDOW;
        float room = texture(u_noise, floor(at / vec2(1.4, 2.9)) * 0.319).r;
        color *= 0.3 + 0.7 * room;
        vec3 goods = texture(u_noise, floor(at / vec2(0.37, 0.52)) * 0.231).rgb - 0.45;
        if (shop) color *= mix(0.6, 1.5, smoothstep(0.2, 0.8, room)) + 2.2 * max(goods, 0.0) * smoothstep(2.4, 1.6, above);
        color = mix(color, vec3(0.20, 0.23, 0.26), 0.5 * smoothstep(0.35, 0.75, broad.r) * float(!shop));  // across the street
        gloss = 1.8;  // two faces of a pane, often two panes
    } else if (v_material == M_CURTAIN || v_material == M_BLIND) {
        float fold = v_material == M_CURTAIN ? texture(u_noise, vec2(at.x * 1.9, 0.2)).g : fract(at.y / 0.07);
        color *= 0.55 + 0.4 * mix(fold, 0.5, smoothstep(0.03, 0.1, footprint));
        gloss = 0.8;
    }
#endif
#ifdef PATTERNS
    if (v_material < MATERIAL_COUNT) color = patterned(at, footprint, color);
#endif
#ifdef SNOW
    float slush, lies = snow_on(p, n, slush);
    color = mix(color, mix(vec3(0.78, 0.80, 0.84), vec3(0.30, 0.28, 0.26), slush), lies * (1.0 - 0.3 * slush));
    gloss *= 1.0 - lies;
#endif
    return color;
}
