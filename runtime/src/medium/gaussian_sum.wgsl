// The sum of Gaussians on the voxels of a box (gaussian_sum.rs): the same cut, factors and order of sums.
//
// A group does a brick of 8^3 voxels, and goes through the Gaussians 64 at a time. Each thread makes the tables of one,
// eight factors an axis, and marks it if it reaches the brick; then each sums the marked ones, in their order, for eight
// voxels along z. A place is counted from the voxel that is nearest to the centre, so that differences are exact in f32.

struct GaussianSum {
    // Voxels of the box, and bricks.
    dims: vec4<u32>,
    bricks: vec4<u32>,
    count: u32,
    pad_0: u32,
    pad_1: u32,
    pad_2: u32,
}

@group(0) @binding(0) var<uniform> box_: GaussianSum;
// Two for each Gaussian: the voxel nearest to its centre, i32, and the bits of its weight; the bits of how far the centre
// is from that voxel, and of a voxel's side over the radius.
@group(0) @binding(1) var<storage, read> gaussians: array<vec4<u32>>;
// Nodes of the field, which has one more than the box on each side.
@group(0) @binding(2) var<storage, read_write> density: array<f32>;

// The support's square in radii.
const LIMIT = 9.0;

// For each of 64 Gaussians: exp(-u^2) along x, and y; the latter's u^2.
var<workgroup> x_factors: array<f32, 512>;
var<workgroup> y_factors: array<f32, 512>;
var<workgroup> y_squares: array<f32, 512>;
// The weight times exp(-u^2) along z, and u^2, four voxels a vector.
var<workgroup> z_factors: array<vec4<f32>, 128>;
var<workgroup> z_squares: array<vec4<f32>, 128>;
// A bit for each that reaches the brick.
var<workgroup> near: array<atomic<u32>, 2>;

// exp(-t) for 0 <= t < 80, as on the processor.
fn exp_of_minus(t: f32) -> f32 {
    let k = round(-1.442695 * t);
    let f = (-t - k * 0.6933594) - k * -2.1219444e-4;
    var p = 1.0 / 5040.0;
    p = p * f + 1.0 / 720.0;
    p = p * f + 1.0 / 120.0;
    p = p * f + 1.0 / 24.0;
    p = p * f + 1.0 / 6.0;
    p = p * f + 0.5;
    p = p * f + 1.0;
    p = p * f + 1.0;
    return p * bitcast<f32>(u32(i32(k) + 127) << 23u);
}

// u^2 of voxel `i`, and exp(-u^2) within the support.
fn factor(i: u32, nearest: u32, rest: u32, inverse: f32) -> vec2<f32> {
    let u = (f32(i32(i) - bitcast<i32>(nearest)) - bitcast<f32>(rest)) * inverse;
    let t = u * u;
    let is_inside = t < LIMIT;
    return vec2(t, select(0.0, exp_of_minus(select(0.0, t, is_inside)), is_inside));
}

@compute @workgroup_size(64)
fn sum_gaussians(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let b = group.x + group.y * groups.x;
    let n = box_.bricks;
    if b >= n.x * n.y * n.z { return; }
    let first = vec3(b % n.x, b / n.x % n.y, b / n.x / n.y) * 8u;
    let column = vec2(local % 8u, local / 8u);
    var low = vec4(0.0);
    var high = vec4(0.0);
    for (var tile = 0u; tile < box_.count; tile += 64u) {
        // The tables of the tile before are done with.
        workgroupBarrier();
        if local < 2u { atomicStore(&near[local], 0u); }
        workgroupBarrier();
        if tile + local < box_.count {
            let a = gaussians[2u * (tile + local)];
            let c = gaussians[2u * (tile + local) + 1u];
            let inverse = bitcast<f32>(c.w);
            var reaches = vec3(0.0);
            for (var i = 0u; i < 8u; i++) {
                let x = factor(first.x + i, a.x, c.x, inverse);
                let y = factor(first.y + i, a.y, c.y, inverse);
                let z = factor(first.z + i, a.z, c.z, inverse);
                x_factors[local * 8u + i] = x.y;
                y_factors[local * 8u + i] = y.y;
                y_squares[local * 8u + i] = y.x;
                z_factors[local * 2u + i / 4u][i % 4u] = bitcast<f32>(a.w) * z.y;
                z_squares[local * 2u + i / 4u][i % 4u] = z.x;
                reaches = max(reaches, vec3(x.y, y.y, z.y));
            }
            if all(reaches > vec3(0.0)) { atomicOr(&near[local / 32u], 1u << (local % 32u)); }
        }
        workgroupBarrier();
        for (var half = 0u; half < 2u; half++) {
            var left = atomicLoad(&near[half]);
            while left != 0u {
                let g = half * 32u + firstTrailingBit(left);
                left &= left - 1u;
                let x = x_factors[g * 8u + column.x];
                let y = y_factors[g * 8u + column.y];
                let square = y_squares[g * 8u + column.y];
                let is_low = z_squares[g * 2u] + square < vec4(LIMIT);
                let is_high = z_squares[g * 2u + 1u] + square < vec4(LIMIT);
                low += select(vec4(0.0), z_factors[g * 2u] * y * x, is_low);
                high += select(vec4(0.0), z_factors[g * 2u + 1u] * y * x, is_high);
            }
        }
    }
    let at = first + vec3(column, 0u);
    if any(at >= box_.dims.xyz) { return; }
    let width = box_.dims.x + 2u;
    let slice = width * (box_.dims.y + 2u);
    for (var k = 0u; k < min(8u, box_.dims.z - at.z); k++) {
        let sum = select(low[k % 4u], high[k % 4u], k >= 4u);
        density[at.x + 1u + width * (at.y + 1u) + slice * (at.z + k + 1u)] = sum;
    }
}
