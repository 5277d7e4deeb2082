//! EXR files: single-part or multi-part, with any lossless compression. Headers are checked before anything is allocated.

use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;
use exr::meta::MetaData;
use exr::prelude::{AttributeValue, FlatImage, FlatSamples, ReadChannels, ReadLayers, Text};

use crate::Error;

/// Larger images than this are refused before anything is allocated.
const MAX_PIXELS: u64 = 1 << 28;

/// No lossless compression packs more than this into a byte; a header that claims more is not believed.
const MAX_RATIO: u64 = 4096;

/// Headers of all parts of a file, which claim no more pixels than it can hold.
pub(crate) struct Headers {
    path: PathBuf,
    meta: MetaData,
    /// Width and height of the display window, pixels.
    pub(crate) size: (u32, u32),
}

impl Headers {
    /// Reads the headers.
    ///
    /// # Errors
    /// When the file is missing, damaged, no EXR, or claims more pixels than it can hold.
    pub(crate) fn read(path: &Path) -> Result<Self, Error> {
        let file_size = cif_input::check(path).map_err(Error::read(path))?;
        let meta = MetaData::read_from_file(path, false).map_err(|error| {
            Error::mask(path, format!("not a readable EXR file ({error}); export it again"))
        })?;
        let Some(first) = meta.headers.first() else {
            return Err(Error::mask(path, "the EXR file has no part; export it again"));
        };
        let size = first.shared_attributes.display_window.size;
        let (mut bytes, mut widest) = (0_u64, size.x() as u64 * size.y() as u64);
        for header in &meta.headers {
            let pixels = header.layer_size.x() as u64 * header.layer_size.y() as u64;
            widest = widest.max(pixels);
            let sample: u64 = header
                .channels
                .list
                .iter()
                .map(|channel| channel.sample_type.bytes_per_sample() as u64)
                .sum();
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
        Ok(Self { path: path.to_owned(), size: (size.x() as u32, size.y() as u32), meta })
    }

    /// Attributes that the format does not know, by name, of all parts.
    pub(crate) fn attributes(&self) -> impl Iterator<Item = (String, &AttributeValue)> {
        self.meta
            .headers
            .iter()
            .flat_map(|header| [&header.own_attributes.other, &header.shared_attributes.other])
            .flatten()
            .map(|(name, value)| (name.to_string(), value))
    }

    /// Channels of all parts, as (name of the part, name of the channel).
    pub(crate) fn channels(&self) -> impl Iterator<Item = (Option<String>, String)> {
        self.meta.headers.iter().flat_map(|header| {
            let part = header.own_attributes.layer_name.as_ref().map(Text::to_string);
            header.channels.list.iter().map(move |channel| (part.clone(), channel.name.to_string()))
        })
    }

    /// Decodes the channels of all parts.
    ///
    /// # Errors
    /// When the file is damaged or truncated.
    pub(crate) fn decode(self) -> Result<Decoded, Error> {
        let Self { path, meta, size } = self;
        drop(meta);
        let image = exr::prelude::read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .all_layers()
            .all_attributes()
            .non_parallel()
            .from_file(&path)
            .map_err(|error| {
                Error::mask(&path, format!("it cannot be decoded ({error}); export it again"))
            })?;
        Ok(Decoded { image, size })
    }
}

/// A decoded file.
pub(crate) struct Decoded {
    image: FlatImage,
    size: (u32, u32),
}

impl Decoded {
    /// Channels of all parts.
    pub(crate) fn channels(&self) -> impl Iterator<Item = Channel<'_>> {
        let window = self.image.attributes.display_window.position;
        self.image.layer_data.iter().flat_map(move |layer| {
            let offset = layer.attributes.layer_position - window;
            layer.channel_data.list.iter().map(move |channel| Channel {
                part: layer.attributes.layer_name.as_ref().map(Text::to_string),
                name: channel.name.to_string(),
                samples: &channel.sample_data,
                columns: layer.size.x().max(1),
                offset: (i64::from(offset.x()), i64::from(offset.y())),
                size: self.size,
            })
        })
    }
}

/// A decoded channel.
pub(crate) struct Channel<'a> {
    /// Name of its part.
    pub(crate) part: Option<String>,
    /// Name in its part.
    pub(crate) name: String,
    /// Samples of the data window, row by row.
    pub(crate) samples: &'a FlatSamples,
    /// Width of the data window, pixels.
    columns: usize,
    /// Upper left corner of the data window in the display window, pixels.
    offset: (i64, i64),
    /// Width and height of the display window, pixels.
    size: (u32, u32),
}

impl Channel<'_> {
    /// Values of the samples at their pixels of the display window; `outside` where the data window has none.
    pub(crate) fn plane<T: Clone>(&self, values: impl Iterator<Item = T>, outside: T) -> PixelGrid<T> {
        let (width, height) = self.size;
        let mut plane = PixelGrid::filled(width, height, outside);
        for (at, value) in values.enumerate() {
            let x = (at % self.columns) as i64 + self.offset.0;
            let y = (at / self.columns) as i64 + self.offset.1;
            if (0..i64::from(width)).contains(&x) && (0..i64::from(height)).contains(&y) {
                plane.pixels[(y * i64::from(width) + x) as usize] = value;
            }
        }
        plane
    }
}
