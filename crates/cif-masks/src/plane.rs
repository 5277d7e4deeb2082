//! Single-precision image planes: resizing, blurring, sampling.

/// `width * height` values, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Plane {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[height * width]`, row-major.
    pub data: Vec<f32>,
}

impl Plane {
    /// A plane with every pixel set to `value`.
    #[must_use]
    pub fn filled(width: usize, height: usize, value: f32) -> Self {
        Self { width, height, data: vec![value; width * height] }
    }

    /// A plane whose pixels are `f(x, y)`.
    #[must_use]
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            data.extend((0..width).map(|x| f(x, y)));
        }
        Self { width, height, data }
    }

    /// Row `y`, clamped to the plane.
    pub(crate) fn row(&self, y: isize) -> &[f32] {
        let y = y.clamp(0, self.height as isize - 1) as usize;
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// Bilinear sample at (x, y) in units of pixels, where integers are the centres of pixels; the border continues.
    #[must_use]
    pub fn sample(&self, x: f32, y: f32) -> f32 {
        let tap = Tap::new(self.width, self.height, x, y);
        tap.of(&self.data)
    }

    /// The average of blocks of 2 x 2 pixels; odd sides lose nothing, because the last block repeats the border.
    #[must_use]
    pub(crate) fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            let (a, b) = (self.row(2 * y as isize), self.row(2 * y as isize + 1));
            for x in 0..width {
                let (left, right) = (2 * x, (2 * x + 1).min(self.width - 1));
                data.push(0.25 * (a[left] + a[right] + b[left] + b[right]));
            }
        }
        Self { width, height, data }
    }

    /// Bilinear resize to another size.
    #[must_use]
    pub(crate) fn resized(&self, width: usize, height: usize) -> Self {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let step_x = self.width as f32 / width as f32;
        let step_y = self.height as f32 / height as f32;
        Self::from_fn(width, height, |x, y| {
            self.sample((x as f32 + 0.5) * step_x - 0.5, (y as f32 + 0.5) * step_y - 0.5)
        })
    }

    /// Gaussian blur with standard deviation `sigma`, pixels; the border continues.
    #[must_use]
    pub(crate) fn blurred(&self, sigma: f32) -> Self {
        let kernel = gaussian(sigma);
        let radius = kernel.len() / 2;
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0_f32; width * height];
        let mut padded = vec![0.0_f32; width + 2 * radius];
        for (source, out) in self.data.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
            padded[..radius].fill(source[0]);
            padded[radius..radius + width].copy_from_slice(source);
            padded[radius + width..].fill(source[width - 1]);
            for (k, weight) in kernel.iter().enumerate() {
                for (out, value) in out.iter_mut().zip(&padded[k..k + width]) {
                    *out += weight * value;
                }
            }
        }
        let mut data = vec![0.0_f32; width * height];
        for (y, out) in data.chunks_exact_mut(width).enumerate() {
            for (k, weight) in kernel.iter().enumerate() {
                let source = (y + k).saturating_sub(radius).min(height - 1);
                for (out, value) in out.iter_mut().zip(&across[source * width..(source + 1) * width]) {
                    *out += weight * value;
                }
            }
        }
        Self { width, height, data }
    }
}

/// Weights of a Gaussian, summing to 1, out to three standard deviations.
fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as isize;
    let weights: Vec<f32> = (-radius..=radius).map(|k| (-0.5 * (k as f32 / sigma).powi(2)).exp()).collect();
    let sum: f32 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / sum).collect()
}

/// The four pixels around a place and their bilinear weights.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tap {
    index: [usize; 4],
    weight: [f32; 4],
}

impl Tap {
    /// The pixels around (x, y); places outside are moved to the border.
    pub(crate) fn new(width: usize, height: usize, x: f32, y: f32) -> Self {
        // `max` before `min` turns NaN into 0.
        let x = x.max(0.0).min((width - 1) as f32);
        let y = y.max(0.0).min((height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        Self {
            index: [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1],
            weight: [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy],
        }
    }

    /// The weighted sum of a plane's values.
    pub(crate) fn of(&self, data: &[f32]) -> f32 {
        (0..4).map(|k| self.weight[k] * data[self.index[k]]).sum()
    }

    /// The weighted sum of rows of `length` values, one row per pixel.
    pub(crate) fn of_rows(&self, data: &[f32], length: usize, out: &mut [f32]) {
        let row = |k: usize| &data[self.index[k] * length..(self.index[k] + 1) * length];
        let (a, b, c, d) = (row(0), row(1), row(2), row(3));
        let [wa, wb, wc, wd] = self.weight;
        for (k, out) in out.iter_mut().enumerate() {
            *out = wa * a[k] + wb * b[k] + wc * c[k] + wd * d[k];
        }
    }
}
