//! Occupancies that colours do not bear out.
//!
//! Masks say what is seen along a ray, not where on it. A Gaussian that colours hardly use, between a camera and an
//! object, can stand for the object in the masks of that camera, and hides other objects from elsewhere. So behind the
//! instance stage a Gaussian occupies no more than a multiple of what it covers. An object of which its masks show less
//! then, as one of glass before another object, keeps its occupancies.

use cif_field::Field;
use cif_geometry::scalar::logit;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings, UNLABELLED};

use super::Trainer;
use crate::config::{Ablation, HeadName};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::phase::Phase;

/// Part of the pixels of an object that show it now which must show it with less occupancy: outlines are known to a pixel,
/// and this is a tenth of the outline of an object 40 pixels wide.
const AS_WELL: f64 = 0.99;

impl Trainer {
    /// Logits of occupancies that colours bear out, `[N]`; `None` where all are, or none are asked for.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(super) fn borne_out_occupancies(&self) -> Result<Option<Vec<f32>>, TrainError> {
        let state = &self.state;
        let most = state.config.instance.occupancy_per_opacity;
        let is_trained =
            state.config.head.name == HeadName::Cif && !state.config.ablates(Ablation::ConstantOccupancy);
        let Some(of) = state.field.instance_of_gaussians().filter(|_| is_trained && most > 0.0) else {
            return Ok(None);
        };
        let mut less = state.field.clone();
        less.gaussians.occupancy_logits = self.bounded(most);
        if less.gaussians.occupancy_logits == state.field.gaussians.occupancy_logits {
            return Ok(None);
        }
        let [now, then] = self.pixels_shown([&state.field, &less])?;
        let keeps = |instance: &u16| {
            let k = usize::from(*instance);
            (then[k] as f64) < AS_WELL * now[k] as f64
        };
        let mut logits = less.gaussians.occupancy_logits;
        for (row, logit) in
            logits.iter_mut().enumerate().filter(|(row, _)| of[*row].as_ref().is_some_and(keeps))
        {
            *logit = state.field.gaussians.occupancy_logits[row];
        }
        Ok(Some(logits))
    }

    /// Makes Gaussians occupy as much.
    pub(super) fn occupy(&mut self, logits: Vec<f32>) {
        self.state.field.gaussians.occupancy_logits = logits;
        self.engine.changed(Changed::Gaussians);
    }

    /// Logits of occupancies of at most so many times the opacity, but for Gaussians whose opacity changes with time.
    fn bounded(&self, most: f32) -> Vec<f32> {
        let field = &self.state.field;
        let [low, high] = self.state.config.instance.occupancy_limits;
        let changes = |row: usize| {
            let moves = |d: &cif_field::Deformation| d.config.heads.opacity && !d.is_still(row);
            field.deformation.as_ref().is_some_and(moves)
        };
        let logits = field.gaussians.occupancy_logits.iter().enumerate();
        let bounded = |(row, occupancy): (usize, &f32)| {
            let bound = || logit((most * field.gaussians.opacity(row)).clamp(low, high));
            if changes(row) { *occupancy } else { occupancy.min(bound()) }
        };
        logits.map(bounded).collect()
    }

    /// Pixels of the masks of every instance that each of two fields shows as it, over the views that identities are held
    /// against.
    fn pixels_shown(&self, fields: [&Field; 2]) -> Result<[Vec<u64>; 2], TrainError> {
        let state = &self.state;
        let settings = RenderSettings { instances: state.instance_settings(), ..state.color_settings() };
        let channels = Channels { depth: false, instances: true };
        let mut pixels = fields.map(|field| vec![0_u64; field.instances.len()]);
        let views = self.views_held_against();
        let _phase = state.phases.enter(Phase::Identity, views.len());
        let mut renderer = Renderer::new(SimdLevel::Auto);
        for view in views {
            state.phases.check()?;
            state.phases.advance();
            let data = state.frames.get(&state.dataset, view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let frame = &state.dataset.frames[state.frames.index(view)];
            for (field, pixels) in fields.iter().zip(&mut pixels) {
                let seen = renderer.render(field, &frame.camera, frame.time, &settings, channels);
                let Some(shown) = seen.instances else { continue };
                let both = labels.pixels.iter().zip(&shown.label.pixels);
                both.filter(|(label, shown)| **label != UNLABELLED && label == shown)
                    .for_each(|(label, _)| pixels[usize::from(*label) - 1] += 1);
            }
        }
        Ok(pixels)
    }
}

