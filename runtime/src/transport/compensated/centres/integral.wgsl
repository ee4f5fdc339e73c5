// The product with the transport matrix between the centres (integral.rs), a plane a dispatch: a group a row, whose sums
// are added in a fixed order. The matrix itself is the processor's: its rays go through lists of any length.

struct CentreProduct {
    // Centres: rows and columns of the plane.
    count: u32,
    // The pair of harmonics of the plane, a <= b.
    a: u32,
    b: u32,
    pad_0: u32,
}

@group(0) @binding(0) var<uniform> product_: CentreProduct;
// [receiver][sender].
@group(0) @binding(1) var<storage, read> plane: array<f32>;
// [coefficient][centre], both.
@group(0) @binding(2) var<storage, read> sent: array<f32>;
@group(0) @binding(3) var<storage, read_write> arrived: array<f32>;

var<workgroup> lanes: array<vec2<f32>, 64>;

@compute @workgroup_size(64)
fn multiply(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let row = group.x + group.y * groups.x;
    let n = product_.count;
    var sums = vec2(0.0);
    if row < n {
        for (var h = local; h < n; h += 64u) {
            sums += plane[row * n + h] * vec2(sent[product_.b * n + h], sent[product_.a * n + h]);
        }
    }
    lanes[local] = sums;
    for (var half = 32u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half { lanes[local] += lanes[local + half]; }
    }
    if local == 0u && row < n {
        arrived[product_.a * n + row] += lanes[0].x;
        if product_.a != product_.b { arrived[product_.b * n + row] += lanes[0].y; }
    }
}
