// Empties parts of a target. With SCENERY it puts the scenery's depth into the depth buffer, so that what the scenery
// hides is never shaded; STEP is how many of that depth's samples there are per sample of the target, on each axis.
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
