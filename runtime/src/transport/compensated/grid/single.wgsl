// Single scattering on a grid (single.rs): beams swept through the density, many at a time.
//
// `carry`, a thread a ray: optical depth of density along each beam. `light`, a thread a node near density: what the
// beams, in their order, add to up to 16 coefficients of one channel.

struct Single {
    // Nodes of the grid.
    dims: vec4<u32>,
    // Beams of the dispatch, the first of them, and rays of the widest.
    directions: u32,
    first_direction: u32,
    most_rays: u32,
    // Values that a beam's rays leave.
    carried_stride: u32,
    // Nodes near density.
    near: u32,
    channel: u32,
    channels: u32,
    // Extinction of the channel, per unit density and world length.
    sigma_t: f32,
    // The first of 16 coefficients, and vectors of weights a beam and channel.
    first_coefficient: u32,
    quads: u32,
    // Planes of the buffer: the first, how many, and values of each.
    first_plane: u32,
    planes: u32,
    plane_stride: u32,
    // 1 where planes hold the nodes near density alone.
    compact: u32,
    // 1 for the first beams.
    starts: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> single: Single;
// Four coefficients each: [beam][channel][quads].
@group(0) @binding(5) var<storage, read> weights: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> carried: array<f32>;
@group(0) @binding(7) var<storage, read_write> planes: array<f32>;

@compute @workgroup_size(64)
fn carry(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let direction = thread / single.most_rays;
    let number = thread % single.most_rays;
    if direction >= single.directions { return; }
    let path = paths[direction];
    if number >= path.extent_columns * path.extent_rows { return; }
    let at = vec2(number % path.extent_columns, number / path.extent_columns);
    let half = 0.5 * path.length;
    var depth = 0.0;
    var before = 0.0;
    for (var step = 0u; step < path.slices; step++) {
        let shift = shifts[path.first_shift + step];
        // A ray below node 0 wraps to a large number.
        let ray = at - shift.base;
        if ray.x > path.columns || ray.y > path.rows { continue; }
        if between_nodes(path, ray) {
            let met = met_density(path, step, ray, ray_weights(shift.fraction));
            depth += half * (before + met);
            before = met;
        }
        carried[direction * single.carried_stride + ray_place(path, step, ray)] = depth;
    }
}

@compute @workgroup_size(64)
fn light(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= single.near { return; }
    let node = near[thread];
    let place = select(node, thread, single.compact == 1u);
    var sums = array<vec4<f32>, 4>();
    for (var k = 0u; k < 16u; k++) {
        let plane = (single.first_coefficient + k) * single.channels + single.channel - single.first_plane;
        if single.starts == 0u && plane < single.planes { sums[k / 4u][k % 4u] = planes[plane * single.plane_stride + place]; }
    }
    for (var direction = 0u; direction < single.directions; direction++) {
        let path = paths[direction];
        let on = on_path(path, single.dims.xyz, node);
        let step = slice_of(path, on.z);
        let around = node_weights(shifts[path.first_shift + step].fraction);
        let low = direction * single.carried_stride + ray_place(path, step, on.xy);
        let high = low + path.columns + 1u;
        let depth = dot(around, vec4(carried[low], carried[low + 1u], carried[high], carried[high + 1u]));
        let through = exp_neg(single.sigma_t * depth);
        let beam = (single.first_direction + direction) * single.channels + single.channel;
        let first = beam * single.quads + single.first_coefficient / 4u;
        for (var quad = 0u; quad < 4u; quad++) { sums[quad] += weights[first + quad] * through; }
    }
    for (var k = 0u; k < 16u; k++) {
        let plane = (single.first_coefficient + k) * single.channels + single.channel - single.first_plane;
        if plane < single.planes { planes[plane * single.plane_stride + place] = sums[k / 4u][k % 4u]; }
    }
}
