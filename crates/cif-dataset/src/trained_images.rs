//! Images that a scene was trained on, so that what goes on from its Gaussians notices images that have changed.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::files::image;
use crate::made_from::{MadeFrom, image_of};
use crate::{Dataset, Split};

/// Images that a scene was trained on: content and sizes.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct TrainedImages {
    /// Widths and heights as stored, pixels. Images of other sizes are another resolution of the same capture.
    sizes: BTreeSet<[u32; 2]>,
    content: MadeFrom,
}

impl TrainedImages {
    /// The images of the training frames of a capture, which `inputs` holds.
    #[must_use]
    pub fn of(dataset: &Dataset, inputs: &MadeFrom) -> Self {
        let trained = || dataset.frames.iter().filter(|frame| frame.split == Split::Train);
        let names: BTreeSet<String> = trained().map(image_of).collect();
        // Whoever loads an image that cannot be read refuses it.
        let sizes = trained().filter_map(|frame| image::probe(&frame.image).ok());
        Self {
            sizes: sizes.map(|header| [header.width, header.height]).collect(),
            content: inputs.only(|name| names.contains(name)),
        }
    }

    /// The difference from `now`, as [`MadeFrom::difference`] has it; `None` where all are the same, or stored at another
    /// resolution.
    #[must_use]
    pub fn difference(&self, now: &Self) -> Option<String> {
        if self.sizes != now.sizes {
            return None;
        }
        self.content.difference(&now.content)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{OpenOptions, PointSource};

    #[test]
    fn images_that_changed_are_named_and_other_resolutions_are_not() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, size: u32, value: u8| {
            let picture = ::image::GrayImage::from_pixel(size, size, ::image::Luma([value]));
            picture.save(folder.path().join(name)).unwrap();
        };
        let frame = |name: &str, at: f64| {
            serde_json::json!({
                "file_path": name,
                "transform_matrix":
                    [[1.0, 0.0, 0.0, at], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
            })
        };
        let transforms = serde_json::json!({
            "fl_x": 8.0, "w": 8, "h": 8, "frames": [frame("a.png", 0.0), frame("b.png", 0.1)],
        });
        std::fs::write(folder.path().join("transforms.json"), transforms.to_string()).unwrap();
        let now = || {
            let dataset = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
            assert_eq!(dataset.points.source, PointSource::Random);
            TrainedImages::of(&dataset, &MadeFrom::new().capture(&dataset, None).by_content())
        };
        write("a.png", 8, 1);
        write("b.png", 8, 2);
        let before = now();
        let text = serde_json::to_string(&before).unwrap();
        let before: TrainedImages = serde_json::from_str(&text).unwrap();
        assert_eq!(before.difference(&now()), None);
        write("b.png", 8, 3);
        assert_eq!(before.difference(&now()).unwrap(), "the image of frame b has changed");
        write("a.png", 16, 1);
        write("b.png", 16, 2);
        assert_eq!(before.difference(&now()), None, "another resolution");
    }
}
