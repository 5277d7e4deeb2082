//! Paths of travelling objects: found in the masks, taught to the deformation, and held while it trains.

use std::collections::BTreeMap;

use cif_field::checkpoint::StateTensor;
use cif_field::parameters::{MLP, PLANES};
use cif_field::{Field, Gaussians};
use cif_geometry::PixelGrid;
use cif_geometry::scalar::logit;
use cif_render::{Channels, Gradients, RenderSettings, RenderedImage, UNLABELLED};
use glam::DVec3;
use rand::RngExt;

use super::Trainer;
use super::frames::TrainFrame;
use super::optimiser::{Optimiser, StepRates};
use super::step_plan::plane_weights;
use crate::error::TrainError;
use crate::events::Stage;
use crate::losses::displacement::{Pose, Pull, displacement_loss, rotations};
use crate::random::{Purpose, stream};
use crate::tracks::{Observation, Track, fit, observe, travels};

/// Share of the nearest depths around a mask that is taken for noise.
const CONTACT_SHARE: f64 = 0.08;
/// Distance from the path beyond which the pull no longer grows, relative to the extent.
const PATH_REACH: f64 = 0.02;
/// The same for the distance from the canonical place of what does not travel.
const PLACE_REACH: f64 = 0.002;
/// Opacity that injected Gaussians start with.
const OPACITY: f32 = 0.4;
/// Share of the frames in which a point of an object may fall beside its mask.
const OUTSIDE: f64 = 0.15;

/// A travelling object.
#[derive(Clone)]
pub(super) struct Guide {
    track: Track,
    /// Where its centre is in the canonical set.
    reference: DVec3,
}

/// Everything that keeps objects on their paths; empty without guidance.
#[derive(Clone, Default)]
pub(super) struct Guidance {
    /// Per label (dense index + 1), whether the instance travels.
    travelling: Vec<bool>,
    guides: Vec<Guide>,
    /// Per Gaussian its guide + 1, 0 for what does not travel.
    guide_of: Vec<u16>,
}

impl Guidance {
    /// True when Gaussians of travelling objects are told from the others.
    pub(super) fn knows_what_travels(&self) -> bool {
        !self.guides.is_empty()
    }

    /// True when a Gaussian was made for a travelling object.
    pub(super) fn travels(&self, row: usize) -> bool {
        self.guide_of.get(row).is_some_and(|guide| *guide > 0)
    }

    pub(super) fn gather(&mut self, parents: &[u32]) {
        if !self.guide_of.is_empty() {
            self.guide_of = parents.iter().map(|row| self.guide_of[*row as usize]).collect();
        }
    }

    /// What a saved state needs to hold; nothing without guidance.
    pub(super) fn tensors(&self) -> Vec<(&'static str, StateTensor)> {
        if self.guide_of.is_empty() {
            return Vec::new();
        }
        let floats = |guide: &Guide| -> Vec<f64> {
            std::iter::once(&guide.reference).chain(&guide.track.centres).flat_map(|p| p.to_array()).collect()
        };
        let times = |guide: &Guide| -> Vec<u32> {
            let indices = guide.track.time_indices.iter().map(|index| *index as u32);
            std::iter::once(guide.track.time_indices.len() as u32).chain(indices).collect()
        };
        vec![
            ("motion.guide_of", StateTensor::U32(self.guide_of.iter().map(|of| u32::from(*of)).collect())),
            ("motion.times", StateTensor::U32(self.guides.iter().flat_map(times).collect())),
            ("motion.places", StateTensor::F64(self.guides.iter().flat_map(floats).collect())),
        ]
    }

