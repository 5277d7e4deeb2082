//! Paths that the Gaussians of travelling objects are held to while the deformation trains, and the places of
//! everything else. A run finds them in the masks; engines pull by them.

use std::collections::BTreeMap;

use cif_field::Field;
use cif_field::checkpoint::StateTensor;
use cif_geometry::PixelGrid;
use glam::DVec3;

use crate::losses::displacement::{FREE, Pose, Pull, displacement_loss, pose_index, rotations};
use crate::tracks::Track;

/// Distance from the path beyond which the pull no longer grows, relative to the extent.
pub(crate) const PATH_REACH: f64 = 0.02;

/// The same for the distance from the canonical place of what does not travel.
const PLACE_REACH: f64 = 0.002;

/// A travelling object.
#[derive(Clone)]
pub(crate) struct Guide {
    pub track: Track,
    /// Where its centre is in the canonical set.
    pub reference: DVec3,
}

/// Everything that keeps objects on their paths; empty without guidance.
#[derive(Clone, Default)]
pub(crate) struct Guidance {
    /// Per label (dense index + 1), whether the instance travels.
    pub travelling: Vec<bool>,
    pub guides: Vec<Guide>,
    /// Per Gaussian its guide + 1, 0 for what is held in place, [`FREE`] for what deforms.
    pub guide_of: Vec<u16>,
}

impl Guidance {
    /// True when Gaussians of travelling objects are distinguished from the others.
    pub(crate) fn knows_what_travels(&self) -> bool {
        !self.guides.is_empty()
    }

    /// True when a Gaussian was made for an object that travels or deforms.
    pub(crate) fn moves(&self, row: usize) -> bool {
        self.guide_of.get(row).is_some_and(|guide| *guide > 0)
    }

    /// Gaussians that are held to a path.
    pub(crate) fn guided(&self) -> usize {
        self.guide_of.iter().filter(|of| pose_index(**of).is_some()).count()
    }

    /// Says of `n` Gaussians, the last of the field and the first that were not spoken of yet but for those with poses, what
    /// holds them.
    pub(crate) fn extend(&mut self, first: usize, n: usize, guide: u16) {
        self.guide_of.resize(first, 0);
        self.guide_of.resize(first + n, guide);
    }

    pub(crate) fn gather(&mut self, parents: &[u32]) {
        if !self.guide_of.is_empty() {
            self.guide_of = parents.iter().map(|row| self.guide_of[*row as usize]).collect();
        }
    }

    /// Tensors that a saved state has to hold; none without guidance.
    pub(crate) fn tensors(&self) -> Vec<(&'static str, StateTensor)> {
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

    /// Restores what [`Self::tensors`] stored, for `n` Gaussians and `times` captured times; `None` when it does not
    /// fit.
    pub(crate) fn restore(
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
        let fits = guide_of.len() == n
            && guide_of.iter().all(|of| *of as usize <= guides.len() || *of == u32::from(FREE));
        (fits && places.is_empty()).then(|| {
            self.guide_of = guide_of.into_iter().map(|of| of as u16).collect();
            self.guides = guides;
        })
    }

    pub(crate) fn copy(&mut self, to: u32, from: u32) {
        if !self.guide_of.is_empty() {
            self.guide_of[to as usize] = self.guide_of[from as usize];
        }
    }

    /// Labels (dense index + 1) of travelling objects, where there are any.
    pub(crate) fn travelling_labels(&self) -> Option<&[bool]> {
        let travelling = &self.travelling[..];
        travelling.contains(&true).then_some(travelling)
    }

    /// Keeps travelling objects out of the static set: the colours of their pixels train nothing.
    pub(crate) fn leave_out_travelling(
        &self,
        labels: Option<&PixelGrid<u16>>,
        v_color: &mut PixelGrid<[f32; 3]>,
    ) {
        let (Some(labels), Some(travelling)) = (labels, self.travelling_labels()) else { return };
        for (v, label) in v_color.pixels.iter_mut().zip(&labels.pixels) {
            if travelling[usize::from(*label)] {
                *v = [0.0; 3];
            }
        }
    }

    /// Pulls of `weights` (to paths, to places) on a field at one of the `times` of its capture, or between them;
    /// `None` where nothing pulls.
    pub(crate) fn pulls(
        &self,
        field: &Field,
        times: &[f64],
        time: f64,
        [guidance, stillness]: [f32; 2],
    ) -> Option<Pulls> {
        if (guidance, stillness) == (0.0, 0.0) || self.guide_of.len() != field.gaussians.len() {
            return None;
        }
        let extent = f64::from(field.extent);
        let pull = |weight: f32, reach: f64| Pull { weight: f64::from(weight), reach: reach * extent };
        Some(Pulls {
            shifts: self.guides.iter().map(|guide| guide.track.at(times, time) - guide.reference).collect(),
            strengths: [pull(guidance, PATH_REACH), pull(stillness, PLACE_REACH)],
        })
    }

    /// Gradients of the pulls by the `displaced` centres of the field's Gaussians.
    pub(crate) fn gradients(&self, pulls: &Pulls, field: &Field, displaced: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let canonical = &field.gaussians.means;
        let rotations = rotations(displaced, canonical, &self.guide_of, self.guides.len());
        let poses: Vec<Pose> = pulls
            .shifts
            .iter()
            .zip(rotations)
            .map(|(shift, rotation)| Pose { shift: *shift, rotation })
            .collect();
        let extent = f64::from(field.extent);
        displacement_loss(displaced, canonical, &self.guide_of, &poses, pulls.strengths, extent).1
    }
}

/// Pulls at a time.
pub(crate) struct Pulls {
    /// Distance of each object from its canonical place.
    pub shifts: Vec<DVec3>,
    /// Of the pulls to paths and to places.
    pub strengths: [Pull; 2],
}
