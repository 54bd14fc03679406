// Clear parts of a target. SCENERY: write the scenery's depth to the depth buffer, so that pixels that the scenery
// hides are never shaded. STEP: number of samples of that depth per sample of the target, on each axis.
#version 430
uniform sampler2D u_scenery;
out vec4 out_color;

void main() {
    out_color = vec4(0.0);
#ifdef SCENERY
    gl_FragDepth = texelFetch(u_scenery, ivec2(gl_FragCoord.xy) * STEP, 0).r;
#else
    gl_FragDepth = 1.0;
#endif
}
