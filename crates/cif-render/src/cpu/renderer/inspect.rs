//! Looks for the first value of a view that is not finite, on request: it reads every intermediate array.

use super::super::deform::{PosedArrayGradients, PosedArrays};
use super::super::project::{Splat, SplatGradient};
use super::Renderer;
use crate::Gradients;

/// A value that is not finite, where it was first met.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NotFinite {
    /// Part of the view's work, as in the rows of [`StageTimes`](crate::cpu::StageTimes).
    pub part: &'static str,
    /// Array, by name.
    pub tensor: &'static str,
    /// Position in the array, all its floats counted in their order.
    pub index: usize,
    /// The value.
    pub value: f32,
}

/// Whether arrays are looked at, and what was found.
#[derive(Debug, Default)]
pub(super) struct Inspection {
    on: bool,
    found: Option<NotFinite>,
}

impl Inspection {
    /// Looks at arrays of a part, in their order, unless something was found before.
    fn look<'a>(&mut self, part: &'static str, arrays: impl IntoIterator<Item = (&'static str, &'a [f32])>) {
        if self.found.is_some() {
            return;
        }
        self.found = arrays.into_iter().find_map(|(tensor, values)| {
            let index = values.iter().position(|value| !value.is_finite())?;
            Some(NotFinite { part, tensor, index, value: values[index] })
        });
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
            Some(NotFinite { part, tensor, index: row * C + column, value: floats[column] })
        });
    }
}

impl Renderer {
    /// Looks at every array between field and gradients from now on, which costs time; results do not change.
    pub fn set_inspection(&mut self, on: bool) {
        self.inspection = Inspection { on, found: None };
    }

    /// The first value since the last call that was not finite; always `None` without
    /// [`Self::set_inspection`].
    pub fn take_not_finite(&mut self) -> Option<NotFinite> {
        self.inspection.found.take()
    }

    /// After the Gaussians were moved to the time of the view.
    pub(super) fn inspect_posed(&mut self) {
        if !self.inspection.on {
            return;
        }
        let PosedArrays { means, log_scales, quaternions, opacity_logits, occupancy_logits, sh_coefficients } =
            &self.tape.posed;
        self.inspection.look(
            "deform",
            [
                ("posed means", means.as_flattened()),
                ("posed log_scales", log_scales.as_flattened()),
                ("posed quaternions", quaternions.as_flattened()),
                ("posed opacity_logits", opacity_logits),
                ("posed occupancy_logits", occupancy_logits),
                ("posed sh_coefficients", sh_coefficients.as_flattened()),
            ],
        );
    }

    /// After projection.
    pub(super) fn inspect_splats(&mut self) {
        if self.inspection.on {
            let floats = |s: &Splat| {
                let ([mx, my], [l00, l01, l11], [r, g, b]) = (s.mean, s.factor, s.color);
                [mx, my, l00, l01, l11, r, g, b, s.opacity, s.occupancy, s.depth, s.order]
            };
            self.inspection.look_at_rows("project", "splats", &self.tape.splats, floats);
        }
    }

    /// After blending: rows of the image, of which so many pixels lie above.
    pub(super) fn inspect_color(&mut self, color: &[[f32; 3]], above: usize) {
        if self.inspection.on && self.inspection.found.is_none() {
            self.inspection.look("rasterize", [("colour", color.as_flattened())]);
            if let Some(found) = &mut self.inspection.found {
                found.index += 3 * above;
            }
        }
    }

    /// After blending with labels.
    pub(super) fn inspect_labelled_tiles(&mut self) {
        if !self.inspection.on {
            return;
        }
        let labels = self.tape.tiles.iter().zip(&self.tape.labels).filter(|(_, labels)| labels.is_some());
        for (tile, _) in labels {
            let arrays = [
                ("label probability of a tile", tile.label_probability.as_flattened()),
                ("instance transmittance of a tile", tile.instance_transmittance.as_flattened()),
            ];
            self.inspection.look("rasterize", arrays);
        }
    }

    /// After the gradients of (tile, splat) pairs.
    pub(super) fn inspect_pairs(&mut self, pairs: &[SplatGradient], label_mass: &[f32]) {
        if self.inspection.on {
            let floats = |v: &SplatGradient| {
                let ([mx, my], [m00, m01, m11], [r, g, b]) = (v.mean, v.moments, v.color);
                [mx, my, m00, m01, m11, r, g, b, v.opacity, v.responsibility]
            };
            self.inspection.look_at_rows("rasterize backward", "splat gradients of tiles", pairs, floats);
            self.inspection.look("rasterize backward", [("label mass of tiles", label_mass)]);
        }
    }

    /// After the gradients of the moved Gaussians.
    pub(super) fn inspect_posed_gradients(&mut self, v_posed: &PosedArrayGradients, gradients: &Gradients) {
        if !self.inspection.on {
            return;
        }
        self.inspection.look(
            "project backward",
            [
                ("gradient of posed means", v_posed.means.as_flattened()),
                ("gradient of posed log_scales", v_posed.log_scales.as_flattened()),
                ("gradient of posed quaternions", v_posed.quaternions.as_flattened()),
                ("gradient of posed opacity_logits", &v_posed.opacity_logits),
                ("gradient of posed sh_coefficients", v_posed.sh_coefficients.as_flattened()),
                ("gradient of occupancy_logits", &gradients.gaussians.occupancy_logits),
                ("gradient of sh_coefficients", gradients.gaussians.sh_coefficients.as_flattened()),
                ("gradient of log_calibrations", &gradients.log_calibrations),
                ("screen gradient", gradients.screen.as_flattened()),
            ],
        );
    }

    /// After the gradients of the deformation.
    pub(super) fn inspect_deformation_gradients(&mut self, gradients: &Gradients) {
        if self.inspection.on {
            let arrays = [
                ("gradient of planes", &gradients.planes[..]),
                ("gradient of mlp", &gradients.mlp),
                ("gradient of means", gradients.gaussians.means.as_flattened()),
            ];
            self.inspection.look("deform backward", arrays);
        }
    }
}
