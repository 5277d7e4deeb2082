//! Inputs of the stages, and the counts and gradients that they leave.

use cif_field::gaussians::SH_FLOATS;
use cif_geometry::PinholeCamera;

use crate::RenderSettings;
use crate::wgpu::buffers::GpuVec;
use crate::wgpu::gaussians::{GEOMETRY_FLOATS, GpuGaussians, PACKED_SH_WORDS};
use crate::wgpu::view::work;

/// Labels of a view on the device.
#[derive(Clone, Copy, Debug)]
pub struct LabelInput<'a> {
    /// Dense instance index + 1 per pixel, 0 = unlabelled.
    pub labels: &'a GpuVec<u32>,
    /// Number of labelled pixels.
    pub labelled_pixels: usize,
    /// Weight of the view's mean instance loss; 0 differentiates nothing.
    pub weight: f32,
}

/// Gaussians at the time of a view.
#[derive(Clone, Copy, Debug)]
pub struct PosedInput<'a> {
    /// As in [`GpuGaussians::geometry`].
    pub geometry: &'a GpuVec<[f32; GEOMETRY_FLOATS]>,
    /// As in [`GpuGaussians::sh`].
    pub sh: &'a GpuVec<[f32; SH_FLOATS]>,
    /// Turns of the frames that the spherical harmonics are in, unit quaternions (w, x, y, z); `None` where all are
    /// in that of the world.
    pub turns: Option<&'a GpuVec<[f32; 4]>>,
}

impl<'a> From<&'a GpuGaussians> for PosedInput<'a> {
    fn from(gaussians: &'a GpuGaussians) -> Self {
        Self { geometry: &gaussians.geometry, sh: &gaussians.sh, turns: None }
    }
}

impl<'a> PosedInput<'a> {
    pub(crate) fn coefficients(self) -> Coefficients<'a> {
        self.turns.map_or(Coefficients::Full(self.sh), |turns| Coefficients::Turned(self.sh, turns))
    }
}

/// Spherical harmonics at the time of a view.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Coefficients<'a> {
    /// As in [`GpuGaussians::sh`].
    Full(&'a GpuVec<[f32; SH_FLOATS]>),
    /// As [`crate::wgpu::gaussians::packed_sh`] makes them.
    Packed(&'a GpuVec<[u32; PACKED_SH_WORDS]>),
    /// As in [`GpuGaussians::sh`], in frames that are turned as in [`PosedInput::turns`].
    Turned(&'a GpuVec<[f32; SH_FLOATS]>, &'a GpuVec<[f32; 4]>),
}

/// Gaussians at the time of a view, their spherical harmonics in any form.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PosedGaussians<'a> {
    /// As in [`GpuGaussians::geometry`].
    pub(crate) geometry: &'a GpuVec<[f32; GEOMETRY_FLOATS]>,
    /// Spherical harmonics.
    pub(crate) sh: Coefficients<'a>,
}

/// A view to be drawn.
#[derive(Clone, Copy, Debug)]
pub struct ViewInput<'a> {
    /// Camera.
    pub camera: &'a PinholeCamera,
    /// Settings; `deform` is not read, Gaussians are posed already.
    pub settings: &'a RenderSettings,
    /// Labels, for the instance pass of training.
    pub labels: Option<LabelInput<'a>>,
}

/// Counts of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GpuStatistics {
    /// Gaussians with a non-empty footprint in the view.
    pub visible: u32,
    /// (tile, Gaussian) pairs that there are; 2^32 - 1 stands for that many or more.
    pub wanted_pairs: u32,
    /// Label slots that there are, likewise.
    pub wanted_slots: u32,
    /// Pairs that were drawn: all, or none when they did not fit.
    pub pairs: u32,
}

impl GpuStatistics {
    /// Words of the counts.
    pub const WORDS: usize = work::LEN;
    /// Word of the pairs that there are.
    pub const WANTED_PAIRS: usize = work::WANTED_PAIRS;
    /// Word of those that were drawn.
    pub const PAIRS: usize = work::PAIRS;

    /// From the first elements of the work counts.
    #[must_use]
    pub fn of(counts: &[u32]) -> Self {
        Self {
            visible: counts[work::VISIBLE],
            wanted_pairs: counts[work::WANTED_PAIRS],
            wanted_slots: counts[work::WANTED_SLOTS],
            pairs: counts[work::PAIRS],
        }
    }

    /// True when the view was drawn.
    #[must_use]
    pub fn fits(&self) -> bool {
        self.pairs == self.wanted_pairs
    }
}

/// Gradients of the last backward pass, written over each time.
#[derive(Debug)]
pub struct PosedGradients {
    /// By the posed Gaussians, same layout.
    pub gaussians: GpuGaussians,
    /// `[N]`: gradient by the projected centre in normalised device coordinates (W / 2 v_x, H / 2 v_y), screen radius
    /// in pixels, 1 where visible.
    pub screen: GpuVec<[f32; 4]>,
    /// By the calibration of every identity entry; not written without instance loss.
    pub calibrations: GpuVec<f32>,
}
