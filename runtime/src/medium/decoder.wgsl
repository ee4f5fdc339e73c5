// Gaussian sums to density (decoder.rs): adds a frame's residual, which is read where it lies in its resident bytes.
//
// Layouts as in `formats/src/residual`: bricks of 8^3 voxels with a word each in a table, eight cells of 4^3 a brick; codes
// by rank (rank.rs), or in a perfect hash behind two bits of domain (hash.rs). Both are checked before they come here.

struct Decoder {
    // Voxels of the box, and bricks.
    dims: vec4<u32>,
    bricks: vec4<u32>,
    step: f32,
    // 0 no residual, 1 ranks, 2 a hash.
    kind: u32,
    // Which frame of a hash.
    frame: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> box_: Decoder;
@group(0) @binding(1) var<storage, read> words: array<u32>;
// Nodes of the field, which has one more than the box on each side: sums come in, density goes out.
@group(0) @binding(2) var<storage, read_write> density: array<f32>;

const EMPTY = 0xffffffffu;
const RANKS = 1u;

fn bit_of(mask: vec2<u32>, bit: u32) -> bool {
    return (select(mask.x, mask.y, bit >= 32u) >> (bit & 31u) & 1u) == 1u;
}

// Bits of `mask` below bit `bit`.
fn bits_below(mask: vec2<u32>, bit: u32) -> u32 {
    let below = (1u << (bit & 31u)) - 1u;
    if bit < 32u { return countOneBits(mask.x & below); }
    return countOneBits(mask.x) + countOneBits(mask.y & below);
}

fn mask_at(word: u32) -> vec2<u32> {
    return vec2(words[word], words[word + 1u]);
}

fn table_number(at: vec3<u32>) -> u32 {
    let b = at / 8u;
    return b.x + box_.bricks.x * (b.y + box_.bricks.y * b.z);
}

// The code of a voxel of cell `cell` by its rank; false outside the support.
fn by_rank(at: vec3<u32>, cell: u32, bit: u32, code: ptr<function, i32>) -> bool {
    let start = words[16u + table_number(at)];
    if start == EMPTY { return false; }
    let brick = 16u + box_.bricks.x * box_.bricks.y * box_.bricks.z + start;
    let head = words[brick];
    let occupied = head & 255u;
    if (occupied >> cell & 1u) == 0u { return false; }
    let partial = occupied & ~(head >> 8u);
    let below = (1u << cell) - 1u;
    let masks = brick + 2u + countOneBits(occupied);
    let values = masks + 2u * countOneBits(partial);
    let about = words[brick + 2u + countOneBits(occupied & below)];
    var mask = vec2(EMPTY);
    if (partial >> cell & 1u) == 1u { mask = mask_at(masks + 2u * countOneBits(partial & below)); }
    if !bit_of(mask, bit) { return false; }
    let width = about & 31u;
    let first = (about >> 5u & 0x3fffu) + bits_below(mask, bit) * width;
    let word = values + first / 32u;
    var value = words[word] >> (first % 32u);
    if first % 32u + width > 32u { value |= words[word + 1u] << (32u - first % 32u); }
    let up = about >> 19u << (head >> 16u & 31u);
    *code = bitcast<i32>(words[brick + 1u] + up + (value & ((1u << width) - 1u)));
    return true;
}

// Byte `at`.
fn byte(at: u32) -> u32 {
    return words[at / 4u] >> (8u * (at % 4u)) & 255u;
}

// The code in the slot of place `p` of a tile's domain.
fn in_slot(p: vec3<u32>) -> i32 {
    let side = words[1];
    let offset_side = words[2];
    let width = words[4];
    let offsets = 64u + 64u * words[0];
    let slots = (offsets + 3u * offset_side * offset_side * offset_side + 3u) / 4u;
    let h = p % offset_side;
    let at = offsets + 3u * (h.x + offset_side * (h.y + offset_side * h.z));
    let slot = (p % side + words[3] * vec3(byte(at), byte(at + 1u), byte(at + 2u))) % side;
    let number = slot.x + side * (slot.y + side * slot.z);
    if width == 4u { return bitcast<i32>(words[slots + number]); }
    // Up to the word's top and down again, with the sign.
    let in_word = 8u * (number * width % 4u);
    let bits = 8u * width;
    return bitcast<i32>(words[slots + number * width / 4u] << (32u - bits - in_word)) >> (32u - bits);
}

// The code of a voxel of cell `cell` in a hash; false outside the support.
fn by_hash(at: vec3<u32>, cell: u32, bit: u32, code: ptr<function, i32>) -> bool {
    let table = words[16u + 16u * box_.frame + 10u] / 4u;
    let start = words[table + table_number(at)];
    if start == EMPTY { return false; }
    let brick = table + box_.bricks.x * box_.bricks.y * box_.bricks.z + start;
    let head = words[brick];
    let occupied = head & 255u;
    if (occupied >> cell & 1u) == 0u { return false; }
    let partial = occupied & ~(head >> 8u);
    let mixed = head >> 16u & 255u;
    let below = (1u << cell) - 1u;
    var support = vec2(EMPTY);
    if (partial >> cell & 1u) == 1u { support = mask_at(brick + 1u + 2u * countOneBits(partial & below)); }
    if !bit_of(support, bit) { return false; }
    var keys = support;
    if (head >> (24u + cell) & 1u) == 1u {
        keys = vec2(0u);
    } else if (mixed >> cell & 1u) == 1u {
        keys = mask_at(brick + 1u + 2u * (countOneBits(partial) + countOneBits(mixed & below)));
    }
    *code = 0;
    if bit_of(keys, bit) {
        let f = box_.frame;
        *code = in_slot(at + vec3(words[5], words[6], words[7]) * vec3(f % 3u, f / 3u % 3u, f / 9u));
    }
    return true;
}

@compute @workgroup_size(64)
fn decode(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let thread = thread_number(group, groups, local);
    let n = box_.dims;
    if thread >= n.x * n.y * n.z { return; }
    let at = vec3(thread % n.x, thread / n.x % n.y, thread / n.x / n.y);
    let node = at.x + 1u + (n.x + 2u) * (at.y + 1u + (n.y + 2u) * (at.z + 1u));
    let sum = density[node];
    if box_.kind == 0u {
        // Tails below half a step count as none.
        density[node] = select(0.0, sum, sum >= 0.5 * box_.step);
        return;
    }
    let high = at >> vec3(2u) & vec3(1u);
    let cell = high.x | high.y << 1u | high.z << 2u;
    let in_cell = at & vec3(3u);
    let bit = in_cell.x | in_cell.y << 2u | in_cell.z << 4u;
    var code = 0;
    var is_support = false;
    if box_.kind == RANKS {
        is_support = by_rank(at, cell, bit, &code);
    } else {
        is_support = by_hash(at, cell, bit, &code);
    }
    let value = sum + box_.step * f32(code);
    density[node] = select(0.0, value, is_support && value > 0.0);
}
