// The product of a matrix that stays and a light (product.rs): out[column][r] = sum over k of left[k, r] right[k][column].
//
// Rows come in groups of `inner` whose terms lie together: left is [row][k][inner], and r = row * inner + place. A thread
// sums four of them, so that what it reads of the light serves four times. Sums run in the processor's order.

struct Product {
    // Colour channels that the rows are for, 1 or 0.
    channels: vec4<f32>,
    // Rows times inner.
    rows: u32,
    depth: u32,
    inner: u32,
    columns: u32,
}

@group(0) @binding(0) var<uniform> product: Product;
@group(0) @binding(1) var<storage, read> left: array<f32>;
@group(0) @binding(2) var<storage, read> right: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> out: array<vec4<f32>>;

// The first term of row r.
fn start(r: u32) -> u32 {
    let row = min(r, product.rows - 1u);
    return row / product.inner * product.depth * product.inner + row % product.inner;
}

@compute @workgroup_size(64)
fn multiply(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let column = thread % product.columns;
    let first = thread / product.columns * 4u;
    if first >= product.rows { return; }
    var at = vec4(start(first), start(first + 1u), start(first + 2u), start(first + 3u));
    var sums = array<vec4<f32>, 4>();
    for (var k = 0u; k < product.depth; k++) {
        let light = right[k * product.columns + column];
        sums[0] += left[at.x] * light;
        sums[1] += left[at.y] * light;
        sums[2] += left[at.z] * light;
        sums[3] += left[at.w] * light;
        at += product.inner;
    }
    for (var i = 0u; i < min(4u, product.rows - first); i++) {
        out[column * product.rows + first + i] = sums[i] * product.channels;
    }
}
