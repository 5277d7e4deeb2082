//! The moved Gaussians of every sampled time, made once where memory allows.

use std::sync::Arc;

use cif_field::Gaussians;
use cif_field::gaussians::SH_FLOATS;

use super::source::MotionSource;

/// Bytes of frames that are kept; what does not fit is deformed again when asked for.
const KEPT_BYTES: usize = 512 << 20;
/// Bytes of one Gaussian in a [`Frame`], without its colour.
const GAUSSIAN_BYTES: usize = 44;
/// Bytes of the colour.
const COLOR_BYTES: usize = 4 * SH_FLOATS;

/// Moving parameters of all Gaussians at one time; rows as in the field, raw form.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Centres, world.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithms of the standard deviations.
    pub log_scales: Vec<[f32; 3]>,
    /// (w, x, y, z), any norm.
    pub quaternions: Vec<[f32; 4]>,
    /// Logits of the opacities.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics in the axes of the world; empty where colours do not change.
    pub sh_coefficients: Vec<[f32; SH_FLOATS]>,
}

impl Frame {
    /// The moving part of Gaussians; their colours where these change too.
    #[must_use]
    pub fn of(gaussians: Gaussians, recolors: bool) -> Self {
        let Gaussians { means, log_scales, quaternions, opacity_logits, sh_coefficients, .. } = gaussians;
        let sh_coefficients = if recolors { sh_coefficients } else { Vec::new() };
        Self { means, log_scales, quaternions, opacity_logits, sh_coefficients }
    }

    /// Some rows, in their order, without colours.
    #[must_use]
    pub fn rows(&self, rows: &[u32]) -> Self {
        fn pick<T: Copy>(values: &[T], rows: &[u32]) -> Vec<T> {
            rows.iter().map(|&row| values[row as usize]).collect()
        }
        Self {
            means: pick(&self.means, rows),
            log_scales: pick(&self.log_scales, rows),
            quaternions: pick(&self.quaternions, rows),
            opacity_logits: pick(&self.opacity_logits, rows),
            sh_coefficients: Vec::new(),
        }
    }

    /// A Gaussian that the network throws out of the world at one time stays as at the reference time.
    fn keep_finite(&mut self, reference: &Self) {
        fn keep<const N: usize>(values: &mut [[f32; N]], reference: &[[f32; N]]) {
            for (value, reference) in values.iter_mut().zip(reference) {
                if !value.iter().all(|component| component.is_finite()) {
                    *value = *reference;
                }
            }
        }
        keep(&mut self.means, &reference.means);
        keep(&mut self.log_scales, &reference.log_scales);
        keep(&mut self.quaternions, &reference.quaternions);
        keep(&mut self.sh_coefficients, &reference.sh_coefficients);
        for (logit, reference) in self.opacity_logits.iter_mut().zip(&reference.opacity_logits) {
            if logit.is_nan() {
                *logit = *reference;
            }
        }
    }
}

/// Frames of all sampled times, finite wherever the first one is.
pub struct Frames<'a> {
    motion: &'a mut dyn MotionSource,
    times: &'a [f64],
    reference: Arc<Frame>,
    kept: Vec<Option<Arc<Frame>>>,
    most_kept: usize,
}

impl<'a> Frames<'a> {
    /// Frames at `times`; `reference` is the one at the first.
    #[must_use]
    pub fn new(motion: &'a mut dyn MotionSource, times: &'a [f64], reference: Frame) -> Self {
        let bytes = GAUSSIAN_BYTES + if motion.recolors() { COLOR_BYTES } else { 0 };
        let most_kept = KEPT_BYTES / (bytes * reference.means.len()).max(1);
        let reference = Arc::new(reference);
        let mut kept = vec![None; times.len()];
        if let Some(first) = kept.first_mut() {
            *first = Some(Arc::clone(&reference));
        }
        Self { motion, times, reference, kept, most_kept }
    }

    /// Number of sampled times.
    #[must_use]
    pub fn len(&self) -> usize {
        self.times.len()
    }

    /// True when there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.times.is_empty()
    }

    /// True when there is more than one time, and anything can move.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.times.len() > 1 && self.motion.moves()
    }

    /// True when there is more than one time, and any of these rows can move.
    #[must_use]
    pub fn move_rows(&self, rows: &[u32]) -> bool {
        self.times.len() > 1 && self.motion.moves_rows(rows)
    }

    /// True where opacities can change.
    #[must_use]
    pub fn fade(&self) -> bool {
        self.times.len() > 1 && self.motion.fades()
    }

    /// True where colours change too.
    #[must_use]
    pub fn recolor(&self) -> bool {
        self.moves() && self.motion.recolors()
    }

    /// The frame of a sampled time.
    pub fn at(&mut self, step: usize) -> Arc<Frame> {
        if let Some(frame) = &self.kept[step] {
            return Arc::clone(frame);
        }
        let recolors = self.motion.recolors();
        let mut frame = Frame::of(self.motion.gaussians_at(self.times[step]), recolors);
        frame.keep_finite(&self.reference);
        let frame = Arc::new(frame);
        if step < self.most_kept {
            self.kept[step] = Some(Arc::clone(&frame));
        }
        frame
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussians(at: f32) -> Gaussians {
        Gaussians {
            means: vec![[at; 3], [1.0; 3]],
            log_scales: vec![[0.0; 3]; 2],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.0; 2],
            ..Gaussians::default()
        }
    }

    #[test]
    fn every_time_is_asked_for_once() {
        let mut asked = Vec::new();
        let mut source = |time: f64| {
            asked.push(time);
            gaussians(time as f32)
        };
        let times = [0.0, 0.5, 1.0];
        let mut frames = Frames::new(&mut source, &times, Frame::of(gaussians(0.0), false));
        for step in [0, 1, 2, 1, 0, 2] {
            assert_eq!(frames.at(step).means[0], [times[step] as f32; 3]);
        }
        assert_eq!(asked, [0.5, 1.0]);
    }

    #[test]
    fn values_that_are_not_finite_stay_as_at_the_reference() {
        let mut source = |_: f64| {
            let mut moved = gaussians(7.0);
            moved.means[0][1] = f32::NAN;
            moved.log_scales[1][2] = f32::INFINITY;
            moved.opacity_logits[0] = f32::NAN;
            moved
        };
        let reference = gaussians(3.0);
        let mut frames = Frames::new(&mut source, &[0.0, 1.0], Frame::of(reference, false));
        let frame = frames.at(1);
        assert_eq!(frame.means, [[3.0; 3], [1.0; 3]]);
        assert_eq!(frame.log_scales[1], [0.0; 3]);
        assert_eq!(frame.opacity_logits[0], 0.0);
    }
}
