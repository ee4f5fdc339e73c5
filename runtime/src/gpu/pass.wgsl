// Goes before the text of every kernel: 64 invocations a group, groups folded into two axes (see pass.rs).

fn thread_number(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.x + group.y * groups.x) * 64u + local;
}

// Node `number` of brick `b` of a box of bricks (see shaded_volume.rs): 5^3 nodes a brick, 4 from one to the next.
fn node_of_brick(b: u32, number: u32, bricks: vec4<u32>) -> vec3<u32> {
    let brick = vec3(b % bricks.x, b / bricks.x % bricks.y, b / bricks.x / bricks.y);
    return brick * 4u + vec3(number % 5u, number / 5u % 5u, number / 25u);
}
