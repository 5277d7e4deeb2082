//! Gaussians that the masks of their own instance contradict: they show up outside it in most of the views that see them.
//!
//! Where each image has a time of its own, Gaussians close before one camera explain its image alone. They are labelled
//! as the mask behind them is, and would make their object as large as the way to the camera.

use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderedImage};
use glam::DVec3;

use super::Trainer;
use crate::config::HeadName;
use crate::density::FEWEST_OF_OBJECT;
use crate::engine::Changed;
use crate::error::TrainError;
use crate::phase::Phase;

/// Share of its image on labelled pixels that is left to a Gaussian of no instance.
const LIMIT: f32 = 1e-3;

/// Coverage of a pixel from which what is seen there hides what lies behind it.
const SOLID: f32 = 0.5;

/// Distance from a mask, pixels, within which a centre does not lie outside it: outlines are known to a pixel.
const OUTLINE: u32 = 1;

/// Views that see a Gaussian inside and outside the mask of its instance.
#[derive(Clone, Copy, Debug, Default)]
struct Votes {
    inside: u32,
    outside: u32,
}

impl Votes {
    fn contradict(self) -> bool {
        self.outside > self.inside
    }
}

impl Trainer {
    /// Rows of the Gaussians that the masks of their instance contradict, but for a few of each.
    ///
    /// # Errors
    /// When a frame cannot be read, or the run is to stop.
    pub(super) fn contradicted(&self) -> Result<Vec<usize>, TrainError> {
        if self.state.config.head.name != HeadName::Cif {
            return Ok(Vec::new());
        }
        let Some(of) = self.state.field.instance_of_gaussians() else { return Ok(Vec::new()) };
        let votes = self.votes(&of)?;
        let mut members: Vec<Vec<usize>> = vec![Vec::new(); self.state.field.instances.len()];
        for (row, instance) in of.iter().enumerate() {
            if let Some(instance) = instance {
                members[usize::from(*instance)].push(row);
            }
        }
        let mut rows = Vec::new();
        for members in members {
            let (mut contradicted, others): (Vec<usize>, Vec<usize>) =
                members.into_iter().partition(|row| votes[*row].contradict());
            // Those that most views bear out come first, and stay where there are too few others.
            let margin = |row: &usize| i64::from(votes[*row].inside) - i64::from(votes[*row].outside);
            contradicted.sort_by_key(|row| std::cmp::Reverse(margin(row)));
            let spared = FEWEST_OF_OBJECT.saturating_sub(others.len());
            rows.extend(contradicted.into_iter().skip(spared));
        }
        Ok(rows)
    }

    /// Takes Gaussians out of their instance.
    pub(super) fn disown(&mut self, rows: &[usize]) {
        let Some(identities) = &mut self.state.field.identities else { return };
        let shares = identities.labelled_shares();
        for row in rows.iter().copied().filter(|row| shares[*row] > LIMIT) {
            let shift = (LIMIT / shares[row]).ln();
            let range = identities.range(row);
            identities.log_estimates[range].iter_mut().for_each(|estimate| *estimate += shift);
        }
        self.engine.changed(Changed::Identities);
    }

    /// Votes of training views on every Gaussian that belongs to the instance of `of`; none on those with poses, which were
    /// made inside the masks of theirs.
    fn votes(&self, of: &[Option<u16>]) -> Result<Vec<Votes>, TrainError> {
        let state = &self.state;
        let mut votes = vec![Votes::default(); of.len()];
        let views = self.views_held_against();
        let _phase = state.phases.enter(Phase::Identity, views.len());
        let masks = state.frames.masks(&state.dataset, &state.phases)?;
        let gaussians = &state.field.gaussians;
        let is_posed =
            |row: usize| state.field.tracks.as_ref().is_some_and(|tracks| tracks.group(row).is_some());
        let mut renderer = Renderer::new(SimdLevel::Auto);
        for view in views {
            state.phases.check()?;
            state.phases.advance();
            let Some(table) = &masks[view] else { continue };
            let data = state.frames.get(&state.dataset, view)?;
            let Some(labels) = &data.labels else { continue };
            let frame = &state.dataset.frames[state.frames.index(view)];
            let channels = Channels { depth: true, instances: false };
            let settings = state.color_settings();
            let seen = renderer.render(&state.field, &frame.camera, frame.time, &settings, channels);
            let posed = renderer.posed_means();
            let shown = |label: u16| {
                table.rows.get(&label).and_then(|row| row.observation(&frame.camera, 0)).is_some()
            };
            for (row, votes) in votes.iter_mut().enumerate().filter(|(row, _)| !is_posed(*row)) {
                let Some(label) = of[row].map(|instance| instance + 1).filter(|label| shown(*label)) else {
                    continue;
                };
                let mean = posed.get(row).unwrap_or(&gaussians.means[row]);
                let place = DVec3::from(mean.map(f64::from));
                let Some([x, y]) = frame.camera.pixel_of(place) else { continue };
                let depth = frame.camera.camera_from_world.apply(place).z;
                let size = gaussians.log_scales[row].into_iter().fold(f32::NEG_INFINITY, f32::max).exp();
                if is_near(labels, [x, y], label) {
                    votes.inside += 1;
                } else if !hides(&seen, [x, y], depth - f64::from(size)) {
                    votes.outside += 1;
                }
            }
        }
        Ok(votes)
    }
}

