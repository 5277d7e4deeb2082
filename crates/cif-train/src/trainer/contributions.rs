//! Contributions of Gaussians to a few training views, for densification.

use rand::{Rng, RngExt};

use super::Trainer;
use crate::density::Contributions;
use crate::error::TrainError;
use crate::random::{Purpose, stream};

impl Trainer {
    /// Contributions to so many training views, which are drawn anew for every step: one of each part of their order, so
    /// that what is seen for a while is among them.
    ///
    /// # Errors
    /// When the engine fails, a frame cannot be read, or the run is to stop.
    pub(super) fn contributions(&mut self, views: usize) -> Result<Contributions, TrainError> {
        let state = &self.state;
        let (n, frames) = (state.field.gaussians.len(), state.frames.len());
        let mut rng = stream(state.config.seed, Purpose::Contributions, state.progress.total_steps);
        let drawn = one_of_each_part(&mut rng, frames, views);
        state.frames.expect(drawn.iter().copied());
        let mut contributions = Contributions::zeros(n);
        for view in drawn {
            state.phases.check()?;
            contributions.add_view(&self.engine.sums_of_view(state, view)?);
        }
        Ok(contributions)
    }
}

/// So many of so many frames, in order: one of each part of these, parts as long as each other.
fn one_of_each_part(rng: &mut impl Rng, frames: usize, count: usize) -> Vec<usize> {
    let parts = count.min(frames);
    let bound = |part: usize| part * frames / parts;
    (0..parts).map(|part| rng.random_range(bound(part)..bound(part + 1))).collect()
}

#[cfg(test)]
mod tests {
    use cif_render::Channels;
    use cif_render::cpu::Renderer;

    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;
    use crate::density::contributions::error;

    #[test]
    fn what_is_seen_for_a_while_is_among_the_views() {
        let mut rng = stream(0, Purpose::Contributions, 0);
        for _ in 0..50 {
            let drawn = one_of_each_part(&mut rng, 43, 8);
            assert_eq!(drawn.len(), 8);
            // At most six frames lie in a part, so that eleven in a row hold one.
            let last = drawn.iter().filter(|frame| **frame >= 32).count();
            assert!(last >= 1 && drawn.is_sorted() && drawn[7] < 43, "{drawn:?}");
        }
        assert_eq!(one_of_each_part(&mut rng, 3, 8), [0, 1, 2]);
    }

    #[test]
    fn weights_add_up_to_coverage_and_errors_to_covered_errors() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let mut trainer = stopped_after(&dataset, &small_config(), 120);
        let Trainer { state, engine, simd, .. } = &mut trainer;
        let state = &*state;
        let n = state.field.gaussians.len();
        let mut all = Contributions::zeros(n);
        let mut renderer = Renderer::new(*simd);
        let sum = |values: &[f32]| values.iter().map(|value| f64::from(*value)).sum::<f64>();
        for view in 0..state.frames.len() {
            let sums = engine.sums_of_view(state, view).unwrap();
            let mut of_view = Contributions::zeros(n);
            of_view.add_view(&sums);
            let frame = &state.dataset.frames[state.frames.index(view)];
            let (settings, channels) = (state.color_settings(), Channels { depth: false, instances: false });
            let seen = renderer.render(&state.field, &frame.camera, frame.time, &settings, channels);
            let image = &state.frames.get(&state.dataset, view).unwrap().image;
            let (mut coverage, mut errors) = (0.0, 0.0);
            for ((alpha, color), image) in seen.alpha.pixels.iter().zip(&seen.color.pixels).zip(&image.pixels)
            {
                coverage += f64::from(*alpha);
                errors += f64::from(*alpha * error(*color, *image));
            }
            assert!((sum(&of_view.weight) / coverage - 1.0).abs() < 1e-4, "{coverage} in {view}");
            assert!((sum(&of_view.error) / errors - 1.0).abs() < 1e-4, "{errors} in {view}");
            assert!(errors > 0.0 && errors < 0.5 * coverage);
            all.add_view(&sums);
        }
        // All views, in whatever order they are drawn; fewer show less, and the same ones are drawn for the same step.
        assert_eq!(trainer.contributions(usize::MAX).unwrap(), all);
        let some = trainer.contributions(2).unwrap();
        assert!(sum(&some.error) < 0.5 * sum(&all.error));
        assert_eq!(trainer.contributions(2).unwrap(), some);
    }
}
