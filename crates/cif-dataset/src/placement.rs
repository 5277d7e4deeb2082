//! Captures far from their origin, or in units far from metres, are read in a frame of their own.
//!
//! Gaussians are kept in single precision: at 10 000 scene sizes from the origin, neighbouring positions lie about a
//! thousandth of the scene apart, and no optimiser reaches what is between. Settings in metres (the near plane, the
//! smallest Gaussian) and the motion network suit scenes of metres. Ordinary captures are left exactly as they are.

use cif_geometry::CaptureFrame;
use glam::DVec3;

use crate::Dataset;

/// Sizes that are left alone, metres; the size is how far the cameras spread or look, whichever is more.
const ORDINARY_SIZES: std::ops::RangeInclusive<f64> = 0.1..=100.0;

/// Size near which other scenes are scaled, metres, by a power of ten: units are nearly always wrong by one.
const USUAL_SIZE: f64 = 3.0;

/// Distance of the cameras from the origin, in sizes, that is left alone.
const ORDINARY_DISTANCE: f64 = 10.0;

/// The frame for a scene of `size` whose cameras are around `middle`.
fn own_frame(middle: DVec3, size: f64) -> CaptureFrame {
    let mut frame = CaptureFrame::default();
    if !(size.is_finite() && size > 0.0 && middle.is_finite()) {
        return frame;
    }
    if !ORDINARY_SIZES.contains(&size) {
        frame.scale = 10.0_f64.powi(-(size / USUAL_SIZE).log10().round() as i32);
    }
    if middle.length() > ORDINARY_DISTANCE * size {
        frame.offset = middle.to_array();
    }
    frame
}

impl Dataset {
    /// Puts cameras and points into a frame of their own where the capture is far from its origin or in units far
    /// from metres, notes it in [`Dataset::frame`] and says so. [`Dataset::open`] does it, before points lose precision;
    /// ordinary captures keep their coordinates.
    pub fn enter_own_frame(&mut self) {
        let mut points: Vec<[f64; 3]> =
            self.points.positions.iter().map(|position| position.map(f64::from)).collect();
        self.enter_own_frame_with(&mut points);
        self.points.positions = singles(points);
    }

    /// The same with points that are not yet those of the dataset.
    pub(crate) fn enter_own_frame_with(&mut self, points: &mut [[f64; 3]]) {
        let train = self.train_frames();
        let of_all: Vec<usize> = (0..self.frames.len()).collect();
        let frames = if train.is_empty() { of_all } else { train };
        let centres: Vec<DVec3> = frames.iter().map(|index| self.frames[*index].camera.centre()).collect();
        let middle = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        // A hand-held camera hardly moves, so how far it looks counts as well.
        let mut distances: Vec<f64> =
            points.iter().map(|point| DVec3::from_array(*point).distance(middle)).collect();
        distances.sort_by(f64::total_cmp);
        let looks = distances.get(distances.len() / 2).copied().unwrap_or_default();
        let size = self.camera_spread().max(looks);
        let frame = own_frame(middle, size);
        if frame.is_identity() {
            return;
        }
        for record in &mut self.frames {
            record.camera = frame.camera(&record.camera);
        }
        for point in points {
            *point = frame.dataset_from_capture(DVec3::from_array(*point)).to_array();
        }
        let mut what = Vec::new();
        if frame.offset != [0.0; 3] {
            let [x, y, z] = frame.offset;
            what.push(format!(
                "its origin at ({x:.6}, {y:.6}, {z:.6}), since the cameras are far from the capture's"
            ));
        }
        if frame.scale != 1.0 {
            what.push(format!("lengths times {}, since the scene is {size:.1e} units large", frame.scale));
        }
        self.warnings.push(format!(
            "{}: read in a frame of its own: {}; scenes have these coordinates, exports those of the capture",
            self.root.display(),
            what.join(", and ")
        ));
        self.frame = CaptureFrame {
            offset: (self.frame.capture_from_dataset(DVec3::from(frame.offset))).to_array(),
            scale: self.frame.scale * frame.scale,
        };
    }
}

/// Positions in single precision.
pub(crate) fn singles(positions: Vec<[f64; 3]>) -> Vec<[f32; 3]> {
    positions.into_iter().map(|position| position.map(|value| value as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ordinary_captures_keep_their_coordinates() {
        for (distance, size) in [(0.0, 0.1), (1.0, 3.0), (29.0, 3.0), (0.0, 100.0)] {
            assert!(own_frame(DVec3::X * distance, size).is_identity(), "{distance} {size}");
        }
        // Nothing to measure: nothing to change.
        for size in [0.0, f64::NAN, f64::INFINITY] {
            assert!(own_frame(DVec3::X * 1e9, size).is_identity());
        }
    }

    #[test]
    fn a_capture_in_other_units_is_the_one_in_metres() {
        for power in [-6, -3, 2, 3, 6] {
            let frame = own_frame(DVec3::ZERO, 3.1 * 10.0_f64.powi(power));
            assert!((frame.scale * 10.0_f64.powi(power) - 1.0).abs() < 1e-12, "{power}: {frame:?}");
        }
    }
}
