//! Row-major pixel grids.

/// `width * height` values, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelGrid<T> {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height * width]`, row-major.
    pub pixels: Vec<T>,
}

impl<T: Clone> PixelGrid<T> {
    /// A grid with every pixel set to `value`.
    #[must_use]
    pub fn filled(width: u32, height: u32, value: T) -> Self {
        Self { width, height, pixels: vec![value; width as usize * height as usize] }
    }
}

impl<T> PixelGrid<T> {
    /// Wraps row-major values.
    ///
    /// # Panics
    /// When the length is not `width * height`.
    #[must_use]
    pub fn from_pixels(width: u32, height: u32, pixels: Vec<T>) -> Self {
        assert_eq!(
            pixels.len(),
            width as usize * height as usize,
            "pixel count differs from {width} x {height}"
        );
        Self { width, height, pixels }
    }

    /// The pixel in column `x` of row `y`.
    ///
    /// # Panics
    /// Outside the grid.
    #[must_use]
    pub fn at(&self, x: u32, y: u32) -> &T {
        assert!(
            x < self.width && y < self.height,
            "pixel ({x}, {y}) outside {} x {}",
            self.width,
            self.height
        );
        &self.pixels[y as usize * self.width as usize + x as usize]
    }

    /// A grid of the same size with every pixel mapped.
    #[must_use]
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> PixelGrid<U> {
        PixelGrid { width: self.width, height: self.height, pixels: self.pixels.iter().map(f).collect() }
    }
}
