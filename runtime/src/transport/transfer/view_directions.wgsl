// What each direction of the mesh brings into each direction that the smoke is seen in (view_directions.rs, source.rs).
//
// `weigh` first: a phase function narrower than the mesh is made to add up to 1 over its directions.

struct ViewDirections {
    // The phase function's mean cosine.
    g: f32,
    // Directions of the mesh.
    directions: u32,
    // Directions from the eye of this dispatch: the first, and how many.
    first_view: u32,
    views: u32,
}

@group(0) @binding(0) var<uniform> seen: ViewDirections;
// Directions of the mesh, and the solid angle of each.
@group(0) @binding(1) var<storage, read> mesh: array<vec4<f32>>;
// Irradiance from each of them, times the albedo.
@group(0) @binding(2) var<storage, read> irradiance: array<vec4<f32>>;
// Directions from the eye, and what the phase function is scaled by there.
@group(0) @binding(3) var<storage, read_write> views: array<vec4<f32>>;
// [direction][view].
@group(0) @binding(4) var<storage, read_write> light: array<vec4<f32>>;

@compute @workgroup_size(64)
fn weigh(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= seen.views { return; }
    let view = views[seen.first_view + thread].xyz;
    var whole = 0.0;
    for (var q = 0u; q < seen.directions; q++) {
        whole += mesh[q].w * phase(seen.g, dot(view, mesh[q].xyz));
    }
    // The least that f32 holds without losing digits.
    views[seen.first_view + thread].w = 1.0 / max(whole, 1.1754944e-38);
}

@compute @workgroup_size(64)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= seen.views * seen.directions { return; }
    let view = views[seen.first_view + thread % seen.views];
    let q = thread / seen.views;
    light[thread] = view.w * phase(seen.g, dot(view.xyz, mesh[q].xyz)) * irradiance[q];
}
