use std::path::Path;

use cif_dataset::cryptomatte::{self as matte, ObjectIds, object_id};
use cif_geometry::PixelGrid;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::synthetic::{SyntheticConfig, generate};
use cif_render::{Channels, InstanceImage, InstanceRanks, RenderSettings, RenderedImage};
use exr::prelude::*;

use super::*;

/// As of a scene in units 2.5 times those of its capture.
const WORLD_PER_UNIT: f64 = 2.5;

struct Rendered {
    image: RenderedImage,
    ranks: InstanceRanks,
    objects: Vec<Object>,
    settings: RenderSettings,
}

fn rendered(instances: usize) -> Rendered {
    let config = SyntheticConfig { gaussians: 40, instances, height: 40, ..SyntheticConfig::default() };
    let scene = generate(&config);
    let settings = RenderSettings::of_field(&scene.field);
    let mut renderer = Renderer::new(SimdLevel::Portable);
    let channels = Channels { depth: true, instances: true };
    let image = renderer.render(&scene.field, &scene.camera, 0.0, &settings, channels);
    let identities = scene.field.identities.as_ref().unwrap();
    let ranks = renderer.instance_ranks(identities, cryptomatte::RANKS);
    let names = ["Tasse (blau)", "杯子", "red \"box\"", "d", "e", "f", "g", "h", "i"];
    let objects =
        (0..instances).map(|k| Object { id: 10 * k as u16 + 3, name: names[k].to_owned() }).collect();
    Rendered { image, ranks, objects, settings }
}

impl Rendered {
    fn write(&self, path: &Path, encoding: ColorEncoding) -> std::result::Result<(), ExrError> {
        self.write_in_bands(path, encoding, u32::MAX)
    }

    /// Hands the file at most so many rows at once.
    fn write_in_bands(
        &self,
        path: &Path,
        encoding: ColorEncoding,
        most: u32,
    ) -> std::result::Result<(), ExrError> {
        let (width, height) = (self.image.alpha.width, self.image.alpha.height);
        let frame = Frame {
            name: "000000",
            time: 0.25,
            width,
            height,
            world_per_unit: WORLD_PER_UNIT,
            background: self.settings.background,
            objects: Some(&self.objects),
            next: Some("000001"),
            encoding,
        };
        super::write(path, &frame, |file| {
            for first_row in (0..height).step_by(most as usize) {
                let rows = first_row..(first_row + most.min(height - first_row));
                let (image, ranks) = (image_rows(&self.image, &rows), ranks_rows(&self.ranks, &rows));
                let motion = PixelGrid::filled(width, rows.end - rows.start, [1.5, 2.0]);
                file.write(&Rows { first_row, image: &image, ranks: Some(&ranks), motion: &motion })?;
            }
            Ok(())
        })
    }
}

fn grid_rows<T: Clone>(grid: &PixelGrid<T>, rows: &std::ops::Range<u32>) -> PixelGrid<T> {
    let pixels = (rows.start * grid.width) as usize..(rows.end * grid.width) as usize;
    PixelGrid::from_pixels(grid.width, rows.end - rows.start, grid.pixels[pixels].to_vec())
}

fn image_rows(image: &RenderedImage, rows: &std::ops::Range<u32>) -> RenderedImage {
    RenderedImage {
        color: grid_rows(&image.color, rows),
        alpha: grid_rows(&image.alpha, rows),
        depth: image.depth.as_ref().map(|depth| grid_rows(depth, rows)),
        instances: image.instances.as_ref().map(|instances| InstanceImage {
            label: grid_rows(&instances.label, rows),
            probability: grid_rows(&instances.probability, rows),
            coverage: grid_rows(&instances.coverage, rows),
            foreground: grid_rows(&instances.foreground, rows),
            entropy: grid_rows(&instances.entropy, rows),
        }),
    }
}

fn ranks_rows(ranks: &InstanceRanks, rows: &std::ops::Range<u32>) -> InstanceRanks {
    let ranks = ranks.ranks.iter();
    InstanceRanks { ranks: ranks.map(|(a, b)| (grid_rows(a, rows), grid_rows(b, rows))).collect() }
}