#[cfg(test)]
mod tests {
    use cif_geometry::scalar::sigmoid;

    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;

    /// A run in its instance stage, and the Gaussians of its first two objects.
    fn trained(folder: &std::path::Path) -> (Trainer, [Vec<usize>; 2]) {
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 60, 10);
        config.instance.occupancy_per_opacity = 2.0;
        let trainer = stopped_after(&capture(folder, Scene::default()), &config, 125);
        let of = trainer.state.field.instance_of_gaussians().unwrap();
        let members = [0, 1].map(|k| (0..of.len()).filter(|row| of[*row] == Some(k)).collect());
        (trainer, members)
    }

    fn set(trainer: &mut Trainer, rows: &[usize], opacity: f32, occupancy: f32) {
        let gaussians = &mut trainer.state.field.gaussians;
        for row in rows {
            (gaussians.opacity_logits[*row], gaussians.occupancy_logits[*row]) =
                (logit(opacity), logit(occupancy));
        }
    }

    #[test]
    fn what_colours_hardly_use_does_not_hide_what_lies_behind_it() {
        let folder = tempfile::tempdir().unwrap();
        let (mut trainer, [first, _]) = trained(folder.path());
        let all: Vec<usize> = (0..trainer.state.field.len()).collect();
        set(&mut trainer, &all, 0.9, 0.8);
        assert_eq!(trainer.borne_out_occupancies().unwrap(), None, "all occupy less than they cover");
        let ghosts = &first[..5];
        set(&mut trainer, ghosts, 0.02, 0.9);
        let logits = trainer.borne_out_occupancies().unwrap().unwrap();
        trainer.occupy(logits);
        for (row, logit) in trainer.state.field.gaussians.occupancy_logits.iter().enumerate() {
            let expected = if ghosts.contains(&row) { 0.04 } else { 0.8 };
            assert!((sigmoid(*logit) - expected).abs() < 1e-5, "{row}");
        }
        trainer.state.config.instance.occupancy_per_opacity = 0.0;
        set(&mut trainer, ghosts, 0.02, 0.9);
        assert_eq!(trainer.borne_out_occupancies().unwrap(), None, "not asked for");
    }

    #[test]
    fn an_object_that_would_be_shown_less_keeps_its_occupancies() {
        let folder = tempfile::tempdir().unwrap();
        let (mut trainer, [first, second]) = trained(folder.path());
        // The first is of glass, with something opaque of the second inside.
        set(&mut trainer, &first, 0.02, 0.9);
        set(&mut trainer, &second, 0.9, 0.8);
        let (clear, inside) = second[..6].split_at(3);
        set(&mut trainer, clear, 0.02, 0.9);
        let gaussians = &mut trainer.state.field.gaussians;
        for row in inside {
            gaussians.means[*row] = gaussians.means[first[0]];
            gaussians.log_scales[*row] = [0.3_f32.ln(); 3];
        }
        let logits = trainer.borne_out_occupancies().unwrap().unwrap();
        let occupies = |row: &usize, expected: f32| (sigmoid(logits[*row]) - expected).abs() < 1e-5;
        assert!(first.iter().all(|row| occupies(row, 0.9)), "its masks show less of it with less");
        assert!(clear.iter().all(|row| occupies(row, 0.04)));
    }
}
