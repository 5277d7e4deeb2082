//! Masks of boxes: SAM.
//!
//! Source: `SamPredictor` of Segment Anything. The picture's long side becomes 1 024 pixels and its rest is padded; a
//! box goes in as its two corners, points with the labels 2 and 3, or as it is where the decoder has an input for
//! boxes. Of the masks that come out the one with the highest predicted IoU counts, where its logit is above 0: exports
//! differ in which of the four masks of the model they give, and where it is one alone, as Gaussian Grouping asks for it,
//! that is taken.

use std::path::Path;

use cif_geometry::PixelGrid;

use crate::models::Models;
use crate::picture::{self, Filter, IMAGENET};
use crate::runtime::{Part, Session};
use crate::{Error, Picture, Tensor};

/// Side of the pictures that the encoder takes, pixels.
const SIDE: u32 = 1024;
/// Side of the masks that the decoder may start from, where the model does not say.
const PREVIOUS: usize = 256;
/// Largest side that is taken at its word: those of pictures. Another one does not fit then, and is refused.
const MOST_PREVIOUS: usize = 4 * SIDE as usize;
/// Labels of a box's first and second corner.
const CORNERS: [i64; 2] = [2, 3];

/// Parts of the decoder that we fill in; all others are outputs of the encoder.
const DECODER: [Part<'static>; 7] = [
    Part::needed("embeddings", &[]),
    Part::known("points", &[3, 4]),
    Part::known("labels", &[2, 3]),
    Part::known("boxes", &[2, 3]),
    Part::known("previous", &[4]),
    Part::known("has_previous", &[1]),
    Part::known("size", &[1]),
];
const OUTPUTS: [Part<'static>; 2] = [Part::needed("masks", &[3, 4, 5]), Part::known("scores", &[])];

/// Encoder and decoder of a folder of models.
#[derive(Debug)]
pub struct Segmenter {
    encoder: Session,
    decoder: Session,
}

impl Segmenter {
    /// Opens both models.
    ///
    /// # Errors
    /// When the folder has no segmenter, or one whose tensors do not fit.
    pub fn open(library: &Path, models: &Models) -> Result<Self, Error> {
        let (encoder, decoder) = models.segmenter()?;
        let others = encoder.outputs.keys().filter(|part| *part != "embeddings");
        let mut features = vec![Part::needed("embeddings", &[])];
        features.extend(others.map(|part| Part::known(part, &[])));
        let mut inputs = DECODER.to_vec();
        inputs.extend(&features[1..]);
        let opened = Self {
            encoder: Session::open(library, encoder, &[Part::needed("image", &[4])], &features)?,
            decoder: Session::open(library, decoder, &inputs, &OUTPUTS)?,
        };
        let takes = |part| opened.decoder.has_input(part);
        if !(takes("boxes") || takes("points") && takes("labels")) {
            return Err(Error::refused(
                format!(
                    "{} is prompted by no box: neither `boxes` nor `points` and `labels` are named",
                    decoder.model.display()
                ),
                "name them in models.toml; the decoder has to take boxes, or points with the labels 2 and 3",
            ));
        }
        Ok(opened)
    }

    /// Pixels of a picture that lie in the mask of any box; boxes are left, top, right, bottom in pixels.
    ///
    /// # Errors
    /// When a model fails, or gives masks of another shape.
    pub fn mask(&mut self, picture: &Picture, boxes: &[[f32; 4]]) -> Result<PixelGrid<bool>, Error> {
        let mut union = PixelGrid::filled(picture.width, picture.height, false);
        if boxes.is_empty() {
            return Ok(union);
        }
        let size = picture::long_side((picture.width, picture.height), SIDE);
        let resized = picture::resize(picture, size, Filter::Bilinear);
        let features =
            self.encoder.run(vec![("image", picture::tensor(&resized, IMAGENET, (SIDE, SIDE)))])?;
        let scale = [size.0 as f32 / picture.width as f32, size.1 as f32 / picture.height as f32];
        for corners in boxes {
            let scaled: Vec<f32> = (0..4).map(|k| corners[k] * scale[k % 2]).collect();
            let mut inputs: Vec<(&str, Tensor)> = features
                .iter()
                .filter(|(part, _)| self.decoder.has_input(part))
                .map(|(part, tensor)| (part.as_str(), tensor.clone()))
                .collect();
            inputs.extend(self.prompts(scaled, (picture.width, picture.height)));
            let outputs = self.decoder.run(inputs)?;
            let logits = best(&outputs["masks"], outputs.get("scores"));
            let logits = logits.map_err(|problem| self.decoder.refuse("masks", &problem))?;
            let logits = if self.decoder.has_input("size") {
                logits
            } else {
                let wide = bilinear(&logits, (logits.width, logits.height), (SIDE, SIDE));
                bilinear(&wide, size, (picture.width, picture.height))
            };
            if (logits.width, logits.height) != (picture.width, picture.height) {
                let problem = format!(
                    "masks of {} x {} pixels came out for a picture of {} x {}",
                    logits.width, logits.height, picture.width, picture.height
                );
                return Err(self.decoder.refuse("masks", &problem));
            }
            for (inside, logit) in union.pixels.iter_mut().zip(&logits.pixels) {
                *inside |= *logit > 0.0;
            }
        }
        Ok(union)
    }

    /// Inputs that give the decoder a box, as far as it has them.
    fn prompts(&self, corners: Vec<f32>, (width, height): (u32, u32)) -> Vec<(&'static str, Tensor)> {
        let decoder = &self.decoder;
        let has_box = decoder.has_input("boxes");
        let rank = |part| decoder.input_shape(part).len();
        let side = |axis: usize| {
            let stated = decoder.input_shape("previous").get(axis).copied().flatten();
            stated.filter(|side| *side <= MOST_PREVIOUS).unwrap_or(PREVIOUS)
        };
        let mut prompts = Vec::new();
        if has_box {
            prompts.push(("boxes", Tensor::floats([1, 4], corners).with_rank(rank("boxes"))));
        } else {
            prompts.push(("points", Tensor::floats([1, 2, 2], corners).with_rank(rank("points"))));
            prompts.push(("labels", Tensor::integers([1, 2], CORNERS.to_vec()).with_rank(rank("labels"))));
        }
        if decoder.has_input("previous") {
            let shape = [1, 1, side(2), side(3)];
            prompts.push(("previous", Tensor::floats(shape, vec![0.0; shape[2] * shape[3]])));
        }
        if decoder.has_input("has_previous") {
            prompts.push(("has_previous", Tensor::integers([1], vec![0])));
        }
        if decoder.has_input("size") {
            prompts.push(("size", Tensor::integers([2], vec![i64::from(height), i64::from(width)])));
        }
        prompts
    }
}

/// Logits of the mask with the highest predicted IoU; of the first where none are predicted.
///
/// # Errors
/// When there is no mask, or another number of scores.
fn best(masks: &Tensor, scores: Option<&Tensor>) -> Result<PixelGrid<f32>, String> {
    let shape = masks.shape();
    let &[ref batch @ .., height, width] = shape else {
        return Err(format!("{shape:?} came out, where pictures, [.., height, width], are expected"));
    };
    let count: usize = batch.iter().product();
    let area = height * width;
    let scores = scores.and_then(Tensor::as_floats);
    let fits = count > 0 && area > 0 && scores.is_none_or(|scores| scores.len() == count);
    let (Some(values), true) = (masks.as_floats(), fits) else {
        return Err(format!("{shape:?} came out, with {:?} scores", scores.map(<[f32]>::len)));
    };
    let best = scores.map_or(0, highest);
    Ok(PixelGrid::from_pixels(width as u32, height as u32, values[best * area..][..area].to_vec()))
}

/// Index of the highest of some numbers, the first of several.
fn highest(scores: &[f32]) -> usize {
    (1..scores.len()).fold(0, |best, at| if scores[at] > scores[best] { at } else { best })
}

/// The top left `part` of a grid, stretched to another size: linear between the centres of pixels, as
/// `torch.nn.functional.interpolate` without `align_corners`.
fn bilinear(grid: &PixelGrid<f32>, part: (u32, u32), to: (u32, u32)) -> PixelGrid<f32> {
    /// Neighbours of every pixel along an axis, and the share of the second.
    fn along(from: u32, to: u32) -> Vec<(u32, u32, f32)> {
        let scale = from as f32 / to as f32;
        let of_pixel = |at: u32| {
            let place = ((at as f32 + 0.5) * scale - 0.5).max(0.0);
            let first = (place as u32).min(from - 1);
            (first, (first + 1).min(from - 1), place - first as f32)
        };
        (0..to).map(of_pixel).collect()
    }
    let (columns, rows) = (along(part.0, to.0), along(part.1, to.1));
    let mut pixels = Vec::with_capacity(columns.len() * rows.len());
    for (top, bottom, down) in rows {
        for (left, right, across) in &columns {
            let row = |row: u32| grid.at(*left, row) * (1.0 - across) + grid.at(*right, row) * across;
            pixels.push(row(top) * (1.0 - down) + row(bottom) * down);
        }
    }
    PixelGrid::from_pixels(to.0, to.1, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_stretched_as_by_torch() {
        // torch.nn.functional.interpolate(torch.tensor([[[[0., 1.], [2., 4.]]]]), (4, 4), mode="bilinear")
        let grid = PixelGrid::from_pixels(2, 2, vec![0.0, 1.0, 2.0, 4.0]);
        let expected = [
            [0.0, 0.25, 0.75, 1.0],
            [0.5, 0.8125, 1.4375, 1.75],
            [1.5, 1.9375, 2.8125, 3.25],
            [2.0, 2.5, 3.5, 4.0],
        ];
        assert_eq!(bilinear(&grid, (2, 2), (4, 4)).pixels, expected.concat());
        // A part of it, and smaller: without smoothing.
        assert_eq!(bilinear(&grid, (1, 2), (2, 4)).pixels, [0.0, 0.0, 0.5, 0.5, 1.5, 1.5, 2.0, 2.0]);
        let wide = PixelGrid::from_pixels(4, 1, vec![0.0, 2.0, 4.0, 8.0]);
        assert_eq!(bilinear(&wide, (4, 1), (2, 1)).pixels, [1.0, 6.0]);
    }

    #[test]
    fn what_is_no_picture_is_refused() {
        let masks = |shape: &[usize]| Tensor::floats(shape, vec![0.5; shape.iter().product()]);
        for shape in [&[][..], &[4], &[0, 2, 2], &[2, 0, 2]] {
            assert!(
                best(&masks(shape), None).unwrap_err().contains(&format!("{shape:?} came out")),
                "{shape:?}"
            );
        }
        assert!(best(&masks(&[2, 1, 1]), Some(&masks(&[3]))).is_err());
        assert_eq!(best(&masks(&[3, 2]), None).unwrap(), PixelGrid::filled(2, 3, 0.5));
    }

    #[test]
    fn the_first_of_the_highest_counts() {
        assert_eq!(highest(&[0.5, 0.9, 0.9, 0.1]), 1);
        assert_eq!(highest(&[f32::NAN, 0.1]), 0);
        assert_eq!(highest(&[0.3]), 0);
    }
}
