//! Known motion of a capture, where it has some: `motion.json`, and `tracks.npz` next to it.
//!
//! | file | holds |
//! |---|---|
//! | `motion.json` | `frames`: normalised `time` of every step; `instances`: per mask id `label`, `motion` (`static`, `rigid`, `articulated`, `deforming`), `matrix` (object to world, 4 x 4, row by row, one per step), `aabb_min` and `aabb_max` (world box, one per step) |
//! | `tracks.npz` | `ids` `[I]`: mask ids; `points` `[I, P, T, 3]`: followed points of their surfaces at every step |
//!
//! Coordinates are those of the world of the capture, metres. Other keys and arrays are not read.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::Bounds;
use glam::{DMat4, DVec3};
use serde::Deserialize;

use crate::files::npy::{Archive, Array, Elements};
use crate::files::{json, listing};
use crate::{Dataset, Error, mask_files};

/// Name of the file of poses and boxes in a capture.
pub const MOTION_FILE: &str = "motion.json";

/// Name of the file of followed points in a capture.
pub const TRACKS_FILE: &str = "tracks.npz";

/// Pixels that a mask has to show of an instance, for its motion to be known at that time.
pub const LEAST_SEEN_PIXELS: u64 = 20;

/// Largest difference between a normalised time and that of a step that still counts as the same.
const SAME_TIME: f64 = 1e-4;

/// Known motion of a capture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionTruth {
    /// Normalised time of every step, `[T]`, in the order of the file.
    pub times: Vec<f64>,
    /// Motion of the instances by mask id.
    pub instances: BTreeMap<u16, TrueMotion>,
}

/// Known motion of an instance, in the world of the capture, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct TrueMotion {
    /// Human name.
    pub label: String,
    /// Kind of motion: `static`, `rigid`, `articulated` or `deforming`.
    pub kind: String,
    /// `world_from_object` of every step, `[T]`, with the scale of the object.
    pub world_from_object: Vec<DMat4>,
    /// World box of every step, `[T]`.
    pub boxes: Vec<Bounds>,
    /// Followed surface points, `[P][T]`; empty where none are known.
    pub points: Vec<Vec<DVec3>>,
}

#[derive(Deserialize)]
struct MotionFile {
    frames: Vec<Step>,
    instances: BTreeMap<u16, Entry>,
}

#[derive(Deserialize)]
struct Step {
    time: f64,
}

#[derive(Deserialize)]
struct Entry {
    label: String,
    motion: String,
    matrix: Vec<[[f64; 4]; 4]>,
    aabb_min: Vec<DVec3>,
    aabb_max: Vec<DVec3>,
}

