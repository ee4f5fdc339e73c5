// Vectors of GMRES (gmres.rs). Sums run in a fixed order: a group's 64 threads take every 64th entry of a block of 4,096
// and are added in pairs, and one group adds the blocks in the same way. The number of groups changes no bit.

struct Gmres {
    // Entries of the vectors, or blocks to add.
    length: u32,
    // Which of the sums.
    slot: u32,
    // Block of the first of these entries.
    first_block: u32,
    // What the other vector is multiplied by: 0 the factor, 1 times the sum, 2 over the root of the sum.
    kind: u32,
    // Of the vector itself.
    own: f32,
    factor: f32,
    pad_0: u32,
    pad_1: u32,
}

@group(0) @binding(0) var<uniform> gmres: Gmres;
@group(0) @binding(1) var<storage, read> a: array<f32>;
@group(0) @binding(2) var<storage, read> b: array<f32>;
@group(0) @binding(3) var<storage, read_write> blocks: array<f32>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> vector: array<f32>;

var<workgroup> lanes: array<f32, 64>;

// The sum of what the threads of a group bring.
fn group_sum(local: u32, mine: f32) -> f32 {
    lanes[local] = mine;
    for (var half = 32u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half { lanes[local] += lanes[local + half]; }
    }
    workgroupBarrier();
    return lanes[0];
}

@compute @workgroup_size(64)
fn dot_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group.x + group.y * groups.x;
    var mine = 0.0;
    for (var n = 0u; n < 64u; n++) {
        let entry = block * 4096u + n * 64u + local;
        if entry < gmres.length { mine += a[entry] * b[entry]; }
    }
    let sum = group_sum(local, mine);
    if local == 0u && block * 4096u < gmres.length { blocks[gmres.first_block + block] = sum; }
}

@compute @workgroup_size(64)
fn add_blocks(@builtin(local_invocation_index) local: u32) {
    var mine = 0.0;
    for (var block = local; block < gmres.length; block += 64u) { mine += blocks[block]; }
    let sum = group_sum(local, mine);
    if local == 0u { sums[gmres.slot] = sum; }
}

// vector <- own vector + factor b.
@compute @workgroup_size(64)
fn combine(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let entry = thread_number(group, groups, local);
    if entry >= gmres.length { return; }
    var factor = gmres.factor;
    if gmres.kind == 1u { factor *= sums[gmres.slot]; }
    if gmres.kind == 2u { factor *= inverseSqrt(sums[gmres.slot]); }
    // What a vector held before it was first written does not count.
    let own = select(gmres.own * vector[entry], 0.0, gmres.own == 0.0);
    vector[entry] = own + factor * b[entry];
}
