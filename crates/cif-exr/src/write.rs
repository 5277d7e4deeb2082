//! Writer of EXR files: whole or not at all, rows as they come.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use cif_output::NewFile;
use exr::block::writer::{ChunkWriter, ChunksWriter, SequentialBlocksCompressor};
use exr::block::{BlockIndex, UncompressedBlock};
use exr::meta::BlockDescription;
use exr::meta::attribute::ChannelDescription;
use exr::meta::header::Header;
use exr::prelude::{AttributeValue, Compression, FlatSamples, LayerAttributes, LineOrder, Text, Vec2};

use crate::layers::{attributes, channels, samples};
use crate::{ExrError, Frame, Rows};

/// Rows of a block: files are compressed in blocks of so many scan lines.
pub const BLOCK_ROWS: u32 = 16;

/// Takes the rows of a frame, from top to bottom.
pub struct FrameWriter<'a, 'f> {
    path: &'a Path,
    frame: &'a Frame<'a>,
    /// Positions of the channels in the order of the file, which is that of their names.
    order: &'a [usize],
    blocks: SequentialBlocksCompressor<'a, ChunkWriter<BufWriter<&'f File>>>,
}

impl FrameWriter<'_, '_> {
    /// Writes rows.
    ///
    /// # Errors
    /// When the file system refuses.
    ///
    /// # Panics
    /// When the rows do not begin with a block ([`BLOCK_ROWS`]), end within one before the frame does, have another
    /// width, or lack the depth or the instances that the frame has.
    pub fn write(&mut self, rows: &Rows<'_>) -> Result<(), ExrError> {
        let (width, height) = (self.frame.width, rows.image.alpha.height);
        assert_eq!(rows.image.alpha.width, width, "width of the frame");
        let end = rows.first_row + height;
        let is_whole = |row: u32| row.is_multiple_of(BLOCK_ROWS);
        assert!(
            is_whole(rows.first_row) && (is_whole(end) || end == self.frame.height),
            "rows of whole blocks"
        );
        for first in (0..height).step_by(BLOCK_ROWS as usize) {
            let lines = BLOCK_ROWS.min(height - first);
            let pixels = (first * width) as usize..((first + lines) * width) as usize;
            let samples = samples(self.frame, rows, pixels);
            let first = rows.first_row + first;
            let index = BlockIndex {
                layer: 0,
                pixel_position: Vec2(0, first as usize),
                pixel_size: Vec2(width as usize, lines as usize),
                level: Vec2(0, 0),
            };
            let data = block(&samples, self.order, width as usize, lines as usize);
            self.blocks
                .compress_block((first / BLOCK_ROWS) as usize, UncompressedBlock { index, data })
                .map_err(|error| encode(self.path, &error))?;
        }
        Ok(())
    }
}

/// Bytes of a block: line by line, and the channels of a line one after the other.
fn block(samples: &[FlatSamples], order: &[usize], width: usize, lines: usize) -> Vec<u8> {
    let mut data = Vec::with_capacity(size_of::<f32>() * samples.len() * width * lines);
    for line in 0..lines {
        let pixels = line * width..(line + 1) * width;
        for &channel in order {
            match &samples[channel] {
                FlatSamples::F32(values) => {
                    data.extend(values[pixels.clone()].iter().flat_map(|value| value.to_ne_bytes()));
                }
                FlatSamples::U32(values) => {
                    data.extend(values[pixels.clone()].iter().flat_map(|value| value.to_ne_bytes()));
                }
                FlatSamples::F16(_) => unreachable!("all channels have 32 bits"),
            }
        }
    }
    data
}

/// Writes a frame to a temporary file in the same folder, then renames it; an existing file is replaced. `draw` hands
/// all rows to the writer, from top to bottom: memory is that of what it hands over.
///
/// # Errors
/// Those of `draw`; when two objects have the same Cryptomatte id, or the file system refuses; nothing existing is
/// touched then.
pub fn write<E: From<ExrError>>(
    path: &Path,
    frame: &Frame<'_>,
    draw: impl FnOnce(&mut FrameWriter<'_, '_>) -> Result<(), E>,
) -> Result<(), E> {
    let refused = |source: std::io::Error| ExrError::Write { path: path.to_owned(), source };
    let channels = channels(frame);
    let mut order: Vec<usize> = (0..channels.len()).collect();
    order.sort_by_key(|channel| &channels[*channel].0);
    let header = header(frame, order.iter().map(|channel| &channels[*channel]))?;
    let new = NewFile::create(path).map_err(refused)?;
    let mut drawn = Ok(());
    let written = exr::block::write(
        BufWriter::new(new.file()),
        std::iter::once(header).collect(),
        true,
        |meta, chunks| {
            let blocks = chunks.sequential_blocks_compressor(&meta);
            drawn = draw(&mut FrameWriter { path, frame, order: &order, blocks });
            if drawn.is_ok() { Ok(()) } else { Err(exr::error::Error::Aborted) }
        },
    );
    drawn?;
    written.map_err(|error| encode(path, &error))?;
    new.finish().map_err(refused)?;
    Ok(())
}

fn encode(path: &Path, error: &exr::error::Error) -> ExrError {
    ExrError::Encode { path: path.to_owned(), reason: error.to_string() }
}

/// The header: no loss, as Cryptomatte demands, and blocks of scan lines, as compositors read them.
fn header<'a>(
    frame: &Frame<'_>,
    channels: impl Iterator<Item = &'a crate::layers::Channel>,
) -> Result<Header, ExrError> {
    // UTF-8 as it is: names of objects need not be ASCII.
    let text = |text: &str| Text::from_slice_unchecked(text.as_bytes());
    let mut own = LayerAttributes {
        layer_name: None,
        software_name: Some(text(concat!("cif ", env!("CARGO_PKG_VERSION")))),
        ..LayerAttributes::default()
    };
    for (name, value) in attributes(frame)? {
        own.other.insert(text(&name), AttributeValue::Text(text(&value)));
    }
    // Linear light or not, samples are numbers to be kept as they are.
    let channels = channels.map(|(name, kind)| ChannelDescription::new(text(name), *kind, false));
    let size = Vec2(frame.width as usize, frame.height as usize);
    Ok(Header::new(Text::default(), size, channels.collect())
        .with_encoding(Compression::ZIP16, BlockDescription::ScanLines, LineOrder::Increasing)
        .with_attributes(own))
}
