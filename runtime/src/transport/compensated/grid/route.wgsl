// The volume pass of the grid route (route.rs): planes of spherical harmonics to the bricks' nodes, for one eye.
//
// `add_planes` adds some planes of one layer, in the order in which the processor does; `finish` puts the density beside
// the sum. A plane is read trilinearly where its nodes are further apart than the bricks'.

struct VolumePass {
    // The eye in node space, and the columns of the linear map to the world, scaled to at most 1: directions only.
    eye: vec4<f32>,
    column_x: vec4<f32>,
    column_y: vec4<f32>,
    column_z: vec4<f32>,
    // Nodes of the field and of the layer.
    dims: vec4<u32>,
    layer_dims: vec4<u32>,
    bricks: vec4<u32>,
    step: u32,
    channels: u32,
    // Planes of this dispatch: the number of the first, and how many; and bands of all.
    first_plane: u32,
    planes: u32,
    bands: u32,
    // Bricks of this page: the first, and how many.
    first_brick: u32,
    page_bricks: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> pass_: VolumePass;
// Which brick of the box each place holds.
@group(0) @binding(1) var<storage, read> dense: array<u32>;
@group(0) @binding(2) var<storage, read> planes: array<f32>;
@group(0) @binding(3) var<storage, read> density: array<f32>;
@group(0) @binding(4) var<storage, read_write> nodes: array<vec4<f32>>;

// The node of a thread: within the box, or past its end in its last bricks.
fn node_of(thread: u32) -> vec3<u32> {
    let b = dense[pass_.first_brick + thread / 125u];
    return node_of_brick(b, thread % 125u, pass_.bricks);
}

// A plane at fine node `at`: coarse node c sits at fine place (c - 1) step.
fn read_plane(plane: u32, at: vec3<u32>) -> f32 {
    let n = pass_.layer_dims;
    let start = plane * n.x * n.y * n.z;
    if pass_.step == 1u { return planes[start + at.x + n.x * (at.y + n.y * at.z)]; }
    let c = at / pass_.step + 1u;
    let f = vec3<f32>(at % pass_.step) / f32(pass_.step);
    let corner = start + c.x + n.x * (c.y + n.y * c.z);
    let up = n.x;
    let back = n.x * n.y;
    let w = vec4((1.0 - f.y) * (1.0 - f.z), f.y * (1.0 - f.z), (1.0 - f.y) * f.z, f.y * f.z);
    let left = vec4(planes[corner], planes[corner + up], planes[corner + back], planes[corner + back + up]);
    let right =
        vec4(planes[corner + 1u], planes[corner + up + 1u], planes[corner + back + 1u], planes[corner + back + up + 1u]);
    return dot(w, left) * (1.0 - f.x) + dot(w, right) * f.x;
}

@compute @workgroup_size(64)
fn add_planes(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= pass_.page_bricks * 125u { return; }
    let at = node_of(thread);
    if any(at >= pass_.dims.xyz) { return; }
    let p = vec3<f32>(at) - pass_.eye.xyz;
    // The direction in which the ray that passes here goes on; +z at the eye itself.
    let along = pass_.column_x.xyz * p.x + pass_.column_y.xyz * p.y + pass_.column_z.xyz * p.z;
    let largest = max(abs(along.x), max(abs(along.y), abs(along.z)));
    var y = harmonics(pass_.bands, select(vec3(0.0, 0.0, 1.0), normalize(along / max(largest, 1e-30)), largest > 0.0));
    var sum = nodes[thread];
    for (var plane = 0u; plane < pass_.planes; plane++) {
        let number = pass_.first_plane + plane;
        sum[number % pass_.channels] += read_plane(plane, at) * y[number / pass_.channels];
    }
    nodes[thread] = sum;
}

@compute @workgroup_size(64)
fn finish(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    if thread >= pass_.page_bricks * 125u { return; }
    let at = node_of(thread);
    if any(at >= pass_.dims.xyz) { return; }
    // A truncated series can dip below zero beside a strong peak; radiance cannot.
    var sum = max(nodes[thread].xyz, vec3(0.0));
    if pass_.channels == 1u { sum = vec3(sum.x); }
    nodes[thread] = vec4(sum, density[at.x + pass_.dims.x * (at.y + pass_.dims.y * at.z)]);
}
