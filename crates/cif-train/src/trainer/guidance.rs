//! Paths of travelling objects: found in the masks, taught to the deformation, and held while it trains.

use cif_field::parameters::{MLP, PLANES};
use cif_field::{Field, Gaussians};
use cif_geometry::PixelGrid;
use cif_geometry::scalar::logit;
use cif_render::cpu::Renderer;
use cif_render::{Channels, Gradients, RenderSettings, RenderedImage, UNLABELLED};
use glam::DVec3;
use rand::RngExt;

use super::Trainer;
use super::objects::in_time;
use super::plan_step::plane_weights;
use crate::effects::appearing::hide_absent;
use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::guidance::Guide;
use crate::optimiser::{Optimiser, StepRates};
use crate::phase::Phase;
use crate::random::{Purpose, stream};
use crate::stage::Stage;
use crate::state::State;
use crate::tracks::{Observation, Track, fit, travels};

/// Share of the nearest depths around a mask that is taken for noise.
const CONTACT_SHARE: f64 = 0.08;
/// Opacity that injected Gaussians start with.
const OPACITY: f32 = 0.4;
/// Share of the frames in which a point of an object may fall beside its mask.
const OUTSIDE: f64 = 0.15;

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
        if self.state.guidance.travelling.contains(&true) {
            let observations = self.observe(true)?;
            self.fit_travelling()?;
            let mut posed = Vec::new();
            for (of, observations) in observations.iter().enumerate() {
                if self.state.guidance.travelling[of + 1]
                    && !self.add_object(of as u16 + 1, &mut posed)
                    && let Some(track) = fit(observations)
                {
                    self.inject(of as u16 + 1, track, observations)?;
                }
            }
            let notes = hide_absent(&mut self.state, self.simd, &posed)?;
            self.messages.extend(notes);
        }
        let n = self.state.field.len();
        self.state.guidance.guide_of.resize(n, 0);
        if let Some(tracks) = &mut self.state.field.tracks {
            tracks.group_of.resize(n, cif_field::tracks::NO_GROUP);
        }
        self.rehearse()
    }

    /// Gaussians for one travelling object, inside its masks wherever it goes.
    fn inject(&mut self, label: u16, track: Track, seen: &[Observation]) -> Result<(), TrainError> {
        let times = &self.state.dataset.times;
        // The canonical pose is the one that shows most of it.
        let Some(best) = seen.iter().max_by(|a, b| {
            (!a.cut, a.area_px).partial_cmp(&(!b.cut, b.area_px)).unwrap_or(std::cmp::Ordering::Equal)
        }) else {
            return Ok(());
        };
        let reference = track.at(times, times[best.time_index]);
        let mut rng = stream(self.state.config.seed, Purpose::Guidance, u64::from(label));
        let wanted = self.state.config.motion.gaussians as usize;
        let frames: Vec<_> = (0..self.state.frames.len())
            .map(|view| {
                self.state.phases.check()?;
                Ok((self.state.frames.index(view), self.state.frames.get(&self.state.dataset, view)?))
            })
            .collect::<Result<_, TrainError>>()?;
        let (mut positions, mut colors) = (Vec::new(), Vec::new());
        for _ in 0..wanted * 40 {
            if positions.len() == wanted {
                break;
            }
            self.state.phases.check()?;
            let offset = DVec3::from(std::array::from_fn(|_| rng.random::<f64>() * 2.0 - 1.0));
            let offset = offset * 1.5 * track.radius;
            let (mut inside, mut outside, mut sum) = (0.0_f64, 0.0_f64, DVec3::ZERO);
            for (index, data) in &frames {
                let frame = &self.state.dataset.frames[*index];
                let Some(labels) = &data.labels else { continue };
                if !seen.iter().any(|o| o.time_index == frame.time_index) {
                    continue;
                }
                let place = track.at(times, frame.time) + offset;
                let Some([x, y]) = frame.camera.pixel_of(place) else { continue };
                let found = *labels.at(x, y);
                if found == label {
                    inside += 1.0;
                    let color = data.image.at(x, y);
                    sum += DVec3::from(color.map(|c| f64::from(c) / 255.0));
                } else if found == UNLABELLED {
                    outside += 1.0;
                }
            }
            if inside > 0.0 && outside <= OUTSIDE * (inside + outside) {
                positions.push((reference + offset).as_vec3().to_array());
                colors.push((sum / inside).as_vec3().to_array());
            }
        }
        if positions.len() < 4 {
            return Ok(());
        }
        let mut fresh = Gaussians::from_points(&positions, &colors)?;
        fresh.opacity_logits.fill(logit(OPACITY));
        fresh.occupancy_logits.fill(logit(self.state.config.instance.occupancy));
        // Objects with poses came in between, which no path holds.
        let State { field, guidance, .. } = &mut self.state;
        guidance.guide_of.resize(field.len(), 0);
        field.gaussians.append(&fresh);
        guidance.guides.push(Guide { track, reference });
        guidance.guide_of.resize(field.len(), guidance.guides.len() as u16);
        Ok(())
    }

    /// Teaches the deformation the paths before it sees an image.
    fn rehearse(&mut self) -> Result<(), TrainError> {
        self.state.optimiser = Optimiser::new(&self.state.field);
        self.state.gradients = Gradients::zeros(&self.state.field);
        if self.state.guidance.guides.is_empty() {
            return Ok(());
        }
        let rates = StepRates::at(&self.state.config, Stage::Fine, 1, &self.state.field).only(&[PLANES, MLP]);
        let weights = plane_weights(&self.state.config);
        let times = self.state.dataset.times.clone();
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
            let time = times[rng.random_range(0..times.len())];
            renderer.displace(&self.state.field, time);
            let guided =
                self.state.guidance.guide_of.iter().filter(|guide| **guide > 0).count().max(1) as f32;
            let n = self.state.guidance.guide_of.len() as f32;
            // Both kinds count alike here, however few Gaussians travel.
            let state = &mut self.state;
            let v = state.pulls(time, [n / guided, 1.0]).map_or_else(Vec::new, |pulls| {
                state.guidance.gradients(&pulls, &state.field, renderer.posed_means())
            });
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
            let mut beside = [x.wrapping_sub(1), x + 1, x, x]
                .into_iter()
                .zip([y, y, y.wrapping_sub(1), y + 1])
                .filter(|(x, y)| *x < width && *y < height)
                .map(|(x, y)| *labels.at(x, y))
                .filter(|label| *label != UNLABELLED)
                .collect::<Vec<_>>();
            beside.sort_unstable();
            beside.dedup();
            for label in beside {
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
