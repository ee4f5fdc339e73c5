// Indirect light (cells.rs, source.rs): what each cell sends towards the eye, and that at the nodes of the bricks.
//
// A cell mixes the lit moments of its cluster and reads them along its way at once: its own moments are never stored,
// which would be 256 bytes a cell. The last component of a cell is 1, so that weights of cells without density, which
// have no place, are left out of the mean.

struct Cells {
    // The eye in node space, and the columns of the linear map to the world, scaled to at most 1: directions only.
    eye: vec4<f32>,
    column_x: vec4<f32>,
    column_y: vec4<f32>,
    column_z: vec4<f32>,
    // Nodes of the field, bricks, and cells along each axis.
    dims: vec4<u32>,
    bricks: vec4<u32>,
    cells: vec4<u32>,
    // Nodes along a cell.
    side: u32,
    bands: u32,
    // Directions of a cluster.
    terms: u32,
    // 1 where this is the first set of rows.
    starts: u32,
    // Cells of this dispatch: the first, and how many.
    first_row: u32,
    rows: u32,
    // Bricks of this page: the first, and how many.
    first_brick: u32,
    page_bricks: u32,
}

@group(0) @binding(0) var<uniform> pass_: Cells;
@group(0) @binding(1) var<storage, read> dense: array<u32>;
// The row of each node, or EMPTY where no light is kept.
@group(0) @binding(2) var<storage, read> lit_rows: array<u32>;
// The place of each cell among those with density, or EMPTY; and which cell each place is.
@group(0) @binding(3) var<storage, read> places: array<u32>;
@group(0) @binding(4) var<storage, read> numbers: array<u32>;
// For each cell its cluster, then the bits of its weights.
@group(0) @binding(5) var<storage, read> mixes: array<u32>;
// [cluster][1 + terms][lm].
@group(0) @binding(6) var<storage, read> lit: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> sent: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> nodes: array<vec4<f32>>;

const EMPTY = 0xffffffffu;

@compute @workgroup_size(64)
fn send(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= pass_.rows { return; }
    let b = numbers[pass_.first_row + thread];
    let cell = vec3(b % pass_.cells.x, b / pass_.cells.x % pass_.cells.y, b / pass_.cells.x / pass_.cells.y);
    let p = (vec3<f32>(cell) + 0.5) * f32(pass_.side) - pass_.eye.xyz;
    let along = pass_.column_x.xyz * p.x + pass_.column_y.xyz * p.y + pass_.column_z.xyz * p.z;
    let largest = max(abs(along.x), max(abs(along.y), abs(along.z)));
    var y = harmonics(pass_.bands, select(vec3(0.0, 0.0, 1.0), normalize(along / max(largest, 1e-30)), largest > 0.0));
    let mix_at = thread * (1u + pass_.terms);
    let n = pass_.bands * pass_.bands;
    let cluster = mixes[mix_at] * (1u + pass_.terms) * n;
    var sum = vec3(0.0);
    for (var lm = 0u; lm < n; lm++) {
        var moment = lit[cluster + lm].xyz;
        for (var t = 1u; t <= pass_.terms; t++) {
            moment += bitcast<f32>(mixes[mix_at + t]) * lit[cluster + t * n + lm].xyz;
        }
        sum += moment * y[lm];
    }
    let before = select(sent[pass_.first_row + thread].xyz, vec3(0.0), pass_.starts == 1u);
    sent[pass_.first_row + thread] = vec4(before + sum, 1.0);
}

// The mean of the cells around a node, by their weights; black if none has density.
fn between(at: vec3<u32>) -> vec3<f32> {
    let place = vec3<f32>(at) / f32(pass_.side) - 0.5;
    let low = vec3<i32>(floor(place));
    let f = place - floor(place);
    var sum = vec4(0.0);
    for (var corner = 0; corner < 8; corner++) {
        let up = vec3(corner & 1, (corner >> 1u) & 1, corner >> 2u);
        let cell = low + up;
        if any(cell < vec3(0)) || any(cell >= vec3<i32>(pass_.cells.xyz)) { continue; }
        let c = vec3<u32>(cell);
        let number = places[c.x + pass_.cells.x * (c.y + pass_.cells.y * c.z)];
        if number == EMPTY { continue; }
        let w = select(1.0 - f, f, up == vec3(1));
        sum += sent[number] * (w.x * w.y * w.z);
    }
    return select(vec3(0.0), sum.xyz / max(sum.w, 1e-30), sum.w > 0.0);
}

@compute @workgroup_size(64)
fn interpolate(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= pass_.page_bricks * 125u { return; }
    let at = node_of_brick(dense[pass_.first_brick + thread / 125u], thread % 125u, pass_.bricks);
    var sum = vec3(0.0);
    if all(at < pass_.dims.xyz) && lit_rows[at.x + pass_.dims.x * (at.y + pass_.dims.y * at.z)] != EMPTY {
        sum = between(at);
    }
    nodes[thread] = vec4(sum, 0.0);
}
