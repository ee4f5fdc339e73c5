// The volume pass of transfer (source.rs): direct light of lit clusters and of suns, to the nodes of the bricks.
//
// It comes after cells.wgsl, which leaves indirect light in the nodes: `add_direct` adds a node's mix of its cluster's
// radiances, blended between the directions around its own; `add_sun` what a sun brings; `finish` the density.
//
// A node on the edge of a square may be rounded to the other side of it here, and the processor marks only the squares
// that it finds. Corners without a direction then weigh next to nothing; across an edge of the cube all of a square's
// are without, and the face beside is taken.

struct Transfer {
    // The eye in node space, and the columns of the linear map to the world, scaled to at most 1: directions only.
    eye: vec4<f32>,
    column_x: vec4<f32>,
    column_y: vec4<f32>,
    column_z: vec4<f32>,
    // Towards the sun, and its irradiance times the albedo.
    toward: vec4<f32>,
    power: vec4<f32>,
    // Nodes of the field, and bricks along each axis.
    dims: vec4<u32>,
    bricks: vec4<u32>,
    // Bricks of this page: the first, and how many.
    first_brick: u32,
    page_bricks: u32,
    // Rows of this dispatch: the first, and how many.
    first_row: u32,
    rows: u32,
    // Directions of a cluster.
    terms: u32,
    // Directions from the eye of this dispatch: the first, and how many; and vectors of each.
    first_view: u32,
    views: u32,
    each_view: u32,
    // Squares along a side of a face of the cube; 0 where light is the same from everywhere.
    squares: u32,
    // The phase function's mean cosine.
    g: f32,
    pad_0: u32,
    pad_1: u32,
}

@group(0) @binding(0) var<uniform> pass_: Transfer;
@group(0) @binding(1) var<storage, read> dense: array<u32>;
// The row of each node, or EMPTY where no light is kept.
@group(0) @binding(2) var<storage, read> lit_rows: array<u32>;
// For each row its cluster, then the bits of its weights.
@group(0) @binding(3) var<storage, read> mixes: array<u32>;
// [view][cluster][1 + terms].
@group(0) @binding(4) var<storage, read> lit: array<vec4<f32>>;
// For each corner of each face its place among the views, or EMPTY.
@group(0) @binding(5) var<storage, read> places: array<u32>;
@group(0) @binding(6) var<storage, read> transmittance: array<f32>;
@group(0) @binding(7) var<storage, read> density: array<f32>;
@group(0) @binding(8) var<storage, read_write> nodes: array<vec4<f32>>;

const EMPTY = 0xffffffffu;

// The node of a thread; one past the box where the thread has none.
fn node_of(thread: u32) -> vec3<u32> {
    if thread >= pass_.page_bricks * 125u { return pass_.dims.xyz; }
    return node_of_brick(dense[pass_.first_brick + thread / 125u], thread % 125u, pass_.bricks);
}

fn in_field(at: vec3<u32>) -> u32 {
    return at.x + pass_.dims.x * (at.y + pass_.dims.y * at.z);
}

// From the eye to a node, in the world's directions.
fn way_to(at: vec3<u32>) -> vec3<f32> {
    let p = vec3<f32>(at) - pass_.eye.xyz;
    return pass_.column_x.xyz * p.x + pass_.column_y.xyz * p.y + pass_.column_z.xyz * p.z;
}

// Places of the four corners around `v` on the face of `axis`, and their weights, 0 for those without a direction; true
// if most of the weight is left.
fn around(v: vec3<f32>, axis: u32, corners: ptr<function, vec4<u32>>, weights: ptr<function, vec4<f32>>) -> bool {
    let major = v[axis];
    let others = vec2(v[(axis + 1u) % 3u], v[(axis + 2u) % 3u]);
    let scale = select(0.0, 1.0 / abs(major), major != 0.0);
    let squares = f32(pass_.squares);
    let place = clamp((others * scale + 1.0) * (0.5 * squares), vec2(0.0), vec2(squares));
    let low = min(vec2<u32>(place), vec2(pass_.squares - 1u));
    let f = place - vec2<f32>(low);
    let n = pass_.squares + 1u;
    let face = 2u * axis + select(0u, 1u, major < 0.0);
    let square = (face * n + low.y) * n + low.x;
    let found = vec4(places[square], places[square + 1u], places[square + n], places[square + n + 1u]);
    let all = vec4((1.0 - f.x) * (1.0 - f.y), f.x * (1.0 - f.y), (1.0 - f.x) * f.y, f.x * f.y);
    *corners = found;
    *weights = select(all, vec4(0.0), found == vec4(EMPTY));
    return dot(*weights, vec4(1.0)) > 0.5;
}

// Radiance of the row at `mix_at` in the view that starts at `view`.
fn mixed(view: u32, mix_at: u32) -> vec3<f32> {
    let at = view + mixes[mix_at] * (1u + pass_.terms);
    var sum = lit[at].xyz;
    for (var t = 1u; t <= pass_.terms; t++) {
        sum += lit[at + t].xyz * bitcast<f32>(mixes[mix_at + t]);
    }
    return sum;
}

@compute @workgroup_size(64)
fn add_direct(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let at = node_of(thread);
    if any(at >= pass_.dims.xyz) { return; }
    let row = lit_rows[in_field(at)];
    if row == EMPTY || row < pass_.first_row || row - pass_.first_row >= pass_.rows { return; }
    let mix_at = (row - pass_.first_row) * (1u + pass_.terms);
    var sum = vec3(0.0);
    if pass_.squares == 0u {
        sum = mixed(0u, mix_at);
    } else {
        let way = way_to(at);
        let size = abs(way);
        // Axes from the largest component to the smallest.
        var first = select(select(2u, 1u, size.y >= size.z), 0u, size.x >= size.y && size.x >= size.z);
        let a = (first + 1u) % 3u;
        let b = (first + 2u) % 3u;
        let second = select(b, a, size[a] >= size[b]);
        var corners = vec4(EMPTY);
        var weights = vec4(0.0);
        if !around(way, first, &corners, &weights) && !around(way, second, &corners, &weights) {
            around(way, 3u - first - second, &corners, &weights);
        }
        weights /= max(dot(weights, vec4(1.0)), 1e-30);
        for (var c = 0u; c < 4u; c++) {
            let view = corners[c];
            if view == EMPTY || view < pass_.first_view || view - pass_.first_view >= pass_.views { continue; }
            sum += weights[c] * mixed((view - pass_.first_view) * pass_.each_view, mix_at);
        }
    }
    nodes[thread] += vec4(sum, 0.0);
}

@compute @workgroup_size(64)
fn add_sun(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let at = node_of(thread);
    if any(at >= pass_.dims.xyz) { return; }
    let row = lit_rows[in_field(at)];
    if row == EMPTY { return; }
    let way = way_to(at);
    let largest = max(abs(way.x), max(abs(way.y), abs(way.z)));
    let unit = select(vec3(0.0, 0.0, 1.0), normalize(way / max(largest, 1e-30)), largest > 0.0);
    let scattered = phase(pass_.g, dot(unit, pass_.toward.xyz));
    nodes[thread] += vec4(scattered * pass_.power.xyz * transmittance[row], 0.0);
}

@compute @workgroup_size(64)
fn finish(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let at = node_of(thread);
    if any(at >= pass_.dims.xyz) { return; }
    // A truncated series can dip below zero; radiance cannot.
    nodes[thread] = vec4(max(nodes[thread].xyz, vec3(0.0)), density[in_field(at)]);
}
