// Place a mesh: u_model transforms the points of each part to the camera frame (x right, y down, z forward),
// u_project from there to the window.
#version 430
in vec3 in_position;
in vec3 in_normal;
in float in_material;
in float in_part;
uniform mat4 u_model[PARTS];   // mesh -> camera frame
uniform mat4 u_world[PARTS];   // mesh -> world axes, relative to the camera
uniform mat4 u_project;        // camera frame -> clip space; image rows run down in the target, so reads need no flip
out vec3 v_world;
out vec3 v_local;
out vec3 v_normal;
flat out int v_material;

void main() {
    int part = int(in_part + 0.5);
    vec4 camera = u_model[part] * vec4(in_position, 1.0);
    v_world = (u_world[part] * vec4(in_position, 1.0)).xyz;
    v_local = in_position;
    v_normal = mat3(u_world[part]) * in_normal;
    v_material = int(in_material + 0.5);
    gl_Position = u_project * camera;
}
