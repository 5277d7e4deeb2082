//! Which channels a file has.

use std::ops::Range;

use cif_dataset::cryptomatte::{CONVERSION, HASH, layer_key};
use cif_geometry::PixelGrid;
use cif_render::{InstanceRanks, RenderedImage};
use exr::meta::attribute::SampleType;
use exr::prelude::FlatSamples;

use crate::color::{ColorEncoding, premultiplied};
use crate::object::Object;
use crate::{ExrError, cryptomatte};

/// Depth where nothing is, as Blender has it: farther than anything.
pub const NO_DEPTH: f32 = 1e10;

/// Description of a file apart from its pixels: name, time, size, units, background and objects of the frame.
#[derive(Clone, Debug)]
pub struct Frame<'a> {
    /// Name of the frame.
    pub name: &'a str,
    /// Normalised time of the frame.
    pub time: f64,
    /// Columns, pixels.
    pub width: u32,
    /// Rows, pixels.
    pub height: u32,
    /// World units per unit of the picture's depths: 1 but for captures in units far from metres.
    pub world_per_unit: f64,
    /// Colour that the picture lies on, display-referred.
    pub background: [f32; 3],
    /// Instances of the scene; `None` in a scene without.
    pub objects: Option<&'a [Object]>,
    /// Name of the next frame; `None` behind the last, where nothing moves.
    pub next: Option<&'a str>,
    /// Colours of the file.
    pub encoding: ColorEncoding,
}

/// Rows of a frame, over its full width.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    /// Row of the frame that is the first here.
    pub first_row: u32,
    /// The picture, with depth, and with instances where the frame has objects.
    pub image: &'a RenderedImage,
    /// Foremost instances of every pixel, at least [`cryptomatte::RANKS`], where the frame has objects.
    pub ranks: Option<&'a InstanceRanks>,
    /// Motion to the next frame, pixels, x right and y down; 0 where nothing is.
    pub motion: &'a PixelGrid<[f32; 2]>,
}

/// A channel's name and kind of samples.
pub(crate) type Channel = (String, SampleType);

/// All channels of a frame.
pub(crate) fn channels(frame: &Frame<'_>) -> Vec<Channel> {
    let mut channels: Vec<Channel> = ["R", "G", "B", "A", "Z", "forward.u", "forward.v"]
        .into_iter()
        .map(|name| (name.to_owned(), SampleType::F32))
        .collect();
    if frame.objects.is_some() {
        channels.push(("instance.id".to_owned(), SampleType::U32));
        for name in ["coverage.V", "foreground.V", "probability.V", "entropy.V"] {
            channels.push((name.to_owned(), SampleType::F32));
        }
        for rank in 0..cryptomatte::RANKS {
            for component in if rank % 2 == 0 { ["R", "G"] } else { ["B", "A"] } {
                let name = format!("{}{:02}.{component}", cryptomatte::LAYER, rank / 2);
                channels.push((name, SampleType::F32));
            }
        }
    }
    channels
}

/// Samples of all channels, in the order of [`channels`], of some pixels of rows.
pub(crate) fn samples(frame: &Frame<'_>, rows: &Rows<'_>, pixels: Range<usize>) -> Vec<FlatSamples> {
    let image = rows.image;
    let alpha = &image.alpha.pixels[pixels.clone()];
    let colors: Vec<[f32; 3]> = image.color.pixels[pixels.clone()]
        .iter()
        .zip(alpha)
        .map(|(color, alpha)| premultiplied(*color, *alpha, frame.background, frame.encoding))
        .collect();
    let mut samples: Vec<FlatSamples> =
        (0..3).map(|channel| FlatSamples::F32(colors.iter().map(|color| color[channel]).collect())).collect();
    samples.push(FlatSamples::F32(alpha.to_vec()));
    let world = |depth: f32| (f64::from(depth) * frame.world_per_unit) as f32;
    let depths = &image.depth.as_ref().expect("frames have depth").pixels[pixels.clone()];
    let depth = depths.iter().map(|depth| if *depth > 0.0 { world(*depth) } else { NO_DEPTH });
    samples.push(FlatSamples::F32(depth.collect()));
    for (axis, sign) in [1.0, -1.0].into_iter().enumerate() {
        // Adding 0 turns -0 into 0.
        let component = rows.motion.pixels[pixels.clone()].iter().map(|vector| sign * vector[axis] + 0.0);
        samples.push(FlatSamples::F32(component.collect()));
    }
    if let Some(objects) = frame.objects {
        let instances = image.instances.as_ref().expect("frames with objects have instances");
        let ids = pixels.clone().map(|pixel| {
            let index = usize::from(instances.foreground_label_at(pixel)).wrapping_sub(1);
            objects.get(index).map_or(0, |object| u32::from(object.id))
        });
        samples.push(FlatSamples::U32(ids.collect()));
        for values in [&instances.coverage, &instances.foreground, &instances.probability, &instances.entropy]
        {
            samples.push(FlatSamples::F32(values.pixels[pixels.clone()].to_vec()));
        }
        let ranks = rows.ranks.expect("frames with objects have ranks");
        for (ids, coverages) in cryptomatte::planes(objects, &image.alpha, instances, ranks, pixels) {
            samples.push(FlatSamples::F32(ids));
            samples.push(FlatSamples::F32(coverages));
        }
    }
    samples
}

/// Attributes of the header by name.
pub(crate) fn attributes(frame: &Frame<'_>) -> Result<Vec<(String, String)>, ExrError> {
    let mut attributes = vec![
        ("colorInteropID".to_owned(), frame.encoding.interop_id().to_owned()),
        ("cif/frame".to_owned(), frame.name.to_owned()),
        ("cif/time".to_owned(), format!("{}", frame.time)),
        (
            "cif/color".to_owned(),
            match frame.encoding {
                ColorEncoding::Linear => {
                    "linear Rec. 709; captured and trained display-referred (sRGB), decoded for this file; \
                     multiplied by alpha"
                }
                ColorEncoding::Display => {
                    "display-referred (sRGB) as captured and trained; multiplied by alpha"
                }
            }
            .to_owned(),
        ),
        ("cif/background".to_owned(), {
            let [r, g, b] = frame.background;
            format!("{r} {g} {b} (display-referred, not in the picture)")
        }),
    ];
    attributes.push((
        "cif/depth".to_owned(),
        "Z: expected depth along the viewing axis, world units; 1e10 where nothing is".to_owned(),
    ));
    attributes.push((
        "cif/motion".to_owned(),
        "forward: motion to the next frame, pixels, u to the right, v up".to_owned(),
    ));
    let next = frame.next.unwrap_or("none: the last frame");
    attributes.push(("cif/motionTo".to_owned(), next.to_owned()));
    if let Some(objects) = frame.objects {
        let key = layer_key(cryptomatte::LAYER);
        let manifest = cryptomatte::manifest(objects)?;
        for (name, value) in [
            ("name", cryptomatte::LAYER),
            ("hash", HASH),
            ("conversion", CONVERSION),
            ("manifest", manifest.as_str()),
        ] {
            attributes.push((format!("cryptomatte/{key}/{name}"), value.to_owned()));
        }
    }
    Ok(attributes)
}
