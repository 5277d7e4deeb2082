//! Looks for the first value of a view that is not finite, on request: it reads every intermediate array.

use cif_field::Gaussians;
use cif_field::parameters::{MEANS, MLP, PLANES, Tensor};

use super::super::labels::TileLabels;
use super::super::project::Splat;
use super::super::project_backward::SplatGradient;
use super::super::rasterize::TileImage;
use crate::Gradients;

/// A value that is not finite, where it was first met.
#[derive(Clone, Debug, PartialEq)]
pub struct NotFinite {
    /// Part of the view's work, as in the rows of [`StageTimes`](crate::cpu::StageTimes).
    pub part: &'static str,
    /// Array, by name.
    pub tensor: String,
    /// Position in the array, all its floats counted in their order.
    pub index: usize,
    /// The value.
    pub value: f32,
}

/// Search for values that are not finite: whether it is on, and the first one that was found.
#[derive(Debug, Default)]
pub(super) struct Inspection {
    on: bool,
    found: Option<NotFinite>,
}

impl Inspection {
    pub(super) fn new(on: bool) -> Self {
        Self { on, found: None }
    }

    /// The first value that was found since the last call.
    pub(super) fn take(&mut self) -> Option<NotFinite> {
        self.found.take()
    }

    /// Looks at arrays of a part, in their order, unless something was found before.
    fn look<'a>(&mut self, part: &'static str, arrays: impl IntoIterator<Item = (&'a str, &'a [f32])>) {
        if self.found.is_some() {
            return;
        }
        self.found = arrays.into_iter().find_map(|(tensor, values)| {
            let index = values.iter().position(|value| !value.is_finite())?;
            Some(NotFinite { part, tensor: tensor.to_owned(), index, value: values[index] })
        });
    }

    /// Looks at parameters, or something as large, called by `prefix` and the name of each.
    fn look_at_tensors(&mut self, part: &'static str, prefix: &str, tensors: &[Tensor<'_>]) {
        let names: Vec<String> =
            tensors.iter().map(|(parameter, _)| format!("{prefix}{}", parameter.name)).collect();
        self.look(part, names.iter().zip(tensors).map(|(name, (_, values))| (name.as_str(), *values)));
    }

    /// Looks at one record per row.
    fn look_at_rows<T, const C: usize>(
        &mut self,
        part: &'static str,
        tensor: &'static str,
        rows: &[T],
        floats: impl Fn(&T) -> [f32; C],
    ) {
        if self.found.is_some() {
            return;
        }
        self.found = rows.iter().enumerate().find_map(|(row, record)| {
            let floats = floats(record);
            let column = floats.iter().position(|value| !value.is_finite())?;
            Some(NotFinite {
                part,
                tensor: tensor.to_owned(),
                index: row * C + column,
                value: floats[column],
            })
        });
    }

    /// After the Gaussians were moved to the time of the view.
    pub(super) fn look_at_posed(&mut self, posed: &Gaussians) {
        if !self.on {
            return;
        }
        self.look_at_tensors("deform", "posed ", &posed.tensors());
    }

    /// After projection.
    pub(super) fn look_at_splats(&mut self, splats: &[Splat]) {
        if self.on {
            let floats = |s: &Splat| {
                let ([mx, my], [l00, l01, l11], [r, g, b]) = (s.mean, s.factor, s.color);
                [mx, my, l00, l01, l11, r, g, b, s.opacity, s.occupancy, s.depth, s.order]
            };
            self.look_at_rows("project", "splats", splats, floats);
        }
    }

    /// After blending: rows of the image, of which so many pixels lie above.
    pub(super) fn look_at_color(&mut self, color: &[[f32; 3]], above: usize) {
        if self.on && self.found.is_none() {
            self.look("rasterize", [("colour", color.as_flattened())]);
            if let Some(found) = &mut self.found {
                found.index += 3 * above;
            }
        }
    }

    /// After blending with labels.
    pub(super) fn look_at_labelled_tiles(&mut self, tiles: &[TileImage], labels: &[Option<TileLabels>]) {
        if !self.on {
            return;
        }
        let labelled = tiles.iter().zip(labels).filter(|(_, labels)| labels.is_some());
        for (tile, _) in labelled {
            let arrays = [
                ("label probability of a tile", tile.label_probability.as_flattened()),
                ("instance transmittance of a tile", tile.instance_transmittance.as_flattened()),
            ];
            self.look("rasterize", arrays);
        }
    }

    /// After the gradients of (tile, splat) pairs.
    pub(super) fn look_at_pairs(&mut self, pairs: &[SplatGradient], label_mass: &[f32]) {
        if self.on {
            let floats = |v: &SplatGradient| {
                let ([mx, my], [m00, m01, m11], [r, g, b]) = (v.mean, v.moments, v.color);
                [mx, my, m00, m01, m11, r, g, b, v.opacity, v.responsibility]
            };
            self.look_at_rows("rasterize backward", "splat gradients of tiles", pairs, floats);
            self.look("rasterize backward", [("label mass of tiles", label_mass)]);
        }
    }

    /// After the gradients of the moved Gaussians.
    pub(super) fn look_at_posed_gradients(&mut self, v_posed: &Gaussians, gradients: &Gradients) {
        if !self.on {
            return;
        }
        self.look_at_tensors("project backward", "gradient of posed ", &v_posed.tensors());
        // Centres, planes and network get more from the deformation.
        let whole = |(parameter, _): &Tensor<'_>| ![MEANS, PLANES, MLP].contains(parameter);
        let tensors: Vec<Tensor<'_>> = gradients.tensors().into_iter().filter(whole).collect();
        self.look_at_tensors("project backward", "gradient of ", &tensors);
        self.look("project backward", [("screen gradient", gradients.screen.as_flattened())]);
    }

    /// After the gradients of the deformation.
    pub(super) fn look_at_deformation_gradients(&mut self, gradients: &Gradients) {
        if self.on {
            let moved = [PLANES, MLP, MEANS];
            let of = |target| gradients.tensors().into_iter().find(|(parameter, _)| *parameter == target);
            let tensors: Vec<Tensor<'_>> = moved.into_iter().filter_map(of).collect();
            self.look_at_tensors("deform backward", "gradient of ", &tensors);
        }
    }
}
