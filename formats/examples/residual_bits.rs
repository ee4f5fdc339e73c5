use smoke_formats::residual::{ResidualCodes, coded};
use smoke_formats::volume::VoxelMask;
fn main() {
    for path in std::env::args().skip(1) {
        let b = std::fs::read(&path).unwrap();
        let u = |i: usize| u32::from_le_bytes(b[4 * i..4 * i + 4].try_into().unwrap());
        let dims = [u(0), u(1), u(2)];
        let n = (dims[0] * dims[1] * dims[2]) as usize;
        let f = |i: usize| f32::from_bits(u(3 + i));
        for max_error in [0.002f32, 0.01] {
            let mut support = VoxelMask::new(n);
            let mut codes = vec![];
            for v in 0..n {
                if f(v) != 0.0 {
                    support.set(v);
                    codes.push(((f(v) - f(n + v)) / (2.0 * max_error)).round() as i32);
                }
            }
            let count = codes.len();
            let r = ResidualCodes { origin: [0; 3], dims, support, codes };
            let t = std::time::Instant::now();
            let bytes = coded::encode(&r);
            let s = t.elapsed().as_secs_f64();
            let t = std::time::Instant::now();
            assert_eq!(coded::decode(path.as_ref(), &bytes).unwrap(), r);
            let d = t.elapsed().as_secs_f64();
            print!("decode {:.2} us ", d * 1e6 / count as f64);
            println!(
                "{path} {max_error} {count} {:.4} b/voxel {:.2} us",
                bytes.len() as f64 * 8.0 / count as f64,
                s * 1e6 / count as f64
            );
        }
    }
}
