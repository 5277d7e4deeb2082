//! Images that renderers return.

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

impl RenderedImage {
    /// Adds rows of the same view below.
    ///
    /// # Panics
    /// When they have another width or other outputs.
    pub(crate) fn append(&mut self, below: Self) {
        let outputs = |image: &Self| (image.depth.is_some(), image.instances.is_some());
        assert_eq!(outputs(self), outputs(&below), "outputs of one view");
        append(&mut self.color, below.color);
        append(&mut self.alpha, below.alpha);
        if let (Some(depth), Some(below)) = (&mut self.depth, below.depth) {
            append(depth, below);
        }
        if let (Some(image), Some(below)) = (&mut self.instances, below.instances) {
            append(&mut image.label, below.label);
            append(&mut image.probability, below.probability);
            append(&mut image.coverage, below.coverage);
            append(&mut image.foreground, below.foreground);
            append(&mut image.entropy, below.entropy);
        }
    }
}

fn append<T>(grid: &mut PixelGrid<T>, below: PixelGrid<T>) {
    assert_eq!(grid.width, below.width, "rows of one view");
    grid.height += below.height;
    grid.pixels.extend(below.pixels);
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

impl InstanceRanks {
    /// So many ranks without instances.
    pub(crate) fn none(ranks: usize, width: u32, height: u32) -> Self {
        let rank = || (PixelGrid::filled(width, height, UNLABELLED), PixelGrid::filled(width, height, 0.0));
        Self { ranks: (0..ranks).map(|_| rank()).collect() }
    }
}

/// Foreground from which a pixel is taken to belong to its most probable instance.
const FOREGROUND: f32 = 0.5;

impl InstanceImage {
    /// The most probable instance where the pixel belongs to any, else [`UNLABELLED`]: what a compositor
    /// wants, while the metrics force every pixel to an instance (methods reference 9).
    ///
    /// # Panics
    /// Without such a pixel.
    #[must_use]
    pub fn foreground_label_at(&self, pixel: usize) -> u16 {
        if self.foreground.pixels[pixel] < FOREGROUND { UNLABELLED } else { self.label.pixels[pixel] }
    }

    /// [`Self::foreground_label_at`] every pixel.
    #[must_use]
    pub fn foreground_label(&self) -> PixelGrid<u16> {
        let labels = (0..self.label.pixels.len()).map(|pixel| self.foreground_label_at(pixel));
        PixelGrid::from_pixels(self.label.width, self.label.height, labels.collect())
    }
}
