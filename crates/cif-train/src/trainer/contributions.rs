//! Contributions of Gaussians to a few training views, for densification.

use cif_render::cpu::Renderer;
use cif_render::{BlendRequest, Blending};
use rand::seq::index::sample;

use super::Trainer;
use crate::density::Contributions;
use crate::error::TrainError;
use crate::random::{Purpose, stream};

impl Trainer {
    /// Contributions to so many training views, which are drawn anew for every step. They are rendered on the processor,
    /// so that runs on all engines take the same decisions from the same field.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(super) fn contributions(&self, views: usize) -> Result<Contributions, TrainError> {
        let state = &self.state;
        let (n, frames) = (state.field.gaussians.len(), state.frames.len());
        let mut rng = stream(state.config.seed, Purpose::Contributions, state.progress.total_steps);
        let mut drawn = sample(&mut rng, frames, views.min(frames)).into_vec();
        drawn.sort_unstable();
        state.frames.expect(drawn.iter().copied());
        let mut contributions = Contributions::zeros(n);
        let mut renderer = Renderer::new(self.simd);
        for view in drawn {
            state.phases.check()?;
            contributions.add_view(&self.sums_of_view(&mut renderer, view)?);
        }
        Ok(contributions)
    }

    /// Blending weights of every Gaussian over the pixels of a training view, and errors by them, `[N, 2]`.
    fn sums_of_view(&self, renderer: &mut Renderer, view: usize) -> Result<Vec<f32>, TrainError> {
        let state = &self.state;
        let data = state.frames.get(&state.dataset, view)?;
        let index = state.frames.index(view);
        let (frame, settings) = (&state.dataset.frames[index], state.color_settings());
        let mut color = renderer.forward(&state.field, &frame.camera, frame.time, &settings, None).color;
        state.record_color(index, &mut color);
        let pixels = color.pixels.iter().zip(&data.image.pixels);
        let cotangents: Vec<f32> = pixels.flat_map(|(seen, image)| [1.0, error(*seen, *image)]).collect();
        // What is blended does not matter: gradients of values are sums of the weights.
        let values = vec![0.0; 2 * state.field.gaussians.len()];
        let request = BlendRequest { values: &values[..], channels: 2, blending: Blending::Color };
        let mut sums = vec![0.0; values.len()];
        renderer.blend_backward(&request, &cotangents, &mut sums, None);
        Ok(sums)
    }
}

/// Mean absolute difference of the channels, in [0, 1] for colours in [0, 1].
fn error(rendered: [f32; 3], image: [u8; 3]) -> f32 {
    let differences = rendered.iter().zip(image).map(|(seen, image)| (seen - f32::from(image) / 255.0).abs());
    differences.sum::<f32>() / 3.0
}

#[cfg(test)]
mod tests {
    use cif_render::Channels;

    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;

    #[test]
    fn weights_add_up_to_coverage_and_errors_to_covered_errors() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = capture(folder.path(), Scene { times: 3, views: 4, ..Scene::default() });
        let trainer = stopped_after(&dataset, &small_config(), 120);
        let state = &trainer.state;
        let n = state.field.gaussians.len();
        let mut all = Contributions::zeros(n);
        let mut renderer = Renderer::new(trainer.simd);
        let sum = |values: &[f32]| values.iter().map(|value| f64::from(*value)).sum::<f64>();
        for view in 0..state.frames.len() {
            let sums = trainer.sums_of_view(&mut renderer, view).unwrap();
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
