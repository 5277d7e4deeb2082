//! First Gaussians of objects that nothing was made of: inside their masks.
//!
//! What travels trains nothing in the coarse stage, and what moves a little or is thin leaves nothing in it, as most
//! images show something else in its place.

use std::collections::{BTreeMap, BTreeSet};

use cif_field::Gaussians;
use cif_geometry::scalar::logit;
use cif_render::UNLABELLED;
use glam::{DVec2, DVec3};
use rand::RngExt;

use super::Trainer;
use crate::density::FEWEST_OF_OBJECT;
use crate::error::TrainError;
use crate::guidance::Guide;
use crate::random::{Purpose, stream};
use crate::state::State;
use crate::tracks::{Observation, Track};

/// Opacity that they start with.
const OPACITY: f32 = 0.4;

/// Share of the frames in which a point of an object may fall outside its mask.
const OUTSIDE: f64 = 0.15;

/// Views of an object that decide whether Gaussians lie inside its masks, spread evenly.
const LOOKS: usize = 30;

/// Centres and colours in [0, 1].
type Points = (Vec<[f32; 3]>, Vec<[f32; 3]>);

impl Trainer {
    /// Labels (dense index + 1) of the objects, but for `others`, that masks show and that have hardly a Gaussian: one that
    /// shows up inside its mask in most of the views which show it.
    pub(super) fn without_gaussians(&self, others: &[u16]) -> Result<Vec<u16>, TrainError> {
        let state = &self.state;
        let masks = state.frames.masks(&state.dataset, &state.phases)?;
        let shows = |view: usize, label: u16| {
            let frame = &state.dataset.frames[state.frames.index(view)];
            let row = masks[view].as_ref().and_then(|table| table.rows.get(&label));
            row.is_some_and(|row| row.observation(&frame.camera, frame.time_index).is_some())
        };
        let gaussians = &state.field.gaussians;
        let drawn: Vec<u32> = (0..gaussians.len() as u32)
            .filter(|row| gaussians.opacity(*row as usize) >= state.config.densify.prune_opacity)
            .collect();
        // Labels to look for, by view.
        let mut requested: BTreeMap<usize, BTreeSet<u16>> = BTreeMap::new();
        let mut looks: BTreeMap<u16, usize> = BTreeMap::new();
        for label in (1..=state.field.instances.len() as u16).filter(|label| !others.contains(label)) {
            let views: Vec<usize> = (0..masks.len()).filter(|view| shows(*view, label)).collect();
            for view in views.iter().step_by(views.len().div_ceil(LOOKS).max(1)) {
                requested.entry(*view).or_default().insert(label);
                *looks.entry(label).or_default() += 1;
            }
        }
        // Gaussians inside the mask of a label, once a view.
        let mut inside: Vec<(u16, u32)> = Vec::new();
        for (view, requested) in &requested {
            state.phases.check()?;
            let data = state.frames.get(&state.dataset, *view)?;
            let Some(labels) = &data.labels else { continue };
            let camera = &state.dataset.frames[state.frames.index(*view)].camera;
            inside.extend(drawn.iter().filter_map(|row| {
                let place = DVec3::from(gaussians.means[*row as usize].map(f64::from));
                let label = camera.pixel_of(place).map(|[x, y]| *labels.at(x, y))?;
                requested.contains(&label).then_some((label, *row))
            }));
        }
        inside.sort_unstable();
        let mut own: BTreeMap<u16, usize> = BTreeMap::new();
        for views in inside.chunk_by(|a, b| a == b) {
            let label = views[0].0;
            *own.entry(label).or_default() += usize::from(2 * views.len() > looks[&label]);
        }
        let lacks = |label: &u16| own.get(label).is_none_or(|own| *own < FEWEST_OF_OBJECT);
        Ok(looks.into_keys().filter(lacks).collect())
    }

