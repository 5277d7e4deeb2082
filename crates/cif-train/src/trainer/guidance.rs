//! Paths of travelling objects: found in the masks, taught to the deformation, and held while it trains.

use cif_field::Field;
use cif_field::parameters::{MLP, PLANES};
use cif_geometry::PixelGrid;
use cif_render::cpu::Renderer;
use cif_render::{Channels, Gradients, RenderSettings, RenderedImage, UNLABELLED};
use glam::DVec3;
use rand::RngExt;

use super::Trainer;
use super::objects::{Added, in_time};
use super::plan_step::plane_weights;
use crate::effects::appearing::hide_absent;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::guidance::PATH_REACH;
use crate::objects::Bending;
use crate::optimiser::{Optimiser, StepRates};
use crate::phase::Phase;
use crate::random::{Purpose, stream};
use crate::stage::Stage;
use crate::state::State;
use crate::tracks::{Observation, fit, on_rays, resting, travels};

/// Share of the nearest depths around a mask that is taken for noise.
const CONTACT_SHARE: f64 = 0.08;

impl Trainer {
    /// Finds out which instances travel: the work of the search stage.
    pub(super) fn find_travelling(&mut self) -> Result<(), TrainError> {
        let observations = self.observe(false)?;
        self.state.guidance.travelling = std::iter::once(false)
            .chain(observations.iter().map(|observations| travels(observations)))
            .collect();
        self.find_other_movers()?;
        let names: Vec<&str> = (0..observations.len())
            .filter(|k| self.state.guidance.travelling[k + 1])
            .map(|k| self.state.field.instances[k].label.as_str())
            .collect();
        if !names.is_empty() {
            let message = format!("guided by their masks: {}", names.join(", "));
            self.messages.push(TrainEvent::note(message));
        }
        self.state.objects.is_searched = true;
        Ok(())
    }

    /// Where every instance is seen, in the order of times; with contact depths if asked.
    fn observe(&mut self, with_contacts: bool) -> Result<Vec<Vec<Observation>>, TrainError> {
        let k = self.state.field.instances.len();
        let mut observations = vec![Vec::new(); k];
        let phases = self.state.phases.clone();
        let _phase = phases.enter(Phase::Paths, self.state.frames.len());
        let mut renderer = Renderer::new(self.simd);
        let scene = with_contacts.then(|| self.without_outliers()).flatten();
        let settings = RenderSettings { deform: false, ..self.state.color_settings() };
        let masks = self.state.frames.masks(&self.state.dataset, &phases)?;
        for (view, table) in masks.iter().enumerate() {
            phases.check()?;
            phases.advance();
            let Some(table) = table else { continue };
            let frame = &self.state.dataset.frames[self.state.frames.index(view)];
            let mut contacts = vec![None; k];
            if with_contacts {
                let scene = scene.as_ref().unwrap_or(&self.state.field);
                let channels = Channels { depth: true, instances: false };
                let seen = renderer.render(scene, &frame.camera, frame.time, &settings, channels);
                let data = self.state.frames.get(&self.state.dataset, view)?;
                contacts = data.labels.as_ref().map_or(contacts, |labels| contact_depths(labels, &seen, k));
            }
            for (label, observation) in table.observations(&frame.camera, frame.time_index) {
                let of = usize::from(label) - 1;
                observations[of].push(Observation { contact_depth: contacts[of], ..observation });
            }
        }
        for observations in &mut observations {
            observations.sort_by_key(|o| o.time_index);
        }
        Ok(observations)
    }

    /// The field without what lies far outside the scene: depths are means, and a trace of something a thousand
    /// times as far behind a surface would move it. `None` where nothing does.
    fn without_outliers(&self) -> Option<Field> {
        let points = &self.state.dataset.points;
        let core = points.core_bounds();
        if core == self.state.dataset.point_bounds() {
            return None;
        }
        let (low, high) = (core.low - core.size(), core.high + core.size());
        let is_near = |mean: &[f32; 3]| {
            let mean = DVec3::from(mean.map(f64::from));
            mean.cmpge(low).all() && mean.cmple(high).all()
        };
        let near: Vec<bool> = self.state.field.gaussians.means.iter().map(is_near).collect();
        let mut field = self.state.field.clone();
        field.gaussians.retain(&near);
        (field.deformation, field.identities) = (None, None);
        Some(field)
    }

    /// Estimates paths, gives travelling objects Gaussians of their own, and teaches the deformation.
    pub(super) fn start_guidance(&mut self) -> Result<(), TrainError> {
        if !self.stages.are_guided(&self.state.config) {
            return Ok(());
        }
        self.state.guidance.guide_of = vec![0; self.state.field.gaussians.len()];
        let travels = |label: &u16| self.state.guidance.travelling.get(usize::from(*label)) == Some(&true);
        let travelling: Vec<u16> = (1..=self.state.field.instances.len() as u16).filter(travels).collect();
        let lacking = self.without_gaussians(&travelling)?;
        let mut added = Added::default();
        if !travelling.is_empty() || !lacking.is_empty() {
            let observations = self.observe(true)?;
            self.fit_travelling()?;
            for (k, seen) in observations.iter().enumerate() {
                let label = k as u16 + 1;
                let track = if lacking.contains(&label) {
                    resting(seen)
                } else if travelling.contains(&label) && !self.add_object(label, &mut added) {
                    fit(seen)
                } else {
                    continue;
                };
                if !seen.is_empty() {
                    let middle = self.state.dataset.points.core_bounds().centre();
                    self.seed(label, track.unwrap_or_else(|| on_rays(seen, middle)), seen)?;
                }
            }
            let notes = hide_absent(&mut self.state, self.simd, &added.posed)?;
            self.messages.extend(notes);
        }
        let n = self.state.field.len();
        self.state.guidance.guide_of.resize(n, 0);
        if let Some(tracks) = &mut self.state.field.tracks {
            tracks.group_of.resize(n, cif_field::tracks::NO_GROUP);
        }
        if let Some(deformation) = self.state.field.deformation.as_mut().filter(|d| !d.still.is_empty()) {
            deformation.still.resize(n, false);
        }
        self.rehearse(&added.bending)
    }

