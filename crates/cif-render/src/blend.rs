//! C values of every Gaussian blended into an image, `sum_i T_i alpha_i v_i`, and back: what the three renderers take
//! and give. Source: methods reference 8.

/// Weights `T_i alpha_i` that values per Gaussian are blended with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Blending {
    /// Those of colour: the opacity and its transmittance.
    #[default]
    Color,
    /// Those of the instance pass: the occupancy, by its own logit or as [`crate::OccupancySource`] says, and a
    /// transmittance of its own. The view is projected with [`crate::RenderSettings::instances`]; a head with another
    /// logit than the occupancy puts it in that one's place.
    Own,
}

/// Values to be blended; `V` is `[f32]`, `[f64]` in the double-precision reference, or an array on a device.
#[derive(Debug)]
pub struct BlendRequest<'a, V: ?Sized = [f32]> {
    /// `[N, C]`, by row of the field.
    pub values: &'a V,
    /// Number of channels C, at least 1.
    pub channels: usize,
    /// Weights.
    pub blending: Blending,
}

impl<V: ?Sized> Clone for BlendRequest<'_, V> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<V: ?Sized> Copy for BlendRequest<'_, V> {}

impl<'a, R> BlendRequest<'a, [R]> {
    /// The C values of a Gaussian.
    ///
    /// # Panics
    /// When there are fewer values.
    #[must_use]
    pub fn of(&self, gaussian: usize) -> &'a [R] {
        &self.values[gaussian * self.channels..(gaussian + 1) * self.channels]
    }
}

/// Blended values of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct BlendedImage<R = f32> {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Number of channels C.
    pub channels: usize,
    /// `[height, width, C]`; 0 where nothing covers the pixel. Divided by the blended 1 it is the mean over what the
    /// pixel shows.
    pub values: Vec<R>,
}

impl<R: Clone> BlendedImage<R> {
    /// The same value everywhere.
    pub(crate) fn filled(width: u32, height: u32, channels: usize, value: R) -> Self {
        let values = vec![value; width as usize * height as usize * channels];
        Self { width, height, channels, values }
    }
}

impl<R> BlendedImage<R> {
    /// The C values of every pixel, row by row.
    ///
    /// # Panics
    /// Without channels.
    pub fn pixels(&self) -> std::slice::ChunksExact<'_, R> {
        self.values.chunks_exact(self.channels)
    }
}
