// Rays of many directions through a grid, as sheared columns (columns.rs). A thread carries one ray from slice to slice
// and leaves what it carries where it passes a slice's nodes: `columns + 1` by `rows + 1` rays a slice, of which node
// (x, y) is between rays x, y and x + 1, y + 1. So nodes are read from rays without a barrier between slices.

struct Path {
    columns: u32,
    rows: u32,
    slices: u32,
    // Dominant axis.
    axis: u32,
    // The array of rays.
    extent_columns: u32,
    extent_rows: u32,
    // 1 where the last slice is met first.
    reversed: u32,
    // World length between slices.
    length: f32,
    // Where a node is in the layout of this axis, and where that layout's density starts.
    slice_stride: u32,
    row_stride: u32,
    density_start: u32,
    // Its first shift; one follows for each slice.
    first_shift: u32,
}

struct Shift {
    // The ray just below node 0.
    base: vec2<u32>,
    // By how much the next one lies beyond node 0.
    fraction: vec2<f32>,
}

@group(0) @binding(1) var<storage, read> paths: array<Path>;
@group(0) @binding(2) var<storage, read> shifts: array<Shift>;
@group(0) @binding(3) var<storage, read> density: array<f32>;
// Nodes near density, x fastest.
@group(0) @binding(4) var<storage, read> near: array<u32>;

// Weights of the four nodes around a ray: row by row.
fn ray_weights(fraction: vec2<f32>) -> vec4<f32> {
    let f = fraction.x;
    let g = fraction.y;
    return vec4((1.0 - g) * (1.0 - f), (1.0 - g) * f, g * (1.0 - f), g * f);
}

// Weights of the four rays around a node: row by row.
fn node_weights(fraction: vec2<f32>) -> vec4<f32> {
    let f = fraction.x;
    let g = fraction.y;
    return vec4(g * f, g * (1.0 - f), (1.0 - g) * f, (1.0 - g) * (1.0 - f));
}

// Column, row and slice of a node.
fn on_path(path: Path, dims: vec3<u32>, node: u32) -> vec3<u32> {
    let at = vec3(node % dims.x, node / dims.x % dims.y, node / dims.x / dims.y);
    if path.axis == 0u { return at.yzx; }
    if path.axis == 1u { return at.xzy; }
    return at;
}

// Place of a node in the layout of the path.
fn layout_place(path: Path, at: vec3<u32>) -> u32 {
    return at.z * path.slice_stride + at.y * path.row_stride + at.x;
}

// The slice that is met as number `step`, and back.
fn slice_of(path: Path, step: u32) -> u32 {
    return select(step, path.slices - 1u - step, path.reversed == 1u);
}

// Place of a ray among those that pass the slice.
fn ray_place(path: Path, step: u32, ray: vec2<u32>) -> u32 {
    return (step * (path.rows + 1u) + ray.y) * (path.columns + 1u) + ray.x;
}

// Whether the ray is between nodes there, not outside of them.
fn between_nodes(path: Path, ray: vec2<u32>) -> bool {
    return all(ray > vec2(0u)) && ray.x < path.columns && ray.y < path.rows;
}

// Density where the ray is between nodes.
fn met_density(path: Path, step: u32, ray: vec2<u32>, weights: vec4<f32>) -> f32 {
    let corner = path.density_start + layout_place(path, vec3(ray - 1u, slice_of(path, step)));
    let above = corner + path.row_stride;
    return dot(weights, vec4(density[corner], density[corner + 1u], density[above], density[above + 1u]));
}