impl MotionTruth {
    /// Reads `motion.json`, and so no followed points.
    ///
    /// # Errors
    /// When it cannot be read, is not in the format, or has other numbers of matrices and boxes than of steps.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let file: MotionFile = json::read(path).map_err(|error| match error {
            Error::Json { path, line, column, problem } => Error::Json {
                path,
                line,
                column,
                problem: format!(
                    "{problem}; expected are `frames` with `time`, and `instances` with `label`, `motion`, \
                     `matrix`, `aabb_min` and `aabb_max`"
                ),
            },
            other => other,
        })?;
        let steps = file.frames.len();
        let mut instances = BTreeMap::new();
        for (id, entry) in file.instances {
            let lengths = [entry.matrix.len(), entry.aabb_min.len(), entry.aabb_max.len()];
            if lengths != [steps; 3] {
                return Err(Error::invalid(
                    path,
                    format!(
                        "instance {id} has {} of `matrix`, {} of `aabb_min` and {} of `aabb_max` for {steps} frames; \
                         give one of each per frame",
                        lengths[0], lengths[1], lengths[2]
                    ),
                ));
            }
            let boxes: Vec<Bounds> = entry
                .aabb_min
                .into_iter()
                .zip(entry.aabb_max)
                .map(|(low, high)| Bounds { low, high })
                .collect();
            if let Some(frame) = boxes.iter().position(Bounds::is_empty) {
                return Err(Error::invalid(
                    path,
                    format!(
                        "instance {id} has an `aabb_min` above its `aabb_max` in frame {frame}; exchange the two"
                    ),
                ));
            }
            let matrix = |rows: &[[f64; 4]; 4]| DMat4::from_cols_array_2d(rows).transpose();
            let motion = TrueMotion {
                label: entry.label,
                kind: entry.motion,
                world_from_object: entry.matrix.iter().map(matrix).collect(),
                boxes,
                points: Vec::new(),
            };
            instances.insert(id, motion);
        }
        Ok(Self { times: file.frames.iter().map(|step| step.time).collect(), instances })
    }

    /// Adds the followed points of `tracks.npz`.
    ///
    /// # Errors
    /// When the file cannot be read, is not in the format, or follows other instances or steps than are known.
    pub fn add_tracks(&mut self, path: &Path) -> Result<(), Error> {
        let mut archive = Archive::open(path)?;
        let ids = archive.array("ids", Elements::Integers)?;
        let Array { shape, values } = archive.array("points", Elements::Floats)?;
        let steps = self.times.len();
        let expected = |problem: String| {
            Error::invalid(path, format!("{problem}; write the file again, for the {MOTION_FILE} beside it"))
        };
        let (followed, points) = match (&*ids.shape, &*shape) {
            (&[ids], &[instances, points, times, 3]) if ids == instances && times == steps => (ids, points),
            _ => {
                return Err(expected(format!(
                    "`ids` of shape {:?} and `points` of shape {shape:?} where [instances] and [instances, points, \
                     {steps} times, 3] are expected",
                    ids.shape
                )));
            }
        };
        if let Some(at) = values.iter().position(|value| !value.is_finite()) {
            let id = ids.values[at / (3 * steps * points)];
            return Err(expected(format!("a point of instance {id} is not finite")));
        }
        // Empty arrays hold nothing to be cut up.
        let tracks = values.chunks_exact((3 * steps).max(1)).map(|track| {
            track.chunks_exact(3).map(|point| DVec3::new(point[0], point[1], point[2])).collect::<Vec<_>>()
        });
        let mut tracks = tracks.fuse();
        for id in ids.values.iter().take(followed) {
            let known = (*id >= 0.0 && *id <= f64::from(u16::MAX)).then_some(*id as u16);
            let known = known.and_then(|id| self.instances.get_mut(&id));
            let known = known.ok_or_else(|| expected(format!("instance {id} is not in {MOTION_FILE}")))?;
            if !known.points.is_empty() {
                return Err(expected(format!("instance {id} is followed twice")));
            }
            known.points = tracks.by_ref().take(points).collect();
        }
        Ok(())
    }

    /// The motion of a window of time, given by its ends, which become 0 and 1.
    fn during(self, [first, last]: [f64; 2]) -> Self {
        let kept: Vec<usize> = (0..self.times.len())
            .filter(|step| (first - SAME_TIME..=last + SAME_TIME).contains(&self.times[*step]))
            .collect();
        fn of<T: Clone>(values: &[T], kept: &[usize]) -> Vec<T> {
            kept.iter().map(|step| values[*step].clone()).collect()
        }
        let instances = self.instances.into_iter().map(|(id, motion)| {
            let of_window = TrueMotion {
                world_from_object: of(&motion.world_from_object, &kept),
                boxes: of(&motion.boxes, &kept),
                points: motion.points.iter().map(|track| of(track, &kept)).collect(),
                ..motion
            };
            (id, of_window)
        });
        Self {
            times: kept.iter().map(|step| (self.times[*step] - first) / (last - first)).collect(),
            instances: instances.collect(),
        }
    }

    /// Steps at which some mask of the capture, as stored, shows at least [`LEAST_SEEN_PIXELS`] of an instance,
    /// ascending, by mask id. Nobody can know the motion at others. Decodes every mask.
    ///
    /// # Errors
    /// When a mask cannot be decoded.
    pub fn seen_steps(&self, dataset: &Dataset) -> Result<BTreeMap<u16, Vec<usize>>, Error> {
        let all: Vec<usize> = (0..dataset.times.len()).collect();
        let step_of = self.steps_at(&dataset.times, &all);
        let counts = mask_files::count_pixels(&dataset.frames, &dataset.mask_objects)?;
        let mut seen: BTreeMap<u16, BTreeSet<usize>> = BTreeMap::new();
        for (frame, counts) in dataset.frames.iter().zip(counts) {
            let (Some((counts, _)), Some(step)) = (counts, step_of[frame.time_index]) else { continue };
            for (id, _) in counts.into_iter().filter(|(_, pixels)| *pixels >= LEAST_SEEN_PIXELS) {
                seen.entry(id).or_default().insert(step);
            }
        }
        Ok(seen.into_iter().map(|(id, steps)| (id, steps.into_iter().collect())).collect())
    }

    /// Step of each of `times` (normalised, ascending), which are those of the frames `frames` of the capture. Times
    /// count where they are the same on both sides; layouts that normalise time otherwise (Neu3D divides by the
    /// number of frames) are matched frame by frame instead.
    #[must_use]
    pub fn steps_at(&self, times: &[f64], frames: &[usize]) -> Vec<Option<usize>> {
        let step_at = |time: f64| self.times.iter().position(|step| (step - time).abs() < SAME_TIME);
        let by_time: Vec<Option<usize>> = times.iter().map(|time| step_at(*time)).collect();
        if by_time.iter().all(Option::is_some) {
            return by_time;
        }
        let mut ascending: Vec<usize> = (0..self.times.len()).collect();
        ascending.sort_by(|a, b| self.times[*a].total_cmp(&self.times[*b]).then(a.cmp(b)));
        let by_frame: Vec<Option<usize>> =
            frames.iter().map(|frame| ascending.get(*frame).copied()).collect();
        if by_frame.iter().all(Option::is_some) { by_frame } else { by_time }
    }
}

impl Dataset {
    /// The files of known motion, `motion.json` and `tracks.npz`; `None` where the capture lacks one of them.
    #[must_use]
    pub fn motion_files(&self) -> Option<[PathBuf; 2]> {
        let files = [MOTION_FILE, TRACKS_FILE].map(|name| self.root.join(name));
        files.iter().all(|file| listing::is_there(file)).then_some(files)
    }

    /// Known motion with followed points; `None` where the capture lacks one of the files.
    ///
    /// # Errors
    /// As [`MotionTruth::read`] and [`MotionTruth::add_tracks`].
    pub fn motion_truth(&self) -> Result<Option<MotionTruth>, Error> {
        let Some([motion, tracks]) = self.motion_files() else { return Ok(None) };
        let mut truth = MotionTruth::read(&motion)?;
        truth.add_tracks(&tracks)?;
        if let Some(window) = &self.window {
            truth = truth.during(window.times);
        }
        Ok(Some(truth))
    }
}

#[cfg(test)]
mod tests;