#[test]
fn bands_of_rows_make_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let rendered = rendered(3);
    let file = |most: u32| {
        rendered.write_in_bands(&path, ColorEncoding::Linear, most).unwrap();
        let image = read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
        image.all_attributes().from_file(&path).unwrap().layer_data
    };
    let whole = file(u32::MAX);
    assert_eq!((whole.size.area(), whole.channel_data.list.len()), (32 * 40, 24));
    for most in [16, 32] {
        let layer = file(most);
        assert_eq!(layer.attributes, whole.attributes);
        // Bits: ids of a Cryptomatte may be NaN.
        let bits = |samples: &FlatSamples| match samples {
            FlatSamples::F32(values) => values.iter().map(|value| value.to_bits()).collect::<Vec<u32>>(),
            FlatSamples::U32(values) => values.clone(),
            FlatSamples::F16(_) => panic!("all channels have 32 bits"),
        };
        for (a, b) in layer.channel_data.list.iter().zip(&whole.channel_data.list) {
            assert_eq!(a.name, b.name);
            assert!(bits(&a.sample_data) == bits(&b.sample_data), "{}, {most} rows at once", a.name);
        }
    }
}

#[test]
fn a_file_without_all_rows_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    rendered(2).write(&path, ColorEncoding::Linear).unwrap();
    let before = std::fs::read(&path).unwrap();
    let frame = Frame {
        name: "a",
        time: 0.0,
        width: 8,
        height: 20,
        world_per_unit: 1.0,
        background: [0.0; 3],
        objects: None,
        next: None,
        encoding: ColorEncoding::Linear,
    };
    let error = super::write(&path, &frame, |_| Ok::<(), ExrError>(())).unwrap_err();
    assert!(error.to_string().contains("a.exr"), "{error}");
    let refused = super::write(&path, &frame, |_| {
        Err(ExrError::Encode { path: path.clone(), reason: "stopped".to_owned() })
    });
    assert!(refused.unwrap_err().to_string().contains("stopped"));
    assert!(std::fs::read(&path).unwrap() == before, "the old file is kept");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
}

#[test]
fn every_layer_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("000000.exr");
    let rendered = rendered(9);
    rendered.write(&path, ColorEncoding::Display).unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    let image = read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let image = image.all_attributes().from_file(&path).unwrap();
    let layer = image.layer_data;
    assert_eq!(layer.encoding.compression, Compression::ZIP16);
    let samples = |name: &str| {
        let channel = layer.channel_data.list.iter().find(|channel| channel.name.eq(name));
        &channel.unwrap_or_else(|| panic!("{name} is missing")).sample_data
    };
    let floats = |name: &str| match samples(name) {
        FlatSamples::F32(values) => values.clone(),
        _ => panic!("{name} is not float"),
    };
    let (alpha, colors) = (&rendered.image.alpha.pixels, &rendered.image.color.pixels);
    assert_eq!(&floats("A"), alpha);
    for (channel, name) in ["R", "G", "B"].into_iter().enumerate() {
        let background = rendered.settings.background[channel];
        for (pixel, value) in floats(name).iter().enumerate() {
            let composited = value + (1.0 - alpha[pixel]) * background;
            assert!((composited - colors[pixel][channel]).abs() < 1e-6);
        }
    }
    let depth = rendered.image.depth.as_ref().unwrap();
    for (value, depth) in floats("Z").iter().zip(&depth.pixels) {
        assert_eq!(
            *value,
            if *depth > 0.0 { 2.5 * *depth } else { layers::NO_DEPTH },
            "in the capture's units"
        );
    }
    assert!(floats("forward.u").iter().all(|u| *u == 1.5) && floats("forward.v").iter().all(|v| *v == -2.0));
    let instances = rendered.image.instances.as_ref().unwrap();
    assert_eq!(floats("coverage.V"), instances.coverage.pixels);
    assert_eq!(floats("entropy.V"), instances.entropy.pixels);
    let FlatSamples::U32(ids) = samples("instance.id") else { panic!("ids are integers") };
    let labels = instances.foreground_label();
    assert!(labels.pixels.iter().any(|label| *label > 0));
    for (id, label) in ids.iter().zip(&labels.pixels) {
        assert_eq!(*id, if *label == 0 { 0 } else { u32::from(*label - 1) * 10 + 3 });
    }
}

