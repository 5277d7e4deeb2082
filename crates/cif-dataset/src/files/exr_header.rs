//! Headers of EXR files, checked before anything is allocated.

use std::path::Path;

use exr::meta::MetaData;

use crate::Error;

/// Larger images than this are refused before anything is allocated.
const MAX_PIXELS: u64 = 1 << 28;

/// No lossless compression packs more than this into a byte; a header that claims more is not believed.
const MAX_RATIO: u64 = 4096;

/// Reads the headers of all parts, and width and height of the display window, pixels.
///
/// # Errors
/// When the file is missing, damaged, no EXR, or claims more pixels than it can hold.
pub(crate) fn read(path: &Path) -> Result<(MetaData, (u32, u32)), Error> {
    let file_size = cif_input::check(path).map_err(Error::read(path))?;
    let meta = MetaData::read_from_file(path, false)
        .map_err(|error| Error::mask(path, format!("not a readable EXR file ({error}); export it again")))?;
    let Some(first) = meta.headers.first() else {
        return Err(Error::mask(path, "the EXR file has no part; export it again"));
    };
    let size = first.shared_attributes.display_window.size;
    let (mut bytes, mut widest) = (0_u64, size.x() as u64 * size.y() as u64);
    for header in &meta.headers {
        let pixels = header.layer_size.x() as u64 * header.layer_size.y() as u64;
        widest = widest.max(pixels);
        let sample: u64 =
            header.channels.list.iter().map(|channel| channel.sample_type.bytes_per_sample() as u64).sum();
        bytes = bytes.saturating_add(pixels.saturating_mul(sample));
    }
    if widest > MAX_PIXELS || bytes > file_size.saturating_mul(MAX_RATIO) {
        return Err(Error::mask(
            path,
            format!(
                "its header claims {} x {} pixels, more than the {file_size} bytes of the file can hold",
                size.x(),
                size.y()
            ),
        ));
    }
    Ok((meta, (size.x() as u32, size.y() as u32)))
}
