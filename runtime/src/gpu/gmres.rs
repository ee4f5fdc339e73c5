//! The host's side of GMRES, `transport/compensated/gmres.wgsl`: the vectors are on the device, the small system is
//! here.
//!
//! The twin of [`crate::transport::compensated::gmres::solve`], whose small least-squares problem it shares. An
//! iteration is one submission and one read-back, of its column of the Hessenberg matrix: what a vector is multiplied
//! by stays on the device. What differs from the processor: sums are f32, in pairs (relative error about 1e-6), so a
//! relative residual below some 1e-6 is never seen. Memory for up to 33 vectors, the basis as it grows.

use super::device::{Gpu, GpuError};
use super::layouts::Gmres;
use super::pass::Kernel;
use super::planes::Planes;
use super::scatter::Gather;
use super::transfer::{Work, dispatch};
use crate::transport::compensated::gmres::{CYCLE, LeastSquares, NO_PROGRESS, Solved};

/// The shader, without its prelude.
pub const SHADER: &str = include_str!("../transport/compensated/gmres.wgsl");

/// Entries that a group sums.
const BLOCK: usize = 4096;
const STAGE: &str = "multiple scattering";

/// Vectors of GMRES, compiled.
pub struct GmresPass {
    dot_blocks: Kernel,
    add_blocks: Kernel,
    combine: Kernel,
}

/// What a vector is multiplied by.
#[derive(Clone, Copy)]
enum Factor {
    /// This.
    Plain(f32),
    /// This times one of the sums.
    Sum(f32, usize),
    /// One over the root of one of the sums.
    InverseRoot(usize),
}

/// Sums on the device.
struct Sums {
    blocks: wgpu::Buffer,
    sums: wgpu::Buffer,
}

