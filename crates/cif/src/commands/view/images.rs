//! Images and masks of a capture as the page asks for them.

use cif_dataset::Dataset;

use crate::error::Error;
use crate::pictures::{instance_color, png_bytes, png_bytes_rgba};

/// Opacity of a mask over its image.
const MASK: u8 = 150;

/// Images of a capture, decoded when they are asked for.
pub(super) struct Images(Dataset);

impl Images {
    pub(super) fn of(dataset: Dataset) -> Self {
        Self(dataset)
    }

    /// The image or mask at an address of a view, as PNG; `None` for addresses of none.
    pub(super) fn at(&self, address: &str) -> Option<Result<Vec<u8>, Error>> {
        let (kind, name) = address.split_once('/')?;
        let index: usize = name.strip_suffix(".png")?.parse().ok()?;
        let frame = self.0.frames.get(index)?;
        match kind {
            "images" => Some(self.image(index)),
            "masks" if frame.mask.is_some() => Some(self.mask(index)),
            _ => None,
        }
    }

    fn image(&self, index: usize) -> Result<Vec<u8>, Error> {
        png_bytes(&self.0.load_image(index, [1.0; 3]).map_err(Error::plain)?)
    }

    fn mask(&self, index: usize) -> Result<Vec<u8>, Error> {
        let mask = self.0.load_mask(index).map_err(Error::plain)?;
        let mask = mask.ok_or_else(|| Error::plain("the frame has no mask"))?;
        png_bytes_rgba(&mask.map(|id| match *id {
            0 => [0; 4],
            id => {
                let [red, green, blue] = instance_color(id);
                [red, green, blue, MASK]
            }
        }))
    }
}
