//! Belief of the pixels of a frame: their classes and how sure they are.

use rayon::prelude::*;

/// Probability of every class at every pixel, and how well motion accounts for it.
#[derive(Clone)]
pub(crate) struct Belief {
    /// Classes, of which 0 is unlabelled.
    pub(crate) classes: usize,
    /// `[pixels][classes]`, each pixel summing to 1.
    pub(crate) shares: Vec<f32>,
    /// `[pixels]`, 0 to 1: product over the steps since the keyframe of how well forward and backward flow agree.
    pub(crate) reliability: Vec<f32>,
    /// `[classes]`: true where the keyframe that it comes from shows the class.
    pub(crate) shown: Vec<bool>,
}

impl Belief {
    /// Belief in one class per pixel, as far as known; the rest is shared by all classes.
    pub(crate) fn in_classes(classes: usize, of_pixel: &[u16], reliability: Vec<f32>) -> Self {
        let mut shares = Vec::with_capacity(of_pixel.len() * classes);
        let mut shown = vec![false; classes];
        for (class, sure) in of_pixel.iter().zip(&reliability) {
            shown[usize::from(*class)] = true;
            let start = shares.len();
            shares.extend(std::iter::repeat_n((1.0 - sure) / classes as f32, classes));
            shares[start + usize::from(*class)] += sure;
        }
        Self { classes, shares, reliability, shown }
    }
}

/// Classes that are kept of a pixel.
const KEPT: usize = 3;

/// A belief in few bytes: the most probable classes of every pixel.
pub(crate) struct Stored {
    shown: Vec<bool>,
    pixels: Vec<StoredPixel>,
}

#[derive(Clone, Copy)]
struct StoredPixel {
    class: [u16; KEPT],
    share: [u8; KEPT],
    reliability: u8,
}

impl Stored {
    /// Bytes of a pixel.
    pub(crate) const BYTES_PER_PIXEL: usize = size_of::<StoredPixel>();

    pub(crate) fn new(belief: &Belief) -> Self {
        let pixels = belief.shares.par_chunks(belief.classes).zip(&belief.reliability);
        let store = |(shares, reliability): (&[f32], &f32)| {
            let mut kept =
                StoredPixel { class: [0; KEPT], share: [0; KEPT], reliability: byte(*reliability) };
            for (class, share) in shares.iter().enumerate() {
                let share = byte(*share);
                if let Some(place) = kept.share.iter().position(|other| share > *other) {
                    kept.share.copy_within(place..KEPT - 1, place + 1);
                    kept.class.copy_within(place..KEPT - 1, place + 1);
                    (kept.share[place], kept.class[place]) = (share, class as u16);
                }
            }
            kept
        };
        Self { shown: belief.shown.clone(), pixels: pixels.map(store).collect() }
    }

    pub(crate) fn restored(&self) -> Belief {
        let classes = self.shown.len();
        let mut shares = vec![0.0_f32; self.pixels.len() * classes];
        shares.par_chunks_mut(classes).zip(&self.pixels).for_each(|(shares, stored)| {
            let sum: f32 = stored.share.iter().map(|share| f32::from(*share)).sum();
            for (class, share) in stored.class.iter().zip(stored.share) {
                shares[usize::from(*class)] += f32::from(share) / sum.max(1.0);
            }
        });
        let reliability = self.pixels.iter().map(|pixel| f32::from(pixel.reliability) / 255.0).collect();
        Belief { classes, shares, reliability, shown: self.shown.clone() }
    }
}

fn byte(value: f32) -> u8 {
    (value * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_probable_classes_are_kept() {
        let belief = Belief {
            classes: 5,
            shares: vec![0.1, 0.4, 0.05, 0.2, 0.25, 0.0, 0.0, 1.0, 0.0, 0.0],
            reliability: vec![0.5, 1.0],
            shown: vec![true, true, true, true, false],
        };
        let restored = Stored::new(&belief).restored();
        let expected = [0.0, 0.4 / 0.85, 0.0, 0.2 / 0.85, 0.25 / 0.85, 0.0, 0.0, 1.0, 0.0, 0.0];
        for (found, expected) in restored.shares.iter().zip(expected) {
            assert!((found - expected).abs() < 0.01, "{:?}", restored.shares);
        }
        assert!((restored.reliability[0] - 0.5).abs() < 0.01 && restored.reliability[1] == 1.0);
    }
}
