//! Colours for points whose source has none.

use glam::DVec3;

use super::GREY;
use crate::{Dataset, Error};

/// Training frames that are looked at.
const FRAMES: usize = 8;

/// Mean colour of the pixels onto which each point projects, over up to eight training frames spread evenly
/// over the capture; occlusion is not considered. Grey where no frame shows the point.
///
/// # Errors
/// When an image cannot be decoded.
pub(crate) fn sample_colors(dataset: &Dataset, positions: &[[f32; 3]]) -> Result<Vec<[u8; 3]>, Error> {
    let train = dataset.train_frames();
    let count = train.len().min(FRAMES);
    let mut sums = vec![([0_u32; 3], 0_u32); positions.len()];
    for k in 0..count {
        let index = train[k * train.len() / count];
        let camera = &dataset.frames[index].camera;
        let image = dataset.load_image(index, [0.5; 3])?;
        for (position, (sum, seen)) in positions.iter().zip(&mut sums) {
            let point = DVec3::from_array(position.map(f64::from));
            if let Some([x, y]) = camera.pixel_of(point) {
                let color = image.at(x, y);
                for c in 0..3 {
                    sum[c] += u32::from(color[c]);
                }
                *seen += 1;
            }
        }
    }
    Ok(sums
        .iter()
        .map(|(sum, seen)| if *seen == 0 { GREY } else { sum.map(|v| ((v + seen / 2) / seen) as u8) })
        .collect())
}