#[test]
fn linear_colours_are_the_default_and_said_in_the_header() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let rendered = rendered(2);
    rendered.write(&path, ColorEncoding::default()).unwrap();
    let meta = exr::meta::MetaData::read_from_file(&path, true).unwrap();
    let own = &meta.headers[0].own_attributes;
    let text = |name: &str| match own.other.get(&Text::new_or_panic(name)) {
        Some(AttributeValue::Text(text)) => text.to_string(),
        other => panic!("{name}: {other:?}"),
    };
    assert_eq!(text("colorInteropID"), "lin_rec709_scene");
    assert!(text("cif/color").starts_with("linear"));
    assert_eq!((text("cif/motionTo").as_str(), text("cif/time").as_str()), ("000001", "0.25"));
    // The key of `uCryptoObject` in Cryptomatte files of other programs.
    assert_eq!(text("cryptomatte/ae93ba3/name"), "uCryptoObject");
}

#[test]
fn coverages_fall_and_add_up_to_alpha() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    for (instances, complete) in [(9, false), (3, true)] {
        let rendered = rendered(instances);
        rendered.write(&path, ColorEncoding::Linear).unwrap();
        let read = matte::read(&path).unwrap();
        assert_eq!((read.layer.as_str(), read.ranks.len()), ("uCryptoObject", 6));
        assert_eq!((read.objects.len(), read.objects["杯子"]), (instances + 1, object_id("杯子")));
        let alpha = &rendered.image.alpha.pixels;
        let known: Vec<u32> = read.objects.values().copied().chain([0]).collect();
        for pixel in 0..alpha.len() {
            let coverages: Vec<f32> = read.ranks.iter().map(|(_, coverage)| coverage.pixels[pixel]).collect();
            assert!(coverages.is_sorted_by(|a, b| a >= b), "{coverages:?}");
            assert!(read.ranks.iter().all(|(ids, _)| known.contains(&ids.pixels[pixel])));
            let sum: f32 = coverages.iter().sum();
            assert!(sum <= alpha[pixel] + 1e-5, "{sum} of {}", alpha[pixel]);
            if complete {
                assert!((sum - alpha[pixel]).abs() < 1e-5, "{sum} of {}", alpha[pixel]);
            }
        }
    }
}

#[test]
fn the_cryptomatte_is_read_as_masks() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.exr");
    let rendered = rendered(2);
    rendered.write(&path, ColorEncoding::Linear).unwrap();
    let ids: ObjectIds = rendered.objects.iter().map(|object| (object_id(&object.name), object.id)).collect();
    let mask = matte::read(&path).unwrap().flatten(&ids);
    let instances = rendered.image.instances.as_ref().unwrap();
    let mut compared = 0;
    for pixel in 0..mask.pixels.len() {
        let (whole, foreground) = (instances.coverage.pixels[pixel], instances.foreground.pixels[pixel]);
        let most = if whole > 0.0 { foreground * instances.probability.pixels[pixel] / whole } else { 0.0 };
        let rest = 1.0 - foreground;
        if (most - rest).abs() > 1e-4 && (2.0 * most - foreground).abs() > 1e-4 {
            compared += 1;
            let expected = if most > rest { (instances.label.pixels[pixel] - 1) * 10 + 3 } else { 0 };
            assert_eq!(mask.pixels[pixel], expected, "pixel {pixel}");
        }
    }
    assert!(compared > 300, "{compared}");
}

#[test]
fn names_with_one_id_are_refused() {
    let objects = vec![Object { id: 1, name: "mug".into() }, Object { id: 2, name: "mug".into() }];
    let error = cryptomatte::manifest(&objects).unwrap_err();
    assert!(error.to_string().contains("'mug' and 'mug'"), "{error}");
}

#[test]
fn nothing_is_left_where_a_file_cannot_be_written() {
    let folder = tempfile::tempdir().unwrap();
    let error = rendered(1).write(&folder.path().join("no/a.exr"), ColorEncoding::Linear).unwrap_err();
    assert!(error.to_string().contains("no/a.exr: cannot be written"), "{error}");
}
