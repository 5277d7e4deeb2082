//! Which channels a file has.

use cif_dataset::cryptomatte::{CONVERSION, HASH, layer_key};
use cif_geometry::PixelGrid;
use cif_render::{InstanceRanks, RenderedImage};
use exr::prelude::FlatSamples;

use crate::color::{ColorEncoding, premultiplied};
use crate::{ExrError, cryptomatte};

/// Depth where nothing is, as Blender has it: farther than anything.
pub const NO_DEPTH: f32 = 1e10;

/// An instance of the scene, by dense index.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Object {
    /// Mask value.
    pub id: u16,
    /// Name in the Cryptomatte, unique.
    pub name: String,
}

/// Motion to the next frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// Pixels, x right and y down; 0 where nothing is.
    pub vectors: PixelGrid<[f32; 2]>,
    /// Name of the next frame; `None` behind the last, where all vectors are 0.
    pub next: Option<String>,
}

/// What a file is made of.
#[derive(Clone, Debug)]
pub struct Frame<'a> {
    /// Name of the frame.
    pub name: &'a str,
    /// Normalised time of the frame.
    pub time: f64,
    /// The picture.
    pub image: &'a RenderedImage,
    /// World units per unit of the picture's depths: 1 but for captures in units far from metres.
    pub world_per_unit: f64,
    /// Colour that the picture lies on, display-referred.
    pub background: [f32; 3],
    /// Instances of the scene.
    pub objects: &'a [Object],
    /// Foremost instances of every pixel, at least [`cryptomatte::RANKS`]; `None` in a scene without instances.
    pub ranks: Option<&'a InstanceRanks>,
    /// Motion vectors.
    pub motion: Option<&'a Motion>,
    /// Colours of the file.
    pub encoding: ColorEncoding,
}

/// A channel's name and samples.
pub(crate) type Channel = (String, FlatSamples);

/// All channels of a frame.
pub(crate) fn channels(frame: &Frame<'_>) -> Vec<Channel> {
    let image = frame.image;
    let float = |name: &str, values: Vec<f32>| (name.to_owned(), FlatSamples::F32(values));
    let mut channels = Vec::new();
    let colors: Vec<[f32; 3]> = image
        .color
        .pixels
        .iter()
        .zip(&image.alpha.pixels)
        .map(|(color, alpha)| premultiplied(*color, *alpha, frame.background, frame.encoding))
        .collect();
    for (channel, name) in ["R", "G", "B"].into_iter().enumerate() {
        channels.push(float(name, colors.iter().map(|color| color[channel]).collect()));
    }
    channels.push(float("A", image.alpha.pixels.clone()));
    if let Some(depth) = &image.depth {
        let world = |depth: f32| (f64::from(depth) * frame.world_per_unit) as f32;
        let depth = depth.pixels.iter().map(|depth| if *depth > 0.0 { world(*depth) } else { NO_DEPTH });
        channels.push(float("Z", depth.collect()));
    }
    if let Some(motion) = frame.motion {
        let component = |axis: usize, sign: f32| {
            // Adding 0 turns -0 into 0.
            motion.vectors.pixels.iter().map(|vector| sign * vector[axis] + 0.0).collect()
        };
        channels.push(float("forward.u", component(0, 1.0)));
        channels.push(float("forward.v", component(1, -1.0)));
    }
    if let Some(instances) = &image.instances {
        let ids = instances.foreground_label().map(|label| {
            let index = usize::from(*label).wrapping_sub(1);
            frame.objects.get(index).map_or(0, |object| u32::from(object.id))
        });
        channels.push(("instance.id".to_owned(), FlatSamples::U32(ids.pixels)));
        channels.push(float("coverage.V", instances.coverage.pixels.clone()));
        channels.push(float("foreground.V", instances.foreground.pixels.clone()));
        channels.push(float("probability.V", instances.probability.pixels.clone()));
        channels.push(float("entropy.V", instances.entropy.pixels.clone()));
        if let Some(ranks) = frame.ranks {
            let planes = cryptomatte::planes(frame.objects, &image.alpha, instances, ranks);
            for (rank, (ids, coverages)) in planes.into_iter().enumerate() {
                let names = if rank % 2 == 0 { ["R", "G"] } else { ["B", "A"] };
                let name = |component: &str| format!("{}{:02}.{component}", cryptomatte::LAYER, rank / 2);
                channels.push(float(&name(names[0]), ids));
                channels.push(float(&name(names[1]), coverages));
            }
        }
    }
    channels
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
    if frame.image.depth.is_some() {
        attributes.push((
            "cif/depth".to_owned(),
            "Z: expected depth along the viewing axis, world units; 1e10 where nothing is".to_owned(),
        ));
    }
    if let Some(motion) = frame.motion {
        let next = motion.next.as_deref();
        attributes.push((
            "cif/motion".to_owned(),
            "forward: way to the next frame, pixels, u to the right, v up".to_owned(),
        ));
        attributes.push(("cif/motionTo".to_owned(), next.unwrap_or("none: the last frame").to_owned()));
    }
    if frame.ranks.is_some() && frame.image.instances.is_some() {
        let key = layer_key(cryptomatte::LAYER);
        let manifest = cryptomatte::manifest(frame.objects)?;
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
