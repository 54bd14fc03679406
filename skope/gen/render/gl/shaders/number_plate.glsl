// The text of number plates. It needs `v_local`, `u_plate` and `scrambled`.
// Seven characters of 3 x 5 dots, from the viewer's left; plates hang at multiples of 0.125 m (see parts.py).
const int GLYPHS[30] = int[](
    0x7B6F, 0x2C97, 0x73E7, 0x72CF, 0x5BC9, 0x79CF, 0x79EF, 0x7252, 0x7BEF, 0x7BCF,  // 0 .. 9
    0x2BED, 0x6BAE, 0x3923, 0x6B6E, 0x79A7, 0x79A4, 0x396B, 0x5BED, 0x126A, 0x5BAD,  // A B C D E F G H J K
    0x4927, 0x5FED, 0x6BA4, 0x6BB5, 0x388E, 0x7492, 0x5B6F, 0x5B6A, 0x5AAD, 0x72A7); // L M P R S T U V X Z
vec3 plate() {
    vec2 at = vec2(v_local.x > 0.0 ? v_local.y : -v_local.y, fract(v_local.z / 0.125 + 1e-4) * 0.125);
    if (at.x < -0.228) return vec3(0.02, 0.06, 0.35);
    float column = (at.x + 0.205) / 0.062;
    vec2 dot_at = vec2(fract(column) * 4.6, (0.09 - at.y) / 0.0145);
    int which = int(floor(column));
    if (which < 0 || which > 6 || dot_at.x >= 3.0 || dot_at.y < 0.0 || dot_at.y >= 5.0) return vec3(-1.0);
    uint number = scrambled(uint(u_plate) * 8u + uint(which));
    int glyph = which < 2 || which > 4 ? 10 + int(number % 20u) : int(number % 10u);
    int bit = 14 - (int(dot_at.y) * 3 + int(dot_at.x));
    return ((GLYPHS[glyph] >> bit) & 1) != 0 ? vec3(0.015) : vec3(-1.0);
}