/// True where the outline of a label may reach a pixel.
fn is_near(labels: &PixelGrid<u16>, [x, y]: [u32; 2], label: u16) -> bool {
    let around = |at: u32, size: u32| at.saturating_sub(OUTLINE)..=(at + OUTLINE).min(size - 1);
    around(y, labels.height).any(|y| around(x, labels.width).any(|x| *labels.at(x, y) == label))
}

/// True where what a pixel shows is solid and nearer than a depth, metres.
fn hides(seen: &RenderedImage, [x, y]: [u32; 2], depth: f64) -> bool {
    let surface = seen.depth.as_ref().map_or(0.0, |depths| *depths.at(x, y));
    *seen.alpha.at(x, y) >= SOLID && surface > 0.0 && f64::from(surface) < depth
}

#[cfg(test)]
mod tests {
    use super::super::guard_tests::support::{Scene, capture, small_config, stopped_after};
    use super::*;

    /// A run in its instance stage, and the rows of its first ball that are opaque and about where it is.
    fn trained(folder: &std::path::Path) -> (Trainer, Vec<usize>) {
        let mut config = small_config();
        (config.stages.coarse, config.stages.fine, config.stages.instance) = (60, 60, 10);
        let trainer = stopped_after(&capture(folder, Scene::default()), &config, 125);
        let centre = DVec3::new(-0.55, 0.0, 0.0);
        let of = trainer.state.field.instance_of_gaussians().unwrap();
        let gaussians = &trainer.state.field.gaussians;
        let is_there = |row: &usize| {
            let place = DVec3::from(gaussians.means[*row].map(f64::from));
            of[*row] == Some(0) && place.distance(centre) < 0.45 && gaussians.opacity(*row) > 0.1
        };
        let of_ball = (0..of.len()).filter(is_there).collect();
        (trainer, of_ball)
    }

    #[test]
    fn what_hangs_before_one_camera_is_of_no_instance() {
        let folder = tempfile::tempdir().unwrap();
        let (mut trainer, of_ball) = trained(folder.path());
        assert!(of_ball.len() > 20, "{of_ball:?}");
        // Ten of the ball go towards the first camera, to where all others see them outside it.
        let camera = trainer.state.dataset.frames[trainer.state.frames.index(0)].camera;
        let place = DVec3::new(-0.55, 0.0, 0.0).lerp(camera.centre(), 0.3);
        let (moved, stay) = of_ball.split_at(10);
        for row in moved {
            trainer.state.field.gaussians.means[*row] = place.as_vec3().to_array();
        }
        let before = trainer.state.field.identities.clone().unwrap();
        let contradicted = trainer.contradicted().unwrap();
        trainer.disown(&contradicted);
        let after = trainer.state.field.identities.as_ref().unwrap();
        let [shares, first] = [after, &before].map(cif_field::Identities::labelled_shares);
        assert!(moved.iter().all(|row| (shares[*row] - LIMIT).abs() < 1e-6));
        let kept = stay.iter().filter(|row| shares[**row] == first[**row]).count();
        assert!(10 * kept >= 8 * stay.len(), "{kept} of {} stay", stay.len());
        trainer.state.field.validate().unwrap();
    }

    #[test]
    fn an_instance_keeps_a_few_whatever_masks_say() {
        let folder = tempfile::tempdir().unwrap();
        let (mut trainer, _) = trained(folder.path());
        let of = trainer.state.field.instance_of_gaussians().unwrap();
        let rows: Vec<usize> = (0..of.len()).filter(|row| of[*row] == Some(0)).collect();
        for row in &rows {
            trainer.state.field.gaussians.means[*row][1] -= 1.0;
        }
        let contradicted = trainer.contradicted().unwrap();
        trainer.disown(&contradicted);
        let shares = trainer.state.field.identities.as_ref().unwrap().labelled_shares();
        let owned = rows.iter().filter(|row| shares[**row] > 2.0 * LIMIT).count();
        assert!((FEWEST_OF_OBJECT..rows.len() / 2).contains(&owned), "{owned} of {}", rows.len());
    }
}
