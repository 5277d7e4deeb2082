//! How much of what a Gaussian shows is an instance's, rather than of the unlabelled rest.
//!
//! The estimate counts the labelled share of the pixels that a Gaussian shows in. One at an edge of an object shows in
//! pixels of both sides, so that shares are drawn to the middle, and what is blended of them is blurred twice. The shares
//! that make masks most likely are found by expectation maximisation: with `F` the labelled part of a pixel, blended of
//! shares `s` by the weights `w` of colour, and `A` its coverage,
//!
//! `s' = s P / (s P + (1 - s) Q)`, `P = sum over labelled pixels of w / F`, `Q = sum over the others of w / (A - F)`.

use cif_geometry::scalar::{logit, sigmoid};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{BlendRequest, Blending, UNLABELLED};

use super::Trainer;
use crate::config::{HeadName, IdentityConfig};
use crate::engine::Changed;
use crate::error::TrainError;
use crate::phase::Phase;
use crate::state::State;

/// Shares are kept this far from 0 and 1, where no evidence moves them any more.
const LIMIT: f32 = 1e-3;

/// Parts of a pixel below this are nothing to divide by, as where labels are counted (methods reference 5.1).
const LEAST_PART: f32 = 1e-3;

impl Trainer {
    /// Makes the shares of identity rows those that the masks of training views make most likely.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop; nothing has changed then.
    pub(super) fn sharpen_shares(&mut self) -> Result<(), TrainError> {
        let IdentityConfig { share_rounds: rounds, min_mass, .. } = self.state.config.identity;
        let is_own = self.state.config.head.name == HeadName::Cif;
        let Some(identities) = self.state.field.identities.as_ref().filter(|_| is_own && rounds > 0) else {
            return Ok(());
        };
        let before = identities.labelled_shares();
        let mut shares: Vec<f32> = before.iter().map(|share| share.clamp(LIMIT, 1.0 - LIMIT)).collect();
        let views = self.views_held_against();
        let _phase = self.state.phases.enter(Phase::Identity, rounds as usize * views.len());
        let mut renderer = Renderer::new(SimdLevel::Auto);
        for _ in 0..rounds {
            let sums = self.evidence(&mut renderer, &views, &shares)?;
            for (share, sums) in shares.iter_mut().zip(sums.chunks_exact(2)) {
                let (own, others) = (*share * sums[0], (1.0 - *share) * sums[1]);
                // What it is likely to have shown, pixels.
                if own + others > min_mass {
                    *share = (own / (own + others)).clamp(LIMIT, 1.0 - LIMIT);
                }
            }
        }
        let Some(identities) = &mut self.state.field.identities else { return Ok(()) };
        for (row, (before, share)) in before.iter().zip(&shares).enumerate() {
            if *before > 0.0 {
                let shift = (share / before).ln();
                let range = identities.range(row);
                identities.log_estimates[range].iter_mut().for_each(|estimate| *estimate += shift);
            }
        }
        self.engine.changed(Changed::Identities);
        Ok(())
    }

    /// Multiplies occupancies by the shares: what belongs to no instance is part of the surface of none.
    ///
    /// Masks say what is seen along a ray, not where on it. A Gaussian that colours hardly use, between a camera and an
    /// object, can come to stand for the object before that camera; where shares or masks then say that it is of no
    /// instance, it would still hide other objects from elsewhere.
    pub(super) fn occupy_by_shares(&mut self) {
        let State { config, field, .. } = &mut self.state;
        let is_trained = config.head.name == HeadName::Cif && config.trains_occupancy();
        let Some(identities) = &field.identities else { return };
        if !is_trained || config.identity.share_rounds == 0 {
            return;
        }
        let [low, high] = config.instance.occupancy_limits;
        for (logits, share) in field.gaussians.occupancy_logits.iter_mut().zip(identities.labelled_shares()) {
            *logits = logit((sigmoid(*logits) * share).clamp(low, high));
        }
        self.engine.changed(Changed::Gaussians);
    }

    /// `P` and `Q` of every Gaussian, `[N, 2]`.
    fn evidence(
        &self,
        renderer: &mut Renderer,
        views: &[usize],
        shares: &[f32],
    ) -> Result<Vec<f32>, TrainError> {
        let state = &self.state;
        let settings = state.color_settings();
        let values: Vec<f32> = shares.iter().flat_map(|share| [*share, 1.0 - share]).collect();
        let request = BlendRequest { values: &values[..], channels: 2, blending: Blending::Color };
        let mut sums = vec![0.0; values.len()];
        for view in views {
            state.phases.check()?;
            state.phases.advance();
            let data = state.frames.get(&state.dataset, *view)?;
            let Some(labels) = data.labels.as_ref().filter(|_| data.labelled > 0) else { continue };
            let frame = &state.dataset.frames[state.frames.index(*view)];
            renderer.prepare(&state.field, &frame.camera, frame.time, &settings);
            let mut parts = renderer.blend(&request).values;
            for (parts, label) in parts.chunks_exact_mut(2).zip(&labels.pixels) {
                let of = usize::from(*label == UNLABELLED);
                let part = parts[of];
                parts.fill(0.0);
                parts[of] = if part > LEAST_PART { 1.0 / part } else { 0.0 };
            }
            renderer.blend_backward(&request, &parts, &mut sums, None);
        }
        Ok(sums)
    }
}

