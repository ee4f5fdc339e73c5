//! Least-squares prediction that learns as it goes.
pub(super) struct LeastSquares<const N: usize> {
    covariance: [[f32; N]; N],
    cross: [f32; N],
    weights: [f32; N],
    gain: f32,
    growth: f32,
    ridge: f32,
    interval: u32,
    countdown: u32,
}

impl<const N: usize> LeastSquares<N> {
    pub(super) fn new(decay: f32, ridge: f32, interval: u32) -> Self {
        let mut weights = [0.0; N];
        // 3-D Lorenzo-like start: mean of the three face neighbours.
        for w in weights.iter_mut().take(3) {
            *w = 1.0 / 3.0;
        }
        Self {
            covariance: [[0.0; N]; N],
            cross: [0.0; N],
            weights,
            gain: 1.0,
            growth: 1.0 / decay,
            ridge,
            interval,
            countdown: interval,
        }
    }

    #[inline]
    pub(super) fn predict(&self, taps: &[f32; N]) -> f32 {
        let mut lanes = [0.0f32; 8];
        for (t, w) in taps.chunks_exact(8).zip(self.weights.chunks_exact(8)) {
            for l in 0..8 {
                lanes[l] += t[l] * w[l];
            }
        }
        ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]))
    }

    #[inline]
    pub(super) fn update(&mut self, taps: &[f32; N], value: f32, weight: f32) {
        let g = weight * self.gain;
        for i in 0..N {
            let s = taps[i] * g;
            // lower triangle, rounded up to whole blocks of 8
            let end = (i / 8 + 1) * 8;
            for (c, t) in self.covariance[i][..end].iter_mut().zip(&taps[..end]) {
                *c += s * t;
            }
        }
        let s = value * g;
        for (c, t) in self.cross.iter_mut().zip(taps) {
            *c += s * t;
        }
        self.gain *= self.growth;
        self.countdown -= 1;
        if self.countdown == 0 {
            self.countdown = self.interval;
            if self.gain > 1e4 {
                let r = 1.0 / self.gain;
                self.covariance.iter_mut().flatten().for_each(|c| *c *= r);
                self.cross.iter_mut().for_each(|c| *c *= r);
                self.gain = 1.0;
            }
            self.solve();
        }
    }

    fn solve(&mut self) {
        let mut trace = 0.0;
        for i in 0..N {
            trace += self.covariance[i][i];
        }
        let ridge = self.ridge * self.gain + 1e-5 * trace;
        // Cholesky: l[i][j], and the reciprocal diagonal. ridge pulls towards the old...
        let mut l = [[0.0f32; N]; N];
        let mut inv = [0.0f32; N];
        let mut y = [0.0f32; N];
        for i in 0..N {
            let (done, rest) = l.split_at_mut(i);
            let row = &mut rest[0];
            for j in 0..i {
                let mut lanes = [0.0f32; 8];
                let blocks = j.div_ceil(8) * 8;
                for (a, b) in row[..blocks].chunks_exact(8).zip(done[j][..blocks].chunks_exact(8)) {
                    for k in 0..8 {
                        lanes[k] += a[k] * b[k];
                    }
                }
                let dot =
                    ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]));
                row[j] = (self.covariance[i][j] - dot) * inv[j];
            }
            let mut d = self.covariance[i][i] + ridge;
            let mut s = self.cross[i];
            for j in 0..i {
                d -= row[j] * row[j];
                s -= row[j] * y[j];
            }
            if !(d > 0.0) {
                return;
            }
            inv[i] = 1.0 / d.sqrt();
            y[i] = s * inv[i];
        }
        let mut w = [0.0f32; N];
        for i in (0..N).rev() {
            let mut s = y[i];
            for j in i + 1..N {
                s -= l[j][i] * w[j];
            }
            w[i] = s * inv[i];
        }
        if w.iter().all(|v| v.abs() < 1e3) {
            self.weights = w;
        }
    }
}
