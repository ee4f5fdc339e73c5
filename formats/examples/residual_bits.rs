//! Bits per voxel and time of the residual codec on frames of smoke, alone and after the frame before.
//!
//! ```sh
//! cargo run --release -p smoke-formats --example residual_bits -- frame1.raw frame2.raw ...
//! ```
//! A raw frame is, little-endian: voxels along x, y, z (u32), index of the first voxel (i32), densities (f32, x
//! fastest). A blur of standard deviation 1.7 voxels stands in for the sum of Gaussians: it leaves 5 to 7 % of the
//! energy, as a fit of 600 Gaussians does. One line a frame and maximum error, tab-separated.

use smoke_formats::residual::{ResidualCodes, coded};
use smoke_formats::volume::VoxelMask;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

/// Standard deviation of the blur, voxels.
const SIGMA: f64 = 1.7;

struct Frame {
    dims: [usize; 3],
    origin: [i32; 3],
    density: Vec<f32>,
    smooth: Vec<f32>,
}

fn read(path: &str) -> Result<Frame, Box<dyn Error>> {
    let bytes = std::fs::read(path)?;
    let words: Vec<[u8; 4]> = bytes.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect();
    let (head, values) = words.split_at_checked(6).ok_or("shorter than its header")?;
    let dims = [0, 1, 2].map(|a| u32::from_le_bytes(head[a]) as usize);
    let origin = [3, 4, 5].map(|a| i32::from_le_bytes(head[a]));
    if values.len() != dims.iter().product::<usize>() {
        return Err(format!("{path}: found {} densities, expected {dims:?}", values.len()).into());
    }
    let density: Vec<f32> = values.iter().map(|&w| f32::from_le_bytes(w)).collect();
    let smooth = [1, dims[0], dims[0] * dims[1]]
        .into_iter()
        .zip(dims)
        .fold(density.clone(), |volume, (stride, length)| blur(&volume, stride, length));
    Ok(Frame { dims, origin, density, smooth })
}

/// Blurs along the axis of `length` voxels that are `stride` apart; zero outside.
fn blur(volume: &[f32], stride: usize, length: usize) -> Vec<f32> {
    let kernel: Vec<f64> = (-7..=7).map(|d| (-0.5 * (f64::from(d) / SIGMA).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    let at = |v: usize| {
        let place = v / stride % length;
        let taps = (0..15).filter_map(|t| Some((t, (place + t).checked_sub(7).filter(|&p| p < length)?)));
        (taps.map(|(t, p)| kernel[t] * f64::from(volume[v - place * stride + p * stride])).sum::<f64>() / sum) as f32
    };
    (0..volume.len()).map(at).collect()
}

fn quantised(frame: &Frame, max_error: f32) -> ResidualCodes {
    let mut support = VoxelMask::new(frame.density.len());
    let mut codes = Vec::new();
    for (v, (&d, &s)) in frame.density.iter().zip(&frame.smooth).enumerate() {
        if d != 0.0 {
            support.set(v);
            codes.push(((d - s) / (2.0 * max_error)).round() as i32);
        }
    }
    ResidualCodes { origin: frame.origin, dims: frame.dims.map(|d| d as u32), support, codes }
}

fn main() -> Result<(), Box<dyn Error>> {
    println!("frame\tmax error\tvoxels\talone b\tencode us\tdecode us\tafter b\tencode us\tdecode us");
    let mut previous: Option<Frame> = None;
    for path in std::env::args().skip(1) {
        let frame = read(&path)?;
        for max_error in [0.002, 0.01] {
            let residual = quantised(&frame, max_error);
            let count = residual.codes.len() as f64;
            let microseconds = |start: Instant| start.elapsed().as_secs_f64() * 1e6 / count;
            let measured = |encode: &dyn Fn() -> Vec<u8>, decode: &dyn Fn(&[u8]) -> ResidualCodes| {
                let start = Instant::now();
                let bytes = encode();
                let encoding = microseconds(start);
                let start = Instant::now();
                assert!(decode(&bytes) == residual, "{path} does not return");
                let decoding = microseconds(start);
                format!("\t{:.3}\t{encoding:.2}\t{decoding:.2}", bytes.len() as f64 * 8.0 / count)
            };
            let file = Path::new(&path);
            let decoded = |r: smoke_formats::Result<ResidualCodes>| r.expect("just encoded");
            print!("{path}\t{max_error}\t{count}");
            print!("{}", measured(&|| coded::encode(&residual), &|b| decoded(coded::decode(file, b))));
            if let Some(before) = previous.as_ref().map(|p| quantised(p, max_error)) {
                let encode = || coded::encode_after(&residual, &before);
                print!("{}", measured(&encode, &|b| decoded(coded::decode_after(file, b, &before))));
            }
            println!();
        }
        previous = Some(frame);
    }
    Ok(())
}