#[cfg(test)]
mod tests {
    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;
    use crate::config::{Ablation, TrainConfig};

    /// Mean logarithm of the probability of what the masks of all training views say.
    fn likelihood(trainer: &Trainer) -> f64 {
        let state = &trainer.state;
        let shares = state.field.identities.as_ref().unwrap().labelled_shares();
        let values: Vec<f32> = shares.iter().flat_map(|share| [*share, 1.0 - share]).collect();
        let request = BlendRequest { values: &values[..], channels: 2, blending: Blending::Color };
        let mut renderer = Renderer::new(SimdLevel::Auto);
        let (mut sum, mut count) = (0.0, 0);
        for view in 0..state.frames.len() {
            let data = state.frames.get(&state.dataset, view).unwrap();
            let frame = &state.dataset.frames[state.frames.index(view)];
            renderer.prepare(&state.field, &frame.camera, frame.time, &state.color_settings());
            let parts = renderer.blend(&request).values;
            for (parts, label) in parts.chunks_exact(2).zip(&data.labels.as_ref().unwrap().pixels) {
                let covered = parts[0] + parts[1];
                if covered > 0.5 {
                    let part = parts[usize::from(*label == UNLABELLED)] / covered;
                    sum += f64::from(part.max(1e-4).ln());
                    count += 1;
                }
            }
        }
        sum / f64::from(count)
    }

    #[test]
    fn every_round_makes_the_masks_more_likely_and_changes_no_probability() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene::default());
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 60, 10);
        config.identity.share_rounds = 0;
        let mut trainer = stopped_after(&dataset, &config, 125);
        let mut before = likelihood(&trainer);
        let probabilities = trainer.state.field.identities.as_ref().unwrap().probabilities();
        trainer.sharpen_shares().unwrap();
        assert_eq!(likelihood(&trainer), before, "no round is asked for");
        trainer.state.config.identity.share_rounds = 1;
        for round in 0..3 {
            trainer.sharpen_shares().unwrap();
            let after = likelihood(&trainer);
            assert!(after > before, "round {round}: {before} -> {after}");
            before = after;
        }
        let identities = trainer.state.field.identities.as_ref().unwrap();
        for (after, before) in identities.probabilities().iter().zip(&probabilities) {
            assert!((after - before).abs() < 1e-5, "which instance it is stays as it was");
        }
        trainer.state.field.validate().unwrap();
    }

    #[test]
    fn what_is_of_no_instance_occupies_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene::default());
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 60, 10);
        let trained = || stopped_after(&dataset, &config, 125);
        let mut trainer = trained();
        let of_ball: Vec<usize> = {
            let of = trainer.state.field.instance_of_gaussians().unwrap();
            let shares = trainer.state.field.identities.as_ref().unwrap().labelled_shares();
            (0..of.len()).filter(|row| of[*row] == Some(0) && shares[*row] > 0.5).collect()
        };
        let (ghosts, stay) = of_ball.split_at(5);
        trainer.state.field.gaussians.occupancy_logits.fill(logit(0.8));
        trainer.disown(ghosts);
        let shares = trainer.state.field.identities.as_ref().unwrap().labelled_shares();
        let [low, _] = config.instance.occupancy_limits;
        trainer.occupy_by_shares();
        let occupancy = |row: &usize| trainer.state.field.gaussians.occupancy(*row);
        assert!(ghosts.iter().all(|row| (occupancy(row) - low).abs() < 1e-5));
        assert!(
            !stay.is_empty() && stay.iter().all(|row| (occupancy(row) - 0.8 * shares[*row]).abs() < 1e-5)
        );
        // What is held constant, or the published method, stays as it was.
        for changes in [
            |config: &mut TrainConfig| config.identity.share_rounds = 0,
            |config: &mut TrainConfig| _ = config.instance.ablate.insert(Ablation::ConstantOccupancy),
        ] {
            let mut trainer = trained();
            changes(&mut trainer.state.config);
            let before = trainer.state.field.gaussians.occupancy_logits.clone();
            trainer.occupy_by_shares();
            assert_eq!(trainer.state.field.gaussians.occupancy_logits, before);
        }
    }
}
