// Multiple scattering on a grid (scatter.rs): what a source radiance sends to every node near density, one channel at a
// time, many ordinates at a time.
//
// `look` sums the source up along each ordinate, a thread an ordinate and node; `carry`, a thread a ray, takes radiance,
// depth and opacity from slice to slice; `project` adds what reaches a node, times factors, to up to 16 coefficients.
// `spread` puts a plane of the nodes near density among all nodes.

struct Scatter {
    // Nodes of the grid.
    dims: vec4<u32>,
    // Ordinates of the dispatch, the first of them, and rays of the widest.
    directions: u32,
    first_direction: u32,
    most_rays: u32,
    // Rays of all slices of an ordinate: a value of each quantity.
    carried_stride: u32,
    // Nodes near density, and all.
    near: u32,
    nodes: u32,
    channel: u32,
    channels: u32,
    // Extinction of the channel, per unit density and world length.
    sigma_t: f32,
    // The first of 16 coefficients; all coefficients; and vectors of them an ordinate and channel.
    first_coefficient: u32,
    coefficients: u32,
    quads: u32,
    // Planes of the buffer: the first, and how many.
    first_plane: u32,
    planes: u32,
    // 1 for the first part of a sum.
    starts: u32,
    // Values before the plane that is spread.
    target_start: u32,
}

@group(0) @binding(0) var<uniform> scatter: Scatter;
// Four coefficients each: [ordinate][channel][quads]. For `look` harmonics; for `project` times weight and gain.
@group(0) @binding(5) var<storage, read> factors: array<vec4<f32>>;
// Source radiance along each ordinate, in the layout of its axis; for `spread` planes of all nodes.
@group(0) @binding(6) var<storage, read_write> along: array<f32>;
// Radiance, depth of density and opacity of each ordinate's rays.
@group(0) @binding(7) var<storage, read_write> carried: array<f32>;
// Planes of the nodes near density.
@group(0) @binding(8) var<storage, read_write> planes: array<f32>;

@compute @workgroup_size(64)
fn look(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let direction = thread / scatter.near;
    let rank = thread % scatter.near;
    if direction >= scatter.directions { return; }
    let path = paths[direction];
    let place = direction * scatter.nodes + layout_place(path, on_path(path, scatter.dims.xyz, near[rank]));
    let first = ((scatter.first_direction + direction) * scatter.channels + scatter.channel) * scatter.quads;
    var sum = 0.0;
    if scatter.starts == 0u { sum = along[place]; }
    for (var k = 0u; k < scatter.coefficients; k++) {
        let plane = k * scatter.channels + scatter.channel - scatter.first_plane;
        if plane < scatter.planes { sum += factors[first + k / 4u][k % 4u] * planes[plane * scatter.near + rank]; }
    }
    along[place] = sum;
}

@compute @workgroup_size(64)
fn carry(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let direction = thread / scatter.most_rays;
    let number = thread % scatter.most_rays;
    if direction >= scatter.directions { return; }
    let path = paths[direction];
    if number >= path.extent_columns * path.extent_rows { return; }
    let at = vec2(number % path.extent_columns, number / path.extent_columns);
    let half = 0.5 * path.length;
    let first = direction * 3u * scatter.carried_stride;
    // No density is negative: the ray has not met the grid.
    var before = -1.0;
    var source_before = 0.0;
    var radiance = 0.0;
    var total = 0.0;
    var opacity = 0.0;
    for (var step = 0u; step < path.slices; step++) {
        let shift = shifts[path.first_shift + step];
        // A ray below node 0 wraps to a large number.
        let ray = at - shift.base;
        if ray.x > path.columns || ray.y > path.rows { continue; }
        if between_nodes(path, ray) {
            let weights = ray_weights(shift.fraction);
            let met = met_density(path, step, ray, weights);
            let depth = half * (max(before, 0.0) + met);
            total += depth;
            let x = scatter.sigma_t * depth;
            let kept = exp_neg_and_rest(x);
            let near_end = kept.y * near_share(x, kept.y);
            let far_end = kept.y - near_end;
            opacity = opacity * kept.x + (near_end + far_end);
            let corner = direction * scatter.nodes + layout_place(path, vec3(ray - 1u, slice_of(path, step)));
            let above = corner + path.row_stride;
            let source = dot(weights, vec4(along[corner], along[corner + 1u], along[above], along[above + 1u]));
            // A ray that enters from the side has no source behind it yet: take the one ahead.
            let behind = select(source_before, source, before < 0.0);
            radiance = radiance * kept.x + behind * far_end + source * near_end;
            before = met;
            source_before = source;
        }
        let place = first + ray_place(path, step, ray);
        carried[place] = radiance;
        carried[place + scatter.carried_stride] = total;
        carried[place + 2u * scatter.carried_stride] = opacity;
    }
}

// What the rays around a node carry, between them.
fn interpolated(low: u32, columns: u32, around: vec4<f32>) -> f32 {
    let high = low + columns + 1u;
    return dot(around, vec4(carried[low], carried[low + 1u], carried[high], carried[high + 1u]));
}

@compute @workgroup_size(64)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = thread_number(group, groups, local);
    if rank >= scatter.near { return; }
    let node = near[rank];
    var sums = array<vec4<f32>, 4>();
    for (var k = 0u; k < 16u; k++) {
        let plane = (scatter.first_coefficient + k) * scatter.channels + scatter.channel - scatter.first_plane;
        if plane < scatter.planes { sums[k / 4u][k % 4u] = planes[plane * scatter.near + rank]; }
    }
    for (var direction = 0u; direction < scatter.directions; direction++) {
        let path = paths[direction];
        let on = on_path(path, scatter.dims.xyz, node);
        let step = slice_of(path, on.z);
        let around = node_weights(shifts[path.first_shift + step].fraction);
        let low = direction * 3u * scatter.carried_stride + ray_place(path, step, on.xy);
        let depth = interpolated(low + scatter.carried_stride, path.columns, around);
        let opacity = interpolated(low + 2u * scatter.carried_stride, path.columns, around);
        // Where the rays are empty they carry no radiance either.
        let factor = exp_neg_and_rest(scatter.sigma_t * depth).y / max(opacity, 1e-30);
        let reached = interpolated(low, path.columns, around) * factor;
        let ordinate = (scatter.first_direction + direction) * scatter.channels + scatter.channel;
        let first = ordinate * scatter.quads + scatter.first_coefficient / 4u;
        for (var quad = 0u; quad < 4u; quad++) { sums[quad] += factors[first + quad] * reached; }
    }
    for (var k = 0u; k < 16u; k++) {
        let plane = (scatter.first_coefficient + k) * scatter.channels + scatter.channel - scatter.first_plane;
        if plane < scatter.planes { planes[plane * scatter.near + rank] = sums[k / 4u][k % 4u]; }
    }
}

@compute @workgroup_size(64)
fn spread(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let rank = thread_number(group, groups, local);
    if rank >= scatter.near { return; }
    along[scatter.target_start + near[rank]] = planes[scatter.first_plane * scatter.near + rank];
}