    /// Teaches the deformation the paths, and how objects deform, before it sees an image.
    fn rehearse(&mut self, bending: &[(usize, Bending)]) -> Result<(), TrainError> {
        self.state.optimiser = Optimiser::new(&self.state.field);
        self.state.gradients = Gradients::zeros(&self.state.field);
        if self.state.guidance.guides.is_empty() && bending.is_empty() {
            return Ok(());
        }
        let rates = StepRates::at(&self.state.config, Stage::Fine, 1, &self.state.field).only(&[PLANES, MLP]);
        let weights = plane_weights(&self.state.config);
        let times = self.state.dataset.times.clone();
        let extent = f64::from(self.state.field.extent);
        let mut rng = stream(self.state.config.seed, Purpose::Guidance, 0);
        let mut renderer = Renderer::new(self.simd);
        let phases = self.state.phases.clone();
        let phase = phases.enter(Phase::Rehearsal, self.state.config.motion.rehearsal as usize);
        phase.until(self.deadline(Phase::Rehearsal));
        for _ in 0..self.state.config.motion.rehearsal {
            // What a budget has no time for, the fine stage teaches.
            if in_time(phases.check())?.is_none() {
                break;
            }
            phases.advance();
            let place = rng.random_range(0..times.len());
            let time = times[place];
            renderer.displace(&self.state.field, time);
            let guidance = &self.state.guidance;
            let (guided, n) = (guidance.guided().max(1) as f32, guidance.guide_of.len() as f32);
            // Both kinds count alike here, however few Gaussians travel.
            let state = &mut self.state;
            let mut v = state.pulls(time, [n / guided, 1.0]).map_or_else(Vec::new, |pulls| {
                state.guidance.gradients(&pulls, &state.field, renderer.posed_means())
            });
            for (first, bending) in bending {
                let canonical = &state.field.gaussians.means[*first..][..bending.gaussians.len()];
                let displaced = &renderer.posed_means()[*first..];
                // As much in all as everything else, however few they are.
                let weight = 1.0 / (canonical.len() as f64 * PATH_REACH * extent * extent);
                let gradients = bending.pulled(place, canonical, displaced, weight);
                v[*first..][..gradients.len()].copy_from_slice(&gradients);
            }
            renderer.displace_backward(&state.field, time, v, &mut state.gradients);
            let State { field, gradients, optimiser, times, .. } = state;
            optimiser.step(field, gradients, &rates, &weights, false, times).map_err(|parameter| {
                let tensor = parameter.name;
                TrainError::NotFinite { stage: Stage::Fine, iteration: 0, tensor }
            })?;
        }
        Ok(())
    }

    /// Weights of guidance and stillness at a step of a stage.
    pub(super) fn guidance_weight(&self, stage: Stage, iteration: u32) -> [f32; 2] {
        let motion = &self.state.config.motion;
        let done = match stage {
            Stage::Fine => iteration as f32 / self.state.config.fine_iterations().max(1) as f32,
            Stage::Instance => 1.0,
            _ => return [0.0; 2],
        };
        [motion.guidance * motion.guidance_end.powf(done), motion.stillness]
    }
}

/// Per instance, the depth of what is seen just outside its mask where that is nearest.
fn contact_depths(labels: &PixelGrid<u16>, seen: &RenderedImage, instances: usize) -> Vec<Option<f64>> {
    let (width, height) = (labels.width, labels.height);
    let mut rings: Vec<Vec<f64>> = vec![Vec::new(); instances];
    for y in 0..height {
        for x in 0..width {
            if *labels.at(x, y) != UNLABELLED {
                continue;
            }
            let depth = seen.depth.as_ref().map_or(0.0, |depth| *depth.at(x, y));
            if depth <= 0.0 || *seen.alpha.at(x, y) < 0.5 {
                continue;
            }
            let mut adjacent = [x.wrapping_sub(1), x + 1, x, x]
                .into_iter()
                .zip([y, y, y.wrapping_sub(1), y + 1])
                .filter(|(x, y)| *x < width && *y < height)
                .map(|(x, y)| *labels.at(x, y))
                .filter(|label| *label != UNLABELLED)
                .collect::<Vec<_>>();
            adjacent.sort_unstable();
            adjacent.dedup();
            for label in adjacent {
                rings[usize::from(label) - 1].push(f64::from(depth));
            }
        }
    }
    rings
        .into_iter()
        .map(|mut ring| {
            ring.sort_by(f64::total_cmp);
            let nearest = (ring.len() as f64 * CONTACT_SHARE) as usize;
            ring.get(nearest).copied()
        })
        .collect()
}
