// Single scattering at the centres, from depths along directions (single.rs): an invocation a centre and coefficient, the
// exponential (exponential.rs, direct) within. Harmonics of the depth stay the processor's.

struct CentreSingle {
    // Optical depth over depth, RGB; finite.
    scale: vec4<f32>,
    // Centres, directions with their padding, coefficients.
    count: u32,
    directions: u32,
    coefficients: u32,
    pad_0: u32,
}

@group(0) @binding(0) var<uniform> single_: CentreSingle;
// [centre][direction].
@group(0) @binding(1) var<storage, read> depths: array<f32>;
// Radiance along the directions, RGB.
@group(0) @binding(2) var<storage, read> light: array<vec4<f32>>;
// [coefficient][direction]: harmonics times weights.
@group(0) @binding(3) var<storage, read> basis: array<f32>;
// Albedo times moment of each coefficient, RGB.
@group(0) @binding(4) var<storage, read> gains: array<vec4<f32>>;
// [centre][coefficient], RGB.
@group(0) @binding(5) var<storage, read_write> radiance: array<vec4<f32>>;

@compute @workgroup_size(64)
fn attenuate_and_project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = thread_number(group, groups, local);
    if number >= single_.count * single_.coefficients { return; }
    let centre = number / single_.coefficients * single_.directions;
    let k = number % single_.coefficients;
    var sum = vec3(0.0);
    for (var q = 0u; q < single_.directions; q++) {
        let depth = single_.scale.xyz * depths[centre + q];
        let transmittance = vec3(decay(depth.x), decay(depth.y), decay(depth.z));
        sum += basis[k * single_.directions + q] * transmittance * light[q].xyz;
    }
    radiance[number] = vec4(gains[k].xyz * sum, 0.0);
}
