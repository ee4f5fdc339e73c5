// The view pass (march.rs): source radiance and density along every pixel's ray, front to back.
//
// Places in f32: a ray is known by where it crosses the plane through the middle of the box, `start` (from the host in
// f64), and samples are counted from there: number `middle + k` lies at `start + along * u` with `u = k + offset`, all of
// the size of the box whatever the distance of the eye. Errors are a few roundings of the box's side: below 2e-7 of it.

struct March {
    // Node space: the axis's crossing of the plane, and across and down by one pixel there.
    centre: vec4<f32>,
    plane_right: vec4<f32>,
    plane_down: vec4<f32>,
    // Node space, by one sample: along the axis, and what one pixel across and down adds before the length is taken out.
    step_forward: vec4<f32>,
    step_right: vec4<f32>,
    step_down: vec4<f32>,
    // World space, the same three.
    forward: vec4<f32>,
    right: vec4<f32>,
    down: vec4<f32>,
    sigma_t: vec4<f32>,
    peak_ratio: vec4<f32>,
    // Last node along each axis.
    top: vec4<f32>,
    bricks: vec4<u32>,
    size: vec2<u32>,
    // The first pixel of this dispatch and how many it has.
    first_pixel: u32,
    pixels: u32,
    samples: u32,
    bricks_a_page: u32,
    environments: u32,
    has_peak: u32,
    // Tangents of a pixel across and down.
    pixel: vec2<f32>,
    // World distance between samples, distance of the plane along the axis.
    ds: f32,
    plane: f32,
    // That distance in samples: its fraction; and the least k, that of the eye.
    plane_fraction: f32,
    plane_samples: f32,
    least: i32,
    cutoff: f32,
    // 1 where each thread's place in the film holds the column and the row of its pixel.
    listed: u32,
    pad_0: f32,
    pad_1: f32,
    pad_2: f32,
}

struct Pixel {
    // Radiance and depth.
    radiance: vec4<f32>,
    // Transmittance; the fourth is nothing.
    transmittance: vec4<f32>,
}

struct Environment {
    size: vec2<u32>,
    first: u32,
    up_is_y: u32,
    rotation: f32,
    pad_0: f32,
    pad_1: f32,
    pad_2: f32,
}

@group(0) @binding(0) var<uniform> march: March;
@group(0) @binding(1) var<storage, read> places: array<u32>;
@group(0) @binding(2) var<storage, read> nodes_0: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> nodes_1: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> nodes_2: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> nodes_3: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> environments: array<Environment>;
// Texels of the peak's map (64 x 32), if there is one, then those of the environments.
@group(0) @binding(7) var<storage, read> sky: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> film: array<Pixel>;

const EMPTY: u32 = 0xffffffffu;
const FAR: f32 = 3.0e38;
const TAU: f32 = 6.2831853;
const PI: f32 = 3.1415927;

fn node(page: u32, at: u32) -> vec4<f32> {
    switch page {
        case 0u: { return nodes_0[at]; }
        case 1u: { return nodes_1[at]; }
        case 2u: { return nodes_2[at]; }
        default: { return nodes_3[at]; }
    }
}

fn fetch(place: u32, local: vec3<f32>) -> vec4<f32> {
    let p = clamp(local, vec3(0.0), vec3(4.0));
    let base = min(vec3<u32>(p), vec3(3u));
    let f = p - vec3<f32>(base);
    let page = place / march.bricks_a_page;
    let at = (place - page * march.bricks_a_page) * 125u + base.x + 5u * (base.y + 5u * base.z);
    let a = mix_nodes(node(page, at), node(page, at + 1u), f.x);
    let b = mix_nodes(node(page, at + 5u), node(page, at + 6u), f.x);
    let c = mix_nodes(node(page, at + 25u), node(page, at + 26u), f.x);
    let d = mix_nodes(node(page, at + 30u), node(page, at + 31u), f.x);
    return mix_nodes(mix_nodes(a, b, f.y), mix_nodes(c, d, f.y), f.z);
}

fn mix_nodes(a: vec4<f32>, b: vec4<f32>, f: f32) -> vec4<f32> {
    return a + (b - a) * f;
}

// 1 - e^-x without cancellation: a series below 1/4, whose next term is 2e-8 of it.
fn rest(x: vec3<f32>) -> vec3<f32> {
    let series = x * (1.0 - x * 0.5 * (1.0 - x / 3.0 * (1.0 - x * 0.25 * (1.0 - x * 0.2 * (1.0 - x / 6.0)))));
    return select(1.0 - exp(-min(x, vec3(87.0))), series, x < vec3(0.25));
}

fn texel(environment: Environment, column: u32, row: i32) -> vec3<f32> {
    let r = u32(clamp(row, 0, i32(environment.size.y) - 1));
    return sky[environment.first + r * environment.size.x + column % environment.size.x].xyz;
}

fn behind(d: vec3<f32>) -> vec3<f32> {
    var sum = vec3(0.0);
    for (var e = 0u; e < march.environments; e++) {
        let environment = environments[e];
        let w = select(d, vec3(d.x, -d.z, d.y), environment.up_is_y != 0u);
        var u = 0.5 - (atan2(w.y, w.x) - environment.rotation) / TAU;
        u -= floor(u);
        let v = 0.5 - asin(clamp(w.z, -1.0, 1.0)) / PI;
        let p = vec2(u, v) * vec2<f32>(environment.size) - 0.5;
        let base = floor(p);
        let f = p - base;
        let column = u32(base.x + f32(environment.size.x));
        let row = i32(base.y);
        let above = mix(texel(environment, column, row), texel(environment, column + 1u, row), f.x);
        let below = mix(texel(environment, column, row + 1), texel(environment, column + 1u, row + 1), f.x);
        sum += mix(above, below, f.y);
    }
    return sum;
}