impl GmresPass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        let kernel = |entry| Kernel::new(gpu, "GMRES", source, entry);
        Ok(Self { dot_blocks: kernel("dot_blocks")?, add_blocks: kernel("add_blocks")?, combine: kernel("combine")? })
    }

    /// Improves the solution `x` of `x - G x = b`, where `gather` adds `-G`, until the relative residual is below
    /// `tolerance` or `limit` iterations are spent.
    pub fn solve(
        &self,
        gpu: &Gpu,
        gather: &Gather,
        b: &Planes,
        x: &Planes,
        tolerance: f64,
        limit: usize,
    ) -> Result<Solved, GpuError> {
        let vector = || Planes::new(gpu, "unknowns of multiple scattering", b.count(), b.stride);
        let blocks: usize = b.parts.iter().map(|part| (part.count * b.stride).div_ceil(BLOCK)).sum();
        let sums = Sums {
            blocks: gpu.storage("blocks of a sum", 4 * blocks as u64)?,
            sums: gpu.storage("sums", 4 * (CYCLE + 1) as u64)?,
        };
        let read = |count: usize| -> Result<Vec<f64>, GpuError> {
            Ok(gpu.read::<f32>(STAGE, &sums.sums, count)?.into_iter().map(f64::from).collect())
        };
        let work = vector()?;
        let first = self.dot(gpu, &sums, b, b, 0);
        dispatch(gpu, STAGE, &first)?;
        let scale = read(1)?[0].sqrt();
        if scale == 0.0 {
            dispatch(gpu, STAGE, &self.combine(gpu, &sums, x, 0.0, Factor::Plain(1.0), b))?;
            return Ok(Solved { iterations: 0, residual: 0.0 });
        }
        let mut iterations = 0;
        let mut basis = vec![vector()?];
        loop {
            let mut steps = self.product(gpu, &sums, gather, x, &work);
            steps.extend(self.combine(gpu, &sums, &work, -1.0, Factor::Plain(1.0), b));
            steps.extend(self.dot(gpu, &sums, &work, &work, 0));
            steps.extend(self.combine(gpu, &sums, &basis[0], 0.0, Factor::InverseRoot(0), &work));
            dispatch(gpu, STAGE, &steps)?;
            let norm = read(1)?[0].sqrt();
            // NaN ends here too.
            let unfinished = norm > tolerance * scale && iterations < limit;
            if !unfinished {
                return Ok(Solved { iterations, residual: norm / scale });
            }
            let mut small = LeastSquares::new(norm);
            while small.len() < CYCLE && iterations < limit {
                let k = small.len();
                if basis.len() < k + 2 {
                    basis.push(vector()?);
                }
                let mut steps = self.product(gpu, &sums, gather, &basis[k], &work);
                for (slot, v) in basis[..=k].iter().enumerate() {
                    steps.extend(self.dot(gpu, &sums, v, &work, slot));
                    steps.extend(self.combine(gpu, &sums, &work, 1.0, Factor::Sum(-1.0, slot), v));
                }
                steps.extend(self.dot(gpu, &sums, &work, &work, k + 1));
                steps.extend(self.combine(gpu, &sums, &basis[k + 1], 0.0, Factor::InverseRoot(k + 1), &work));
                dispatch(gpu, STAGE, &steps)?;
                iterations += 1;
                let mut column = read(k + 2)?;
                let next = column.pop().unwrap_or(0.0).sqrt();
                if !small.push(column, next) || small.rest() <= tolerance * scale {
                    break;
                }
            }
            if small.len() == 0 {
                return Ok(Solved { iterations, residual: norm / scale });
            }
            let solution = small.solution();
            let steps = basis.iter().zip(&solution);
            let steps: Vec<Work> =
                steps.flat_map(|(v, &y)| self.combine(gpu, &sums, x, 1.0, Factor::Plain(y as f32), v)).collect();
            dispatch(gpu, STAGE, &steps)?;
            // No progress in a whole cycle: more of them would not help.
            if small.rest() > NO_PROGRESS * norm {
                return Ok(Solved { iterations, residual: small.rest() / scale });
            }
        }
    }

    /// `out <- v - G v`.
    fn product<'a>(
        &'a self,
        gpu: &Gpu,
        sums: &'a Sums,
        gather: &'a Gather,
        v: &'a Planes,
        out: &'a Planes,
    ) -> Vec<Work<'a>> {
        let mut work = self.combine(gpu, sums, out, 0.0, Factor::Plain(1.0), v);
        work.extend(gather.add(gpu, v, out));
        work
    }

    /// The sum of products of two vectors, into a slot.
    fn dot<'a>(&'a self, gpu: &Gpu, sums: &'a Sums, a: &'a Planes, b: &'a Planes, slot: usize) -> Vec<Work<'a>> {
        let mut first_block = 0;
        let mut work = Vec::new();
        for (a, b, length) in pairs(a, b) {
            let uniform = Gmres { length: length as u32, first_block: first_block as u32, ..Gmres::default() };
            let blocks = length.div_ceil(BLOCK);
            work.push(Work {
                kernel: &self.dot_blocks,
                uniform: gpu.uniform("GMRES", &uniform),
                buffers: vec![(1, a), (2, b), (3, &sums.blocks)],
                threads: 64 * blocks,
            });
            first_block += blocks;
        }
        let uniform = Gmres { length: first_block as u32, slot: slot as u32, ..Gmres::default() };
        let buffers = vec![(3, &sums.blocks), (4, &sums.sums)];
        work.push(Work { kernel: &self.add_blocks, uniform: gpu.uniform("GMRES", &uniform), buffers, threads: 64 });
        work
    }

    /// `a <- own a + factor b`.
    fn combine<'a>(
        &'a self,
        gpu: &Gpu,
        sums: &'a Sums,
        a: &'a Planes,
        own: f32,
        factor: Factor,
        b: &'a Planes,
    ) -> Vec<Work<'a>> {
        let (kind, factor, slot) = match factor {
            Factor::Plain(factor) => (0, factor, 0),
            Factor::Sum(factor, slot) => (1, factor, slot),
            Factor::InverseRoot(slot) => (2, 1.0, slot),
        };
        let step = |(a, b, length): (&'a wgpu::Buffer, &'a wgpu::Buffer, usize)| {
            let uniform = Gmres { length: length as u32, slot: slot as u32, kind, own, factor, ..Gmres::default() };
            let buffers = vec![(2, b), (4, &sums.sums), (5, a)];
            Work { kernel: &self.combine, uniform: gpu.uniform("GMRES", &uniform), buffers, threads: length }
        };
        pairs(a, b).map(step).collect()
    }

    /// `a <- own a + factor b`, at once.
    pub fn add(&self, gpu: &Gpu, a: &Planes, own: f32, factor: f32, b: &Planes) -> Result<(), GpuError> {
        let none = || gpu.storage("sums", 0);
        let sums = Sums { blocks: none()?, sums: none()? };
        dispatch(gpu, STAGE, &self.combine(gpu, &sums, a, own, Factor::Plain(factor), b))
    }
}

/// Buffers of two vectors of the same parts, with their entries.
fn pairs<'a>(a: &'a Planes, b: &'a Planes) -> impl Iterator<Item = (&'a wgpu::Buffer, &'a wgpu::Buffer, usize)> {
    let stride = a.stride;
    a.parts.iter().zip(&b.parts).map(move |(a, b)| (&a.buffer, &b.buffer, a.count * stride))
}