    /// Gaussians for one object on its path: inside all of its masks or, where these leave no room, as of a thin thing that
    /// turns, inside the one that shows most of it.
    pub(super) fn seed(&mut self, label: u16, track: Track, seen: &[Observation]) -> Result<(), TrainError> {
        // The canonical pose is the one that shows most of it.
        let Some(best) = seen.iter().max_by(|a, b| {
            (!a.is_cut(), a.area_px)
                .partial_cmp(&(!b.is_cut(), b.area_px))
                .unwrap_or(std::cmp::Ordering::Equal)
        }) else {
            return Ok(());
        };
        let times = &self.state.dataset.times;
        let reference = track.at(times, times[best.time_index]);
        let (mut positions, mut colors) = self.inside_masks(label, &track, reference, seen)?;
        if positions.len() < FEWEST_OF_OBJECT {
            // About one a pixel draws it as it is seen.
            let count = (self.state.config.motion.gaussians as usize).min(best.area_px as usize);
            (positions, colors) = self.inside_mask(label, reference, best, count)?;
        }
        if positions.len() < FEWEST_OF_OBJECT {
            return Ok(());
        }
        let mut fresh = Gaussians::from_points(&positions, &colors)?;
        fresh.opacity_logits.fill(logit(OPACITY));
        let first = self.append(fresh);
        let State { field, guidance, .. } = &mut self.state;
        guidance.guides.push(Guide { track, reference });
        guidance.extend(first, field.len() - first, guidance.guides.len() as u16);
        Ok(())
    }

    /// Points around a path that lie inside the masks wherever it goes.
    fn inside_masks(
        &self,
        label: u16,
        track: &Track,
        reference: DVec3,
        seen: &[Observation],
    ) -> Result<Points, TrainError> {
        let times = &self.state.dataset.times;
        let mut rng = stream(self.state.config.seed, Purpose::Guidance, u64::from(label));
        let count = self.state.config.motion.gaussians as usize;
        let frames: Vec<_> = (0..self.state.frames.len())
            .map(|view| {
                self.state.phases.check()?;
                Ok((self.state.frames.index(view), self.state.frames.get(&self.state.dataset, view)?))
            })
            .collect::<Result<_, TrainError>>()?;
        let (mut positions, mut colors) = (Vec::new(), Vec::new());
        for _ in 0..count * 40 {
            if positions.len() == count {
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
        Ok((positions, colors))
    }

    /// At most so many points on rays through the mask of an observation, as deep as a `place` and about as far before and
    /// behind it as the mask is wide.
    fn inside_mask(
        &self,
        label: u16,
        place: DVec3,
        seen: &Observation,
        most: usize,
    ) -> Result<Points, TrainError> {
        let state = &self.state;
        let masks = state.frames.masks(&state.dataset, &state.phases)?;
        let shows = |view: &usize| {
            let frame = &state.dataset.frames[state.frames.index(*view)];
            let row = masks[*view].as_ref().and_then(|table| table.rows.get(&label));
            row.and_then(|row| row.observation(&frame.camera, frame.time_index)).is_some_and(|own| {
                (own.time_index, own.camera, own.centroid_px)
                    == (seen.time_index, seen.camera, seen.centroid_px)
            })
        };
        let (mut positions, mut colors) = (Vec::new(), Vec::new());
        let Some(view) = (0..masks.len()).find(shows).filter(|_| most > 0) else {
            return Ok((positions, colors));
        };
        let data = state.frames.get(&state.dataset, view)?;
        let Some(labels) = &data.labels else { return Ok((positions, colors)) };
        let all = (0..labels.height).flat_map(|y| (0..labels.width).map(move |x| (x, y)));
        let pixels: Vec<(u32, u32)> = all.filter(|(x, y)| *labels.at(*x, *y) == label).collect();
        let depth = seen.camera.camera_from_world.apply(place).z;
        let half_width_px = masks[view].as_ref().map_or(0.0, |table| table.rows[&label].half_width_px());
        let half_width = depth * half_width_px / seen.camera.focal_px.min_element();
        let mut rng = stream(state.config.seed, Purpose::Guidance, u64::from(label));
        for (x, y) in pixels.iter().step_by(pixels.len().div_ceil(most).max(1)) {
            let mut within = || rng.random::<f64>();
            let pixel = DVec2::new(f64::from(*x) + within(), f64::from(*y) + within());
            let depth = depth + half_width * (2.0 * within() - 1.0);
            positions.push((seen.camera.centre() + depth * seen.camera.ray(pixel)).as_vec3().to_array());
            colors.push(data.image.at(*x, *y).map(|c| f32::from(c) / 255.0));
        }
        Ok((positions, colors))
    }
}
