// Depth from every centre along every direction by closed forms (depth.rs): an invocation a centre and direction, which
// goes through the Gaussians in their order.

struct CentreDepth {
    // Gaussians, and directions with their padding.
    count: u32,
    directions: u32,
    pad_0: u32,
    pad_1: u32,
}

@group(0) @binding(0) var<uniform> depth_: CentreDepth;
// Centre and radius, unit space.
@group(0) @binding(1) var<storage, read> gaussians: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> directions: array<vec4<f32>>;
// [centre][direction].
@group(0) @binding(4) var<storage, read_write> depths: array<f32>;

const SQRT_PI = 1.7724539;

@compute @workgroup_size(64)
fn depth_along(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = thread_number(group, groups, local);
    if number >= depth_.count * depth_.directions { return; }
    let at = gaussians[number / depth_.directions].xyz;
    let w = directions[number % depth_.directions].xyz;
    var sum = 0.0;
    for (var h = 0u; h < depth_.count; h++) {
        let radius = gaussians[h].w;
        let to = (gaussians[h].xyz - at) / radius;
        let along = dot(to, w);
        // |to - along w|^2, not d^2 - along^2: far Gaussians would cancel.
        let across = to - along * w;
        let behind = 0.5 * decay(dot(to, to)) * erfcx(abs(along));
        let ahead = decay(dot(across, across)) - behind;
        sum += weights[h] * radius * SQRT_PI * select(ahead, behind, along < 0.0);
    }
    depths[number] = sum;
}
