// The volume pass of the route through centres (volume_pass.rs): what the Gaussians send towards the eye, to the nodes of
// the bricks, weighted by what each has of the density there.
//
// A group of threads shades one brick. Its threads first find the Gaussians that reach the brick, 32 each, as the bits of
// a word; then each node goes through the bits in order, so that sums do not depend on which thread was first.

struct CentreVolume {
    // The eye, unit space.
    eye: vec4<f32>,
    // Nodes of the field, and bricks along each axis.
    dims: vec4<u32>,
    bricks: vec4<u32>,
    // Bricks of this page: the first, and how many.
    first_brick: u32,
    page_bricks: u32,
    // Gaussians, and bands of what they send.
    count: u32,
    bands: u32,
}

@group(0) @binding(0) var<uniform> pass_: CentreVolume;
@group(0) @binding(1) var<storage, read> dense: array<u32>;
// Centre and radius, unit space.
@group(0) @binding(2) var<storage, read> gaussians: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> weights: array<f32>;
// [Gaussian][band^2], RGB.
@group(0) @binding(4) var<storage, read> radiance: array<vec4<f32>>;
// Unit coordinates of the nodes along x, then y, then z.
@group(0) @binding(5) var<storage, read> axes: array<f32>;
@group(0) @binding(6) var<storage, read> density: array<f32>;
@group(0) @binding(7) var<storage, read_write> nodes: array<vec4<f32>>;

// A Gaussian ends after three radii.
const SQUARE_CUT = 9.0;
// Sums below this, relative to the largest weight, count as uncovered.
const COVERED = 1e-10;
// Nodes along a side of the cubes that share a nearest Gaussian.
const SHARED = 8u;

var<workgroup> reaching: array<u32, 64>;

fn place_of(at: vec3<u32>) -> vec3<f32> {
    return vec3(axes[at.x], axes[pass_.dims.x + at.y], axes[pass_.dims.x + pass_.dims.y + at.z]);
}

fn square_distance(h: u32, at: vec3<f32>) -> f32 {
    let d = (at - gaussians[h].xyz) / gaussians[h].w;
    return dot(d, d);
}

// The bits of the Gaussians `first` to `first + 31` that reach the box.
fn reach(first: u32, low: vec3<f32>, high: vec3<f32>) -> u32 {
    var bits = 0u;
    for (var h = first; h < min(first + 32u, pass_.count); h++) {
        let nearest = clamp(gaussians[h].xyz, low, high);
        // A little more than the cut: nodes decide for themselves.
        if square_distance(h, nearest) <= SQUARE_CUT * 1.001 && weights[h] > 0.0 { bits |= 1u << (h - first); }
    }
    return bits;
}

// The Gaussian with the largest untruncated term at a place.
fn dominant(at: vec3<f32>) -> u32 {
    var best = 0u;
    var least = 3e38;
    for (var h = 0u; h < pass_.count; h++) {
        if weights[h] > 0.0 {
            let value = square_distance(h, at) - log(weights[h]);
            if value < least {
                best = h;
                least = value;
            }
        }
    }
    return best;
}

@compute @workgroup_size(64)
fn interpolate(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let brick = group.x + group.y * groups.x;
    // The same for all threads of a group.
    if brick >= pass_.page_bricks { return; }
    let b = dense[pass_.first_brick + brick];
    let low = place_of(min(node_of_brick(b, 0u, pass_.bricks), pass_.dims.xyz - 1u));
    let high = place_of(min(node_of_brick(b, 124u, pass_.bricks), pass_.dims.xyz - 1u));
    for (var number = local; number < 128u; number += 64u) {
        let at = node_of_brick(b, number, pass_.bricks);
        let inside = number < 125u && all(at < pass_.dims.xyz);
        let place = place_of(min(at, pass_.dims.xyz - 1u));
        let way = place - pass_.eye.xyz;
        let largest = max(abs(way.x), max(abs(way.y), abs(way.z)));
        // At the eye itself every direction is as good as another.
        let unit = select(vec3(0.0, 0.0, 1.0), normalize(way / max(largest, 1e-30)), largest > 0.0);
        var y = harmonics(pass_.bands, unit);
        let each = pass_.bands * pass_.bands;
        var sum = vec3(0.0);
        var covered = 0.0;
        for (var first = 0u; first < pass_.count; first += 2048u) {
            workgroupBarrier();
            reaching[local] = reach(first + 32u * local, low, high);
            workgroupBarrier();
            for (var word = 0u; word < 64u; word++) {
                for (var bits = reaching[word]; bits != 0u; bits &= bits - 1u) {
                    let h = first + 32u * word + firstTrailingBit(bits);
                    let square = square_distance(h, place);
                    if square > SQUARE_CUT { continue; }
                    let share = weights[h] * exp(-square);
                    var sent = vec3(0.0);
                    for (var k = 0u; k < each; k++) { sent += radiance[h * each + k].xyz * y[k]; }
                    sum += share * sent;
                    covered += share;
                }
            }
        }
        if covered >= COVERED {
            sum /= covered;
        } else if inside && pass_.count > 0u {
            let corner = at / SHARED * SHARED;
            let last = min(corner + (SHARED - 1u), pass_.dims.xyz - 1u);
            let h = dominant(0.5 * (place_of(corner) + place_of(last)));
            sum = vec3(0.0);
            for (var k = 0u; k < each; k++) { sum += radiance[h * each + k].xyz * y[k]; }
        }
        if inside {
            let here = density[at.x + pass_.dims.x * (at.y + pass_.dims.y * at.z)];
            // A truncated series can dip below zero; radiance cannot.
            nodes[brick * 125u + number] = vec4(max(sum, vec3(0.0)), here);
        }
    }
}
