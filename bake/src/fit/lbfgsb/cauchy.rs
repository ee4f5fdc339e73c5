//! The generalised Cauchy point: the first minimum of the quadratic model along the projected gradient's path.
//!
//! `m(x + d) = g . d + d . B d / 2` along `P(x - t g)`, piece by piece between the breakpoints at which variables meet
//! their bounds (Byrd, Lu, Nocedal, Zhu 1995, section 4, algorithm CP). The breakpoints come from a heap, so only those
//! that are passed are sorted; each costs `4 m^2`. Cost: `2 m n + n + passed * (4 m^2 + log n)`.

use super::{linear::dot, memory::Memory};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// The Cauchy point and `W^T (point - x)`.
pub(super) struct Cauchy {
    pub point: Vec<f64>,
    pub c: Vec<f64>,
}

/// A breakpoint; the smallest time comes first out of a heap, ties by index.
#[derive(PartialEq)]
struct Breakpoint(f64, usize);

impl Eq for Breakpoint {}
impl Ord for Breakpoint {
    fn cmp(&self, other: &Self) -> Ordering {
        other.0.total_cmp(&self.0).then(other.1.cmp(&self.1))
    }
}
impl PartialOrd for Breakpoint {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

pub(super) fn cauchy_point(x: &[f64], gradient: &[f64], lower: &[f64], upper: &[f64], memory: &Memory) -> Cauchy {
    let mut breakpoints = Vec::new();
    let mut d = vec![0.0; x.len()];
    for i in 0..x.len() {
        let g = gradient[i];
        let time = match g.partial_cmp(&0.0) {
            Some(Ordering::Less) => (x[i] - upper[i]) / g,
            Some(Ordering::Greater) => (x[i] - lower[i]) / g,
            _ => continue,
        };
        if time > 0.0 {
            d[i] = -g;
            if time.is_finite() {
                breakpoints.push(Breakpoint(time, i));
            }
        }
    }
    let theta = memory.theta;
    let mut point = x.to_vec();
    let mut p = memory.transposed(&d);
    let mut c = vec![0.0; p.len()];
    let mut slope = -dot(&d, &d);
    if slope == 0.0 {
        return Cauchy { point, c };
    }
    let mut curvature = -theta * slope - dot(&p, &memory.middle(&p));
    // Rounding may make the curvature vanish; the original code keeps it above this.
    let least = -f64::EPSILON * theta * slope;
    curvature = curvature.max(least);
    let mut to_minimum = -slope / curvature;
    let mut now = 0.0;
    let mut heap = BinaryHeap::from(breakpoints);
    while let Some(Breakpoint(time, i)) = heap.pop() {
        let dt = time - now;
        if to_minimum < dt {
            break;
        }
        let g = gradient[i];
        point[i] = if g < 0.0 { upper[i] } else { lower[i] };
        let z = point[i] - x[i];
        c.iter_mut().zip(&p).for_each(|(c, p)| *c += dt * p);
        let w = memory.row(i);
        let mw = memory.middle(&w);
        slope += dt * curvature + g * g + theta * g * z - g * dot(&mw, &c);
        curvature += -theta * g * g - 2.0 * g * dot(&mw, &p) - g * g * dot(&mw, &w);
        curvature = curvature.max(least);
        p.iter_mut().zip(&w).for_each(|(p, w)| *p += g * w);
        d[i] = 0.0;
        to_minimum = -slope / curvature;
        now = time;
        // Past the last breakpoint of a path that is bounded everywhere nothing moves any more.
        let falling = slope < 0.0;
        if !falling {
            to_minimum = 0.0;
            break;
        }
    }
    let dt = to_minimum.max(0.0);
    now += dt;
    for i in 0..x.len() {
        if d[i] != 0.0 {
            point[i] = (x[i] + now * d[i]).clamp(lower[i], upper[i]);
        }
    }
    c.iter_mut().zip(&p).for_each(|(c, p)| *c += dt * p);
    Cauchy { point, c }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(x: &[f64], point: &[f64], gradient: &[f64], memory: &Memory) -> f64 {
        let d: Vec<f64> = point.iter().zip(x).map(|(p, x)| p - x).collect();
        let w = memory.transposed(&d);
        dot(gradient, &d) + 0.5 * (memory.theta * dot(&d, &d) - dot(&w, &memory.middle(&w)))
    }

    #[test]
    fn it_is_the_first_minimum_on_the_projected_path_found_by_small_steps() {
        let mut memory = Memory::new(4);
        for k in 0..3 {
            let s: Vec<f64> = (0..6).map(|i| ((i * 5 + k * 3) as f64).sin()).collect();
            let y = s.iter().enumerate().map(|(i, s)| s * (1.0 + i as f64)).collect();
            memory.push(s, y);
        }
        let x = [0.0, 0.5, -0.5, 0.2, 0.9, 0.0];
        let gradient = [1.0, -2.0, 3.0, -0.5, -4.0, 0.0];
        let (lower, upper) = ([-0.1, -1.0, -1.0, f64::NEG_INFINITY, -1.0, -1.0], [1.0; 6]);
        let found = cauchy_point(&x, &gradient, &lower, &upper, &memory);
        let path =
            |t: f64| -> Vec<f64> { (0..6).map(|i| (x[i] - t * gradient[i]).clamp(lower[i], upper[i])).collect() };
        let mut t = 0.0;
        while model(&x, &path(t + 1e-5), &gradient, &memory) < model(&x, &path(t), &gradient, &memory) {
            t += 1e-5;
        }
        assert!(t > 0.05, "the path must pass breakpoints: {t}");
        for (f, p) in found.point.iter().zip(path(t)) {
            // The step of the search, times the largest gradient.
            assert!((f - p).abs() < 4.0 * 2e-5, "{f} {p}");
        }
        let d: Vec<f64> = found.point.iter().zip(&x).map(|(p, x)| p - x).collect();
        for (c, truth) in found.c.iter().zip(memory.transposed(&d)) {
            assert!((c - truth).abs() < 1e-12);
        }
    }
}