fn through_peak(d: vec3<f32>) -> vec3<f32> {
    var turn = atan2(d.y, d.x) / TAU;
    turn -= floor(turn);
    let p = vec2(turn * 64.0, acos(clamp(d.z, -1.0, 1.0)) / PI * 32.0) - 0.5;
    let base = floor(p);
    let f = p - base;
    let left = u32(base.x + 64.0) % 64u;
    let right = (left + 1u) % 64u;
    let above = u32(clamp(i32(base.y), 0, 31)) * 64u;
    let below = u32(clamp(i32(base.y) + 1, 0, 31)) * 64u;
    let high = mix(sky[above + left].xyz, sky[above + right].xyz, f.x);
    let low = mix(sky[below + left].xyz, sky[below + right].xyz, f.x);
    return mix(high, low, f.y);
}

// The ray through the point (x, y) of the image, in pixels from its middle.
fn march_ray(x: f32, y: f32) -> Pixel {
    let slope = vec2(x, y) * march.pixel;
    let square = dot(slope, slope);
    let length = sqrt(1.0 + square);
    let start = march.centre.xyz + march.plane_right.xyz * x + march.plane_down.xyz * y;
    let along = (march.step_forward.xyz + march.step_right.xyz * x + march.step_down.xyz * y) / length;
    // The plane is length times as far along this ray as along the axis: `length - 1` without cancellation.
    let further = march.plane_samples * (square / (1.0 + length));
    let whole = round(further);
    let offset = 0.5 - march.plane_fraction - (further - whole);
    let shift = i32(whole);

    var pixel = Pixel(vec4(0.0, 0.0, 0.0, FAR), vec4(1.0));
    // Inside the box, in samples from the plane.
    var near = f32(march.least - shift) + offset - 0.5;
    var far = FAR;
    for (var a = 0; a < 3; a++) {
        if along[a] == 0.0 {
            if !(start[a] >= 0.0 && start[a] <= march.top[a]) { far = -FAR; }
        } else {
            let t0 = -start[a] / along[a];
            let t1 = (march.top[a] - start[a]) / along[a];
            near = max(near, min(t0, t1));
            far = min(far, max(t0, t1));
        }
    }
    if near < far {
        var k = max(i32(ceil(near - offset)), march.least - shift);
        let end = i32(ceil(far - offset));
        var first = FAR;
        while k < end {
            let p = start + along * (f32(k) + offset);
            let brick = clamp(vec3<i32>(floor(p * 0.25)), vec3(0), vec3<i32>(march.bricks.xyz) - 1);
            let corner = vec3<f32>(brick) * 4.0;
            // How far this brick goes: the samples before its exit.
            var exit = FAR;
            for (var a = 0; a < 3; a++) {
                if along[a] != 0.0 {
                    let side = select(corner[a], corner[a] + 4.0, along[a] > 0.0);
                    exit = min(exit, (side - start[a]) / along[a]);
                }
            }
            let after = min(end, max(k + 1, i32(ceil(exit - offset))));
            let b = vec3<u32>(brick);
            let place = places[b.x + march.bricks.x * (b.y + march.bricks.y * b.z)];
            if place == EMPTY {
                k = after;
                continue;
            }
            for (; k < after; k++) {
                let u = f32(k) + offset;
                let sample = fetch(place, start + along * u - corner);
                if sample.w > 0.0 {
                    if first == FAR { first = u; }
                    let lost = rest(march.sigma_t.xyz * (sample.w * march.ds));
                    let gain = pixel.transmittance.xyz * sample.xyz * lost;
                    pixel.radiance += vec4(gain, 0.0);
                    pixel.transmittance *= vec4(1.0 - lost, 1.0);
                    let t = pixel.transmittance.xyz;
                    if max(t.x, max(t.y, t.z)) < march.cutoff {
                        pixel.radiance += vec4(t * sample.xyz, 0.0);
                        pixel.transmittance = vec4(0.0);
                        k = end;
                        break;
                    }
                }
            }
        }
        if first != FAR { pixel.radiance.w = march.plane + first * march.ds / length; }
    }
    let world = (march.forward.xyz + march.right.xyz * x + march.down.xyz * y) / length;
    let through = pixel.transmittance.xyz;
    var seen = through;
    if march.has_peak != 0u {
        seen = select(pow(through, march.peak_ratio.xyz), vec3(0.0), through == vec3(0.0));
        pixel.radiance += vec4((through - seen) * through_peak(world), 0.0);
    }
    if march.environments > 0u { pixel.radiance += vec4(seen * behind(world), 0.0); }
    pixel.transmittance = vec4(seen, 0.0);
    return pixel;
}

@compute @workgroup_size(64)
fn march_pixels(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= march.pixels { return; }
    let at = march.first_pixel + thread;
    var place = vec2(f32(at % march.size.x), f32(at / march.size.x));
    if march.listed != 0u { place = film[thread].radiance.xy; }
    let corner = place - 0.5 * vec2<f32>(march.size);
    var sum = Pixel(vec4(0.0, 0.0, 0.0, FAR), vec4(0.0));
    for (var ray = 0u; ray < march.samples * march.samples; ray++) {
        let part = (vec2(f32(ray % march.samples), f32(ray / march.samples)) + 0.5) / f32(march.samples);
        let seen = march_ray(corner.x + part.x, corner.y + part.y);
        sum.radiance = vec4(sum.radiance.xyz + seen.radiance.xyz, min(sum.radiance.w, seen.radiance.w));
        sum.transmittance += seen.transmittance;
    }
    let share = 1.0 / f32(march.samples * march.samples);
    film[thread] = Pixel(vec4(sum.radiance.xyz * share, sum.radiance.w), sum.transmittance * share);
}