    /// What [`Self::tensors`] stored, for `n` Gaussians and as many times as given; `None` when it does not fit.
    pub(super) fn restore(
        &mut self,
        tensors: &mut BTreeMap<String, StateTensor>,
        n: usize,
        times: usize,
    ) -> Option<()> {
        let Some(guide_of) = tensors.remove("motion.guide_of") else { return Some(()) };
        let stored = (guide_of, tensors.remove("motion.times")?, tensors.remove("motion.places")?);
        let (StateTensor::U32(guide_of), StateTensor::U32(indices), StateTensor::F64(places)) = stored else {
            return None;
        };
        let (mut indices, mut places) = (&indices[..], &places[..]);
        let mut guides = Vec::new();
        while let Some((count, rest)) = indices.split_first() {
            let count = *count as usize;
            let (own, rest) = rest.split_at_checked(count)?;
            let (own_places, rest_places) = places.split_at_checked(3 * (count + 1))?;
            (indices, places) = (rest, rest_places);
            let fits = count > 0
                && own.windows(2).all(|pair| pair[0] < pair[1])
                && own.iter().all(|index| (*index as usize) < times)
                && own_places.iter().all(|value| value.is_finite());
            if !fits {
                return None;
            }
            let mut points = own_places.chunks_exact(3).map(DVec3::from_slice);
            guides.push(Guide {
                reference: points.next()?,
                track: Track {
                    time_indices: own.iter().map(|index| *index as usize).collect(),
                    centres: points.collect(),
                    radius: 0.0,
                },
            });
        }
        let fits = guide_of.len() == n && guide_of.iter().all(|of| *of as usize <= guides.len());
        (fits && places.is_empty()).then(|| {
            self.guide_of = guide_of.into_iter().map(|of| of as u16).collect();
            self.guides = guides;
        })
    }

    pub(super) fn copy(&mut self, to: u32, from: u32) {
        if !self.guide_of.is_empty() {
            self.guide_of[to as usize] = self.guide_of[from as usize];
        }
    }
}

impl Trainer {
    fn is_guided(&self) -> bool {
        // Without masks nobody knows what may be held in place.
        let is_asked = self.config.motion.guidance > 0.0 || self.config.motion.stillness > 0.0;
        is_asked && self.stages.is_dynamic && self.stages.has_instances
    }

    /// Finds out which instances travel.
    pub(super) fn find_travelling(&mut self) -> Result<(), TrainError> {
        if self.config.motion.guidance <= 0.0 || !self.is_guided() {
            return Ok(());
        }
        let observations = self.observe(false)?;
        self.guidance.travelling = std::iter::once(false)
            .chain(observations.iter().map(|observations| travels(observations)))
            .collect();
        let names: Vec<&str> = (0..observations.len())
            .filter(|k| self.guidance.travelling[k + 1])
            .map(|k| self.field.instances[k].label.as_str())
            .collect();
        if !names.is_empty() {
            self.warnings.push(format!("guided by their masks: {}", names.join(", ")));
        }
        Ok(())
    }

