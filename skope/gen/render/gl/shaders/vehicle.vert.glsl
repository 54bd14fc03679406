// Places a vehicle's body and wheels for their colour: what changes slowly over them is worked out at the vertices.
#version 430
in vec3 in_position;
in vec3 in_normal;
in float in_material;
in float in_part;
uniform mat4 u_model[PARTS];   // mesh -> camera frame
uniform mat4 u_world[PARTS];   // mesh -> world axes, relative to the camera
uniform mat4 u_project;
uniform mat4 u_scenery_sun_map_from;
uniform mat4 u_vehicle_sun_map_from;
out vec3 v_world;
out vec3 v_normal;
out vec3 v_scenery_sun_at;
out vec3 v_vehicle_sun_at;
out vec3 v_local;
out float v_open;
flat out int v_material;

void main() {
    int part = int(in_part + 0.5);
    vec4 camera = u_model[part] * vec4(in_position, 1.0);
    v_local = in_position;
    v_world = (u_world[part] * vec4(in_position, 1.0)).xyz;
    v_normal = mat3(u_world[part]) * in_normal;
    vec4 lifted = vec4(v_world + v_normal * 0.05, 1.0);
    v_scenery_sun_at = (u_scenery_sun_map_from * lifted).xyz;
    v_vehicle_sun_at = (u_vehicle_sun_map_from * lifted).xyz;
    // Near the road and under the body there is less sky.
    float height = part > 0 ? 0.3 : in_position.z;
    v_open = clamp(0.35 + 0.65 * height / 0.9, 0.25, 1.0);
    v_material = int(in_material + 0.5);
    gl_Position = u_project * camera;
}
