//! How a file is written: whole or not at all.

use std::io::BufWriter;
use std::path::Path;

use cif_output::NewFile;
use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Blocks, Compression, Encoding, Image, ImageAttributes,
    IntegerBounds, Layer, LayerAttributes, LineOrder, Text, Vec2, WritableImage,
};

use crate::layers::{attributes, channels};
use crate::{ExrError, Frame};

/// No loss, as Cryptomatte demands, and blocks of scan lines, as compositors read them.
const ENCODING: Encoding = Encoding {
    compression: Compression::ZIP16,
    blocks: Blocks::ScanLines,
    line_order: LineOrder::Increasing,
};

/// Writes a frame to a temporary file in the same folder, then renames it; an existing file is replaced.
///
/// # Errors
/// When two objects have the same Cryptomatte id, or the file system refuses; nothing existing is touched then.
pub fn write(path: &Path, frame: &Frame<'_>) -> Result<(), ExrError> {
    let refused = |source: std::io::Error| ExrError::Write { path: path.to_owned(), source };
    let size = Vec2(frame.image.color.width as usize, frame.image.color.height as usize);
    // UTF-8 as it is: names of objects need not be ASCII.
    let text = |text: &str| Text::from_slice_unchecked(text.as_bytes());
    let mut header = LayerAttributes {
        layer_name: None,
        software_name: Some(text(concat!("cif ", env!("CARGO_PKG_VERSION")))),
        ..LayerAttributes::default()
    };
    for (name, value) in attributes(frame)? {
        header.other.insert(text(&name), AttributeValue::Text(text(&value)));
    }
    let channels = channels(frame)
        .into_iter()
        .map(|(name, samples)| {
            // Linear light or not, samples are numbers to be kept as they are.
            AnyChannel {
                name: text(&name),
                sample_data: samples,
                quantize_linearly: false,
                sampling: Vec2(1, 1),
            }
        })
        .collect();
    let layer = Layer::new(size, header, ENCODING, AnyChannels::sort(channels));
    let image =
        Image { attributes: ImageAttributes::new(IntegerBounds::from_dimensions(size)), layer_data: layer };
    let new = NewFile::create(path).map_err(refused)?;
    image
        .write()
        .to_buffered(BufWriter::new(new.file()))
        .map_err(|error| ExrError::Encode { path: path.to_owned(), reason: error.to_string() })?;
    new.finish().map_err(refused)
}
