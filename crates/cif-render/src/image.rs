//! What comes out per pixel.

use cif_geometry::PixelGrid;

/// Label of pixels without instance. In label maps, value k + 1 stands for dense instance index k.
pub const UNLABELLED: u16 = 0;

/// Which outputs to compute.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Channels {
    /// Expected depth.
    pub depth: bool,
    /// Instance argmax, probability, coverage and entropy; needs identities.
    pub instances: bool,
}

/// Whose weights values per Gaussian are blended with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BlendingWeights {
    /// Those of colour: opacity and its transmittance.
    #[default]
    Color,
    /// Those of the instance pass: occupancy and its transmittance.
    Instances,
}

/// A rendered view.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedImage {
    /// Colour composited on the background, not clamped.
    pub color: PixelGrid<[f32; 3]>,
    /// Colour coverage 1 - T.
    pub alpha: PixelGrid<f32>,
    /// Expected camera depth z, metres; 0 where coverage is below 1e-3.
    pub depth: Option<PixelGrid<f32>>,
    /// Instance outputs.
    pub instances: Option<InstanceImage>,
}

/// Instance outputs of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct InstanceImage {
    /// Most probable instance: dense index + 1, or [`UNLABELLED`] where nothing covers the pixel. Ties go
    /// to the lowest index.
    pub label: PixelGrid<u16>,
    /// Rendered probability M of that instance.
    pub probability: PixelGrid<f32>,
    /// Instance coverage A = sum of M over all instances.
    pub coverage: PixelGrid<f32>,
    /// Probability that what is seen at the pixel belongs to any instance rather than to the unlabelled rest:
    /// the labelled shares of its Gaussians ([`cif_field::Identities::labelled_shares`]), blended like colour.
    pub foreground: PixelGrid<f32>,
    /// Entropy of M / A, nats; 0 without coverage.
    pub entropy: PixelGrid<f32>,
}

/// The most probable instances of every pixel, for layers that hold several objects per pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct InstanceRanks {
    /// Most probable first: dense index + 1, or [`UNLABELLED`] where there are no more, and the rendered
    /// probability M of that instance. Ties go to the lowest index.
    pub ranks: Vec<(PixelGrid<u16>, PixelGrid<f32>)>,
}

/// Foreground from which a pixel is taken to belong to its most probable instance.
const FOREGROUND: f32 = 0.5;

impl InstanceImage {
    /// The most probable instance where the pixel belongs to any, else [`UNLABELLED`]: what a compositor
    /// wants, while the metrics force every pixel to an instance (methods reference 9).
    #[must_use]
    pub fn foreground_label(&self) -> PixelGrid<u16> {
        let mut label = self.label.clone();
        for (label, foreground) in label.pixels.iter_mut().zip(&self.foreground.pixels) {
            if *foreground < FOREGROUND {
                *label = UNLABELLED;
            }
        }
        label
    }
}
