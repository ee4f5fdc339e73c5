// Goes before the text of every kernel: 64 invocations a group, groups folded into two axes (see pass.rs).

fn thread_number(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    return (group.x + group.y * groups.x) * 64u + local;
}
