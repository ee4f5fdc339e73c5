//! What a march leaves in each pixel.

/// One pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel {
    /// Radiance that comes from the medium, RGB, premultiplied by nature; and that of visible environments behind it.
    pub radiance: [f32; 3],
    /// Fraction of the background that is seen, per channel, in [0, 1].
    pub transmittance: [f32; 3],
    /// Distance along the viewing direction to the first density, world units; infinite where there is none.
    pub depth: f32,
}

impl Pixel {
    /// A pixel that meets no density.
    pub const EMPTY: Self = Self { radiance: [0.0; 3], transmittance: [1.0; 3], depth: f32::INFINITY };

    /// Opacity: 1 less the mean transmittance.
    pub fn alpha(&self) -> f32 {
        1.0 - self.transmittance.iter().sum::<f32>() / 3.0
    }
}

/// An image of pixels, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Film {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// `width * height` pixels.
    pub pixels: Vec<Pixel>,
}

impl Film {
    /// An image of empty pixels.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, pixels: vec![Pixel::EMPTY; width * height] }
    }
}
