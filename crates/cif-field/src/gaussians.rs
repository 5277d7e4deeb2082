//! Canonical Gaussians as a struct of arrays, in the raw form that the optimiser holds.

use cif_geometry::quaternion;
use cif_geometry::scalar::{logit, sigmoid};
use cif_geometry::spherical_harmonics::{BAND_0, COEFFICIENTS};
use rayon::prelude::*;

use crate::error::{FieldError, finite};
use crate::neighbours::NearestNeighbours;
use crate::parameters::{self, Parameter, Tensor, TensorMut};

/// Floats of spherical harmonics per Gaussian: `[16, 3]`.
pub const SH_FLOATS: usize = COEFFICIENTS * 3;

/// Opacity of fresh Gaussians (methods reference 1.1).
pub const INITIAL_OPACITY: f64 = 0.1;

/// Occupancy of fresh Gaussians (methods reference A5).
pub const INITIAL_OCCUPANCY: f64 = 0.02;

/// Floor of the mean squared distance to neighbours that sets a fresh Gaussian's size, metres^2.
pub const MIN_SQUARED_DISTANCE: f64 = 1e-7;

/// Neighbours that set a fresh Gaussian's size.
const NEIGHBOURS: usize = 3;

/// Log-scales are clamped to this range when activated, as the renderer does (methods reference 7, row 14).
pub const LOG_SCALE_RANGE: (f32, f32) = (-20.0, 10.0);

/// Log-scales below this are those of an imported splat that is flat along the axis: its scale is 0, of which the
/// logarithm of the smallest normal number (-87.34) stands for the logarithm.
pub const FLAT_LOG_SCALE: f32 = -87.0;

/// Logit beyond that of the smallest positive number in single precision: its sigmoid is 0, and that of its
/// opposite 1.
const SATURATED_LOGIT: f64 = 104.0;

/// Raw logit of a probability; finite for 0 and 1 too, where the sigmoid of it is 0 and 1 again in single precision.
#[must_use]
pub fn saturated_logit(probability: f64) -> f32 {
    logit(probability).clamp(-SATURATED_LOGIT, SATURATED_LOGIT) as f32
}

/// A row of a parameter: one float, or an array of them.
trait Row: bytemuck::Pod {
    fn floats(rows: &[Self]) -> &[f32];
    fn floats_mut(rows: &mut [Self]) -> &mut [f32];
}

impl Row for f32 {
    fn floats(rows: &[Self]) -> &[f32] {
        rows
    }
    fn floats_mut(rows: &mut [Self]) -> &mut [f32] {
        rows
    }
}

impl<const WIDTH: usize> Row for [f32; WIDTH]
where
    Self: bytemuck::Pod,
{
    fn floats(rows: &[Self]) -> &[f32] {
        rows.as_flattened()
    }
    fn floats_mut(rows: &mut [Self]) -> &mut [f32] {
        rows.as_flattened_mut()
    }
}