    /// Where every instance is seen, in the order of times; with contact depths if asked.
    fn observe(&mut self, with_contacts: bool) -> Result<Vec<Vec<Observation>>, TrainError> {
        let k = self.field.instances.len();
        let mut observations = vec![Vec::new(); k];
        let scene = with_contacts.then(|| self.without_outliers()).flatten();
        for view in 0..self.frames.len() {
            self.stop.check()?;
            let data = self.frames.get(&self.dataset, view)?;
            let Some(labels) = &data.labels else { continue };
            let settings = RenderSettings { deform: false, ..self.color_settings() };
            let frame = &self.dataset.frames[self.frames.index(view)];
            let contacts = with_contacts.then(|| {
                let scene = scene.as_ref().unwrap_or(&self.field);
                let channels = Channels { depth: true, instances: false };
                let seen = self.renderer.render(scene, &frame.camera, frame.time, &settings, channels);
                contact_depths(labels, &seen, k)
            });
            for (label, observation) in observe(labels, &frame.camera, frame.time_index) {
                let of = usize::from(label) - 1;
                let contact_depth = contacts.as_ref().and_then(|contacts| contacts[of]);
                observations[of].push(Observation { contact_depth, ..observation });
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
        let points = &self.dataset.points;
        let core = points.core_bounds();
        if core == self.dataset.point_bounds() {
            return None;
        }
        let (low, high) = (core.low - core.size(), core.high + core.size());
        let is_near = |mean: &[f32; 3]| {
            let mean = DVec3::from(mean.map(f64::from));
            mean.cmpge(low).all() && mean.cmple(high).all()
        };
        let near: Vec<bool> = self.field.gaussians.means.iter().map(is_near).collect();
        let mut field = self.field.clone();
        field.gaussians.retain(&near);
        (field.deformation, field.identities) = (None, None);
        Some(field)
    }

    /// Keeps travelling objects out of the static set.
    pub(super) fn leave_out_travelling(&mut self, data: &TrainFrame) {
        if let (Some(labels), true) = (&data.labels, self.guidance.travelling.contains(&true)) {
            for (v, label) in self.scratch.v_color.pixels.iter_mut().zip(&labels.pixels) {
                if self.guidance.travelling[usize::from(*label)] {
                    *v = [0.0; 3];
                }
            }
        }
    }

    /// Estimates paths, gives travelling objects Gaussians of their own, and teaches the deformation.
    pub(super) fn start_guidance(&mut self) -> Result<(), TrainError> {
        if !self.is_guided() {
            return Ok(());
        }
        self.guidance.guide_of = vec![0; self.field.gaussians.len()];
        if self.guidance.travelling.contains(&true) {
            let observations = self.observe(true)?;
            for (of, observations) in observations.iter().enumerate() {
                if self.guidance.travelling[of + 1]
                    && let Some(track) = fit(observations)
                {
                    self.inject(of as u16 + 1, track, observations)?;
                }
            }
        }
        self.rehearse()
    }

    /// Gaussians for one travelling object, inside its masks wherever it goes.
    fn inject(&mut self, label: u16, track: Track, seen: &[Observation]) -> Result<(), TrainError> {
        let times = &self.dataset.times;
        // The canonical pose is the one that shows most of it.
        let Some(best) = seen.iter().max_by(|a, b| {
            (!a.cut, a.area_px).partial_cmp(&(!b.cut, b.area_px)).unwrap_or(std::cmp::Ordering::Equal)
        }) else {
            return Ok(());
        };
        let reference = track.at(times, times[best.time_index]);
        let mut rng = stream(self.config.seed, Purpose::Guidance, u64::from(label));
        let wanted = self.config.motion.gaussians as usize;
        let frames: Vec<_> = (0..self.frames.len())
            .map(|view| {
                self.stop.check()?;
                Ok((self.frames.index(view), self.frames.get(&self.dataset, view)?))
            })
            .collect::<Result<_, TrainError>>()?;
        let (mut positions, mut colors) = (Vec::new(), Vec::new());
        for _ in 0..wanted * 40 {
            if positions.len() == wanted {
                break;
            }
            let offset = DVec3::from(std::array::from_fn(|_| rng.random::<f64>() * 2.0 - 1.0));
            let offset = offset * 1.5 * track.radius;
            let (mut inside, mut outside, mut sum) = (0.0_f64, 0.0_f64, DVec3::ZERO);
            for (index, data) in &frames {
                let frame = &self.dataset.frames[*index];
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
        fresh.occupancy_logits.fill(logit(self.config.instance.occupancy));
        self.field.gaussians.append(&fresh);
        self.guidance.guides.push(Guide { track, reference });
        self.guidance.guide_of.resize(self.field.len(), self.guidance.guides.len() as u16);
        Ok(())
    }

    /// Teaches the deformation the paths before it sees an image.
    fn rehearse(&mut self) -> Result<(), TrainError> {
        self.optimiser = Optimiser::new(&self.field);
        self.gradients = Gradients::zeros(&self.field);
        if self.guidance.guides.is_empty() {
            return Ok(());
        }
        let rates = StepRates::at(&self.config, Stage::Fine, 1, &self.field).only(&[PLANES, MLP]);
        let weights = plane_weights(&self.config);
        let times = self.dataset.times.clone();
        let mut rng = stream(self.config.seed, Purpose::Guidance, 0);
        for _ in 0..self.config.motion.rehearsal {
            self.stop.check()?;
            let time = times[rng.random_range(0..times.len())];
            self.renderer.displace(&self.field, time);
            let guided = self.guidance.guide_of.iter().filter(|guide| **guide > 0).count().max(1) as f32;
            let n = self.guidance.guide_of.len() as f32;
            // Both kinds count alike here, however few Gaussians travel.
            let v = self.displacement_gradients(time, [n / guided, 1.0]);
            self.renderer.displace_backward(&self.field, time, v, &mut self.gradients);
            self.optimiser
                .step(&mut self.field, &mut self.gradients, &rates, &weights, false, &mut self.times)
                .map_err(|parameter| {
                    let tensor = parameter.name;
                    TrainError::NotFinite { stage: Stage::Fine, iteration: 0, tensor }
                })?;
        }
        Ok(())
    }

    /// Weights of guidance and stillness at a step of a stage.
    pub(super) fn guidance_weight(&self, stage: Stage, iteration: u32) -> [f32; 2] {
        let motion = &self.config.motion;
        let done = match stage {
            Stage::Fine => iteration as f32 / self.config.fine_iterations().max(1) as f32,
            Stage::Instance => 1.0,
            _ => return [0.0; 2],
        };
        [motion.guidance * motion.guidance_end.powf(done), motion.stillness]
    }

    /// What pulls at a time, for the GPU: how far each object is from its canonical place, and the two pulls; `None`
    /// when nothing pulls.
    #[cfg(feature = "wgpu")]
    pub(super) fn pulls(
        &self,
        time: f64,
        [guidance, stillness]: [f32; 2],
    ) -> Option<(Vec<DVec3>, [Pull; 2])> {
        if (guidance, stillness) == (0.0, 0.0) || self.guidance.guide_of.len() != self.field.gaussians.len() {
            return None;
        }
        let shift = |guide: &Guide| guide.track.at(&self.dataset.times, time) - guide.reference;
        let shifts = self.guidance.guides.iter().map(shift).collect();
        Some((shifts, self.pull_strengths([guidance, stillness])))
    }

    /// Guide + 1 of every Gaussian; empty without guidance.
    #[cfg(feature = "wgpu")]
    pub(super) fn guide_of(&self) -> &[u16] {
        &self.guidance.guide_of
    }

    /// Labels (dense index + 1) of travelling objects, where there are any.
    #[cfg(feature = "wgpu")]
    pub(super) fn travelling_labels(&self) -> Option<&[bool]> {
        let travelling = &self.guidance.travelling[..];
        travelling.contains(&true).then_some(travelling)
    }

    /// The pulls to paths and to places.
    fn pull_strengths(&self, [guidance, stillness]: [f32; 2]) -> [Pull; 2] {
        let extent = f64::from(self.field.extent);
        let pull = |weight: f32, reach: f64| Pull { weight: f64::from(weight), reach: reach * extent };
        [pull(guidance, PATH_REACH), pull(stillness, PLACE_REACH)]
    }

    /// Gradients by what the deformation adds to every centre at the renderer's present time; empty when
    /// nothing pulls.
    pub(super) fn displacement_gradients(&self, time: f64, [guidance, stillness]: [f32; 2]) -> Vec<[f32; 3]> {
        let displaced = self.renderer.posed_means();
        let (guides, pose_of) = (&self.guidance.guides, &self.guidance.guide_of);
        if (guidance, stillness) == (0.0, 0.0) || pose_of.len() != displaced.len() {
            return Vec::new();
        }
        let canonical = &self.field.gaussians.means;
        let rotations = rotations(displaced, canonical, pose_of, guides.len());
        let poses: Vec<Pose> = guides
            .iter()
            .zip(rotations)
            .map(|(guide, rotation)| Pose {
                shift: guide.track.at(&self.dataset.times, time) - guide.reference,
                rotation,
            })
            .collect();
        let extent = f64::from(self.field.extent);
        let pulls = self.pull_strengths([guidance, stillness]);
        displacement_loss(displaced, canonical, pose_of, &poses, pulls, extent).1
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