/// Makes the set of Gaussians, and what only carries it, from one list of parameters.
macro_rules! gaussian_parameters {
    ($($(#[$doc:meta])* $field:ident: $row:ty = $parameter:expr;)*) => {
        /// N Gaussians; every array has N entries (times its row length). Arrays that nothing has to say about may
        /// be empty where a function says so.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct Gaussians {
            $($(#[$doc])* pub $field: Vec<$row>,)*
        }

        /// Consecutive rows of [`Gaussians`], to be changed.
        #[derive(Debug)]
        pub struct GaussiansMut<'a> {
            $($(#[$doc])* pub $field: &'a mut [$row],)*
        }

        impl Gaussians {
            /// Number of parameters of a Gaussian.
            pub const PARAMETERS: usize = [$(stringify!($field)),*].len();

            /// Zeros.
            #[must_use]
            pub fn zeros(rows: usize) -> Self {
                Self::zeros_of(rows, |_| true)
            }

            /// Zeros of the parameters that are `needed`; the arrays of the others are empty.
            #[must_use]
            pub fn zeros_of(rows: usize, needed: impl Fn(&Parameter) -> bool) -> Self {
                // Fresh memory is zero already: nothing is written.
                Self { $($field: bytemuck::zeroed_vec(if needed(&$parameter) { rows } else { 0 }),)* }
            }

            /// Every parameter with its values.
            #[must_use]
            pub fn tensors(&self) -> [Tensor<'_>; Self::PARAMETERS] {
                [$(($parameter, Row::floats(&self.$field[..]))),*]
            }

            /// As [`Self::tensors`], to be changed.
            pub fn tensors_mut(&mut self) -> [TensorMut<'_>; Self::PARAMETERS] {
                self.rows_mut().into_tensors()
            }

            /// The values of one parameter.
            ///
            /// # Panics
            /// When it is not one of a Gaussian.
            #[must_use]
            pub fn tensor(&self, parameter: &Parameter) -> &[f32] {
                let mut tensors = self.tensors().into_iter();
                tensors.find(|(other, _)| other == parameter).expect("a parameter of Gaussians").1
            }

            /// As [`Self::tensor`], to be changed.
            ///
            /// # Panics
            /// As [`Self::tensor`].
            pub fn tensor_mut(&mut self, parameter: &Parameter) -> &mut [f32] {
                self.rows_mut().into_tensor(parameter)
            }

            /// A set whose arrays hold what `values` gives for each parameter.
            ///
            /// # Errors
            /// The first error of `values`.
            pub fn try_from_rows<E>(mut values: impl RowSource<E>) -> Result<Self, E> {
                Ok(Self { $($field: values.rows::<$row>(&$parameter)?,)* })
            }

            /// All rows, to be changed.
            pub fn rows_mut(&mut self) -> GaussiansMut<'_> {
                GaussiansMut { $($field: &mut self.$field,)* }
            }

            /// Rows `sources[0], sources[1], ...` as a new set; rows may repeat.
            ///
            /// # Panics
            /// When a source is out of range.
            #[must_use]
            pub fn gather(&self, sources: &[u32]) -> Self {
                Self { $($field: sources.iter().map(|&row| self.$field[row as usize]).collect(),)* }
            }

            /// Makes row `to` a copy of row `from`.
            ///
            /// # Panics
            /// When one is out of range.
            pub fn copy_row(&mut self, to: usize, from: usize) {
                $(self.$field[to] = self.$field[from];)*
            }

            /// Adds the rows of `other` at the end.
            pub fn append(&mut self, other: &Self) {
                $(self.$field.extend_from_slice(&other.$field);)*
            }

            /// Keeps the rows whose flag is set, in order and in place.
            ///
            /// # Panics
            /// When there are not N flags.
            pub fn retain(&mut self, keep: &[bool]) {
                assert_eq!(keep.len(), self.len(), "one flag per Gaussian");
                $({
                    let mut flags = keep.iter();
                    self.$field.retain(|_| *flags.next().expect("all arrays have N rows"));
                })*
            }

            /// The set with the arrays that are empty taken from `other`.
            #[must_use]
            pub fn or(self, other: &Self) -> Self {
                Self { $($field: if self.$field.is_empty() { other.$field.clone() } else { self.$field },)* }
            }
        }

        impl<'a> GaussiansMut<'a> {
            /// Every parameter with its values.
            #[must_use]
            pub fn into_tensors(self) -> [TensorMut<'a>; Gaussians::PARAMETERS] {
                [$(($parameter, Row::floats_mut(self.$field))),*]
            }

            /// The values of one parameter.
            ///
            /// # Panics
            /// When it is not one of a Gaussian.
            #[must_use]
            pub fn into_tensor(self, parameter: &Parameter) -> &'a mut [f32] {
                let mut tensors = self.into_tensors().into_iter();
                tensors.find(|(other, _)| other == parameter).expect("a parameter of Gaussians").1
            }

            /// The same rows, for a shorter time.
            pub fn reborrow(&mut self) -> GaussiansMut<'_> {
                GaussiansMut { $($field: &mut *self.$field,)* }
            }

            /// The first `rows` rows, and the others; arrays that have fewer stay whole.
            #[must_use]
            pub fn split_at(self, rows: usize) -> (Self, Self) {
                $(let $field = self.$field.split_at_mut(rows.min(self.$field.len()));)*
                (Self { $($field: $field.0,)* }, Self { $($field: $field.1,)* })
            }

            /// Consecutive groups of `rows` rows, the last one with what is left, of `count` in all.
            #[must_use]
            pub fn chunks(self, rows: usize, count: usize) -> Vec<Self> {
                let mut rest = self;
                let mut chunks = Vec::with_capacity(count.div_ceil(rows));
                for _ in 0..count.div_ceil(rows) {
                    let (chunk, others) = rest.split_at(rows);
                    chunks.push(chunk);
                    rest = others;
                }
                chunks
            }
        }
    };
}

gaussian_parameters! {
    /// Centres x, world, metres.
    means: [f32; 3] = parameters::MEANS;
    /// Raw log-scales s: the standard deviation along each axis is `exp(s)`, metres.
    log_scales: [f32; 3] = parameters::LOG_SCALES;
    /// Raw quaternions (w, x, y, z), not normalised.
    quaternions: [f32; 4] = parameters::QUATERNIONS;
    /// Raw opacity logits a.
    opacity_logits: f32 = parameters::OPACITY_LOGITS;
    /// Raw occupancy logits h.
    occupancy_logits: f32 = parameters::OCCUPANCY_LOGITS;
    /// Spherical harmonics `[16, 3]`, coefficient-major, RGB inner; always degree 3 in storage.
    sh_coefficients: [f32; SH_FLOATS] = parameters::SH_COEFFICIENTS;
}

/// Where [`Gaussians::try_from_rows`] takes values from.
pub trait RowSource<E> {
    /// The rows of a parameter.
    ///
    /// # Errors
    /// When there are none.
    fn rows<T: bytemuck::Pod>(&mut self, parameter: &Parameter) -> Result<Vec<T>, E>;
}

impl Gaussians {
    /// Number of Gaussians N.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Fresh isotropic Gaussians at `positions` (world, metres) with display-referred RGB `colors` in [0, 1]:
    /// the standard deviation is the root mean squared distance to the 3 nearest other points (coincident
    /// points count, at distance 0), the rotation is the identity, bands 1 to 3 are 0. Source: methods
    /// reference 1.1.
    ///
    /// # Errors
    /// When the lengths differ or a value is not finite.
    pub fn from_points(positions: &[[f32; 3]], colors: &[[f32; 3]]) -> Result<Self, FieldError> {
        let n = positions.len();
        if colors.len() != n {
            return Err(FieldError::Length { array: "colors", found: colors.len(), expected: n });
        }
        finite("positions", positions.as_flattened(), 3)?;
        finite("colors", colors.as_flattened(), 3)?;
        let neighbours = NearestNeighbours::new(positions);
        let log_scales = (0..n)
            .into_par_iter()
            .map(|row| {
                let nearest = neighbours.nearest_to_row(row, NEIGHBOURS);
                let sum: f64 = nearest.iter().map(|neighbour| neighbour.squared_distance).sum();
                let mean = (sum / nearest.len().max(1) as f64).max(MIN_SQUARED_DISTANCE);
                [(mean.ln() / 2.0) as f32; 3]
            })
            .collect();
        let sh_coefficients = colors
            .iter()
            .map(|color| {
                let mut coefficients = [0.0; SH_FLOATS];
                for channel in 0..3 {
                    coefficients[channel] = ((f64::from(color[channel]) - 0.5) / BAND_0) as f32;
                }
                coefficients
            })
            .collect();
        Ok(Self {
            means: positions.to_vec(),
            log_scales,
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![logit(INITIAL_OPACITY) as f32; n],
            occupancy_logits: vec![logit(INITIAL_OCCUPANCY) as f32; n],
            sh_coefficients,
        })
    }

    /// Opacity of a row, in [0, 1].
    #[must_use]
    pub fn opacity(&self, row: usize) -> f32 {
        sigmoid(self.opacity_logits[row])
    }

    /// Occupancy of a row, in [0, 1].
    #[must_use]
    pub fn occupancy(&self, row: usize) -> f32 {
        sigmoid(self.occupancy_logits[row])
    }

    /// Standard deviations of a row along its axes, metres; log-scales are clamped to [`LOG_SCALE_RANGE`].
    #[must_use]
    pub fn scale(&self, row: usize) -> [f32; 3] {
        self.log_scales[row].map(|s| s.clamp(LOG_SCALE_RANGE.0, LOG_SCALE_RANGE.1).exp())
    }

    /// Unit quaternion (w, x, y, z) of a row; `None` when its norm is below
    /// [`cif_geometry::quaternion::MIN_NORM`], in which case the Gaussian is not drawn.
    #[must_use]
    pub fn unit_quaternion(&self, row: usize) -> Option<[f32; 4]> {
        quaternion::try_normalize(self.quaternions[row])
    }

    /// Covariance `R diag(scale^2) R^T` of a row in the order xx, xy, xz, yy, yz, zz, metres^2; `None` when
    /// it has no rotation.
    #[must_use]
    pub fn covariance(&self, row: usize) -> Option<[f32; 6]> {
        let rotation = quaternion::to_rotation(self.unit_quaternion(row)?);
        let scale = self.scale(row);
        let entry = |i: usize, j: usize| {
            (0..3).map(|k| (rotation[i][k] * scale[k]) * (rotation[j][k] * scale[k])).sum::<f32>()
        };
        Some([entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)])
    }

    /// Display-referred RGB of a row without its view dependence: band 0 alone, clamped at 0.
    #[must_use]
    pub fn base_color(&self, row: usize) -> [f32; 3] {
        let coefficients = &self.sh_coefficients[row];
        std::array::from_fn(|channel| (BAND_0 as f32 * coefficients[channel] + 0.5).max(0.0))
    }

    /// Rows in Morton (Z-curve) order of their centres, so that neighbours in space are neighbours in memory
    /// after [`Gaussians::gather`]; ties keep their order.
    #[must_use]
    pub fn morton_order(&self) -> Vec<u32> {
        let mut low = [f32::INFINITY; 3];
        let mut high = [f32::NEG_INFINITY; 3];
        for mean in &self.means {
            for axis in 0..3 {
                low[axis] = low[axis].min(mean[axis]);
                high[axis] = high[axis].max(mean[axis]);
            }
        }
        // One step for all axes, so that cells are cubes; in f64, where no finite box overflows.
        let side = (0..3).map(|axis| f64::from(high[axis]) - f64::from(low[axis])).fold(0.0, f64::max);
        let cells = f64::from((1_u32 << MORTON_BITS) - 1);
        let step = if side > 0.0 && side.is_finite() { cells / side } else { 0.0 };
        let code = |mean: &[f32; 3]| {
            (0..3).fold(0_u64, |code, axis| {
                // A NaN becomes cell 0 in the cast.
                let cell = ((f64::from(mean[axis]) - f64::from(low[axis])) * step) as u64;
                code | spread_bits(cell.min(cells as u64)) << axis
            })
        };
        let codes: Vec<u64> = self.means.par_iter().map(code).collect();
        let mut order: Vec<u32> = (0..self.len() as u32).collect();
        order.par_sort_unstable_by_key(|&row| (codes[row as usize], row));
        order
    }
}

/// Bits per axis of a Morton code; three axes fit 64 bits.
const MORTON_BITS: u32 = 21;

/// Moves bit i of the lowest 21 bits to bit 3 i.
fn spread_bits(value: u64) -> u64 {
    let mut v = value & 0x1f_ffff;
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests;
