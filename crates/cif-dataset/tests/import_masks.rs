//! Masks of other tools, brought to the frames of a capture.
#![allow(clippy::unwrap_used)] // Helpers of tests.

mod support;

use std::path::Path;

use cif_dataset::masks::{Import, SourceKind};
use serde_json::json;
use support::imports::*;
use support::*;

#[test]
fn colours_of_a_tracker_become_ids_in_one_table() {
    let folder = hypernerf(3);
    let deva = folder.path().join("deva");
    for k in 0..3 {
        // Colours as DEVA writes ids: R + 256 G + 65536 B.
        write_rgb(&deva.join(format!("Annotations/clip/{k:05}.png")), WIDTH, HEIGHT, |x, _| {
            [[0; 3], [200, 7, 1], [9, 9, 0]][object_at(x) as usize]
        });
    }
    let segments =
        json!([{"id": 200 + 256 * 7 + 65536, "category_id": 3}, {"id": 9 + 256 * 9, "category_id": 4}]);
    write_json(
        &deva.join("pred.json"),
        &json!({"annotations": [{"file_name": "00000.jpg", "segments_info": segments}],
                "categories": [{"id": 3, "name": "kettle"}, {"id": 4, "name": "cup"}]}),
    );
    let (kind, labels, frames) = imported(&folder, &deva);
    // By red, green and blue: (9, 9, 0) comes first.
    assert_eq!((kind, labels), (SourceKind::Tracker, vec!["cup".to_owned(), "kettle".to_owned()]));
    assert_eq!(frames, vec![Some([2, 0, 1]); 3]);
}

#[test]
fn blended_colours_are_refused_and_palettes_keep_their_indices() {
    let folder = hypernerf(2);
    let blended = folder.path().join("blended");
    for k in 0..2 {
        write_rgb(&blended.join(format!("{k:06}.png")), WIDTH, HEIGHT, |x, y| match x {
            0..8 => [200, 0, 0],
            8 => [(y * 8) as u8, y as u8, 0],
            _ => [0; 3],
        });
    }
    holds(&failure_of(&folder, &blended), &["blended", "000000.png", "antialiasing"]);
    let palette = folder.path().join("palette");
    for k in 0..2 {
        write_mask(&palette.join(format!("{k:06}.png")), WIDTH, HEIGHT, |x, _| {
            [0, 40, 7][object_at(x) as usize]
        });
    }
    assert_eq!(imported(&folder, &palette).2, vec![Some([40, 0, 7]); 2]);
    // A picture in colours among them.
    write_rgb(&palette.join("000001.png"), WIDTH, HEIGHT, |_, _| [1, 2, 3]);
    holds(&failure_of(&folder, &palette), &["000001.png", "in one way"]);
}

#[test]
fn a_colour_mask_in_the_capture_names_the_import() {
    let folder = hypernerf(2);
    write_rgb(&folder.path().join("masks/000000.png"), WIDTH, HEIGHT, |_, _| [9, 9, 9]);
    holds(&failure(&folder), &["000000.png", "cif masks import"]);
}

#[test]
fn masks_of_single_objects_are_read_in_either_order() {
    for (name, kind) in
        [("{f}/{o}.png", SourceKind::FrameFolders), ("video/{o}/{f}.png", SourceKind::ObjectFolders)]
    {
        let folder = hypernerf(3);
        let source = folder.path().join("sam2");
        for frame in 0..3 {
            for object in [1, 2] {
                let inside =
                    name.replace("{f}", &format!("{frame:05}")).replace("{o}", &format!("{object:03}"));
                // 0 and 1, as numpy masks are saved, and 0 and 255.
                let white = if object == 1 { 1 } else { 255 };
                write_grey(&source.join(inside), |x, _| if object_at(x) == object { white } else { 0 });
            }
        }
        let (found, labels, frames) = imported(&folder, &source);
        assert_eq!((found, labels), (kind, vec!["instance_1".to_owned(), "instance_2".to_owned()]));
        assert_eq!(frames, vec![BOTH; 3]);
    }
}

#[test]
fn pictures_in_one_folder_or_with_one_word_show_several_objects_by_their_values() {
    for name in ["workspace/masks/{f}.png", "masks/{f}_mask.png", "masks/one/{f}.png"] {
        let folder = hypernerf(3);
        let source = folder.path().join("tracked");
        for frame in 0..3 {
            let inside = name.replace("{f}", &format!("{frame:06}"));
            write_grey(&source.join(inside), |x, _| [0, 1, 2][object_at(x) as usize]);
        }
        let (kind, labels, frames) = imported(&folder, &source);
        assert_eq!(kind, SourceKind::Tracker, "{name}");
        assert_eq!(labels, ["instance_1", "instance_2"], "{name}");
        assert_eq!(frames, [BOTH; 3], "{name}");
    }
    // One object is one all the same, called as its folder is.
    let folder = hypernerf(3);
    let source = folder.path().join("sam2");
    for frame in 0..3 {
        write_grey(&source.join(format!("4/{frame:05}.png")), |x, _| if object_at(x) == 1 { 255 } else { 0 });
    }
    let (kind, _, frames) = imported(&folder, &source);
    assert_eq!((kind, frames[0]), (SourceKind::ObjectFolders, Some([4, 0, 0])));
}

#[test]
fn arrays_of_truth_values_show_one_object() {
    let folder = hypernerf(2);
    let source = folder.path().join("arrays");
    for frame in 0..2 {
        let mut bytes = npy_header("|b1", &format!("({HEIGHT}, {WIDTH})"));
        bytes.extend((0..WIDTH * HEIGHT).map(|at| u8::from(object_at(at % WIDTH) == 1)));
        write(&source.join(format!("{frame:06}.npy")), bytes);
    }
    assert_eq!(imported(&folder, &source).2, [Some([1, 0, 0]); 2]);
}

#[test]
fn classes_of_grounded_sam_2_lie_next_to_its_arrays() {
    let folder = hypernerf(2);
    let source = folder.path().join("tracked");
    for frame in 0..2 {
        let mut bytes = npy_header("<u2", &format!("({HEIGHT}, {WIDTH})"));
        bytes.extend((0..WIDTH * HEIGHT).flat_map(|at| (object_at(at % WIDTH) as u16).to_le_bytes()));
        write(&source.join(format!("mask_data/mask_{frame:06}.npy")), bytes);
        let class =
            |id: u16, name: &str| json!({"instance_id": id, "class_name": name, "x1": 0, "logit": 0.0});
        let labels = json!({"1": class(1, "cup"), "2": class(2, "")});
        let listing = json!({"mask_name": format!("mask_{frame:06}.npy"), "labels": labels});
        write_json(&source.join(format!("json_data/mask_{frame:06}.json")), &listing);
    }
    let (kind, labels, frames) = imported(&folder, &source);
    assert_eq!((kind, labels), (SourceKind::Arrays, vec!["cup".to_owned(), "instance_2".to_owned()]));
    assert_eq!(frames, [BOTH; 2]);
}

#[test]
fn files_without_masks_say_what_they_hold() {
    let folder = hypernerf(1);
    let path = folder.path().join("annotations.xml");
    let image = "<image id=\"0\" name=\"000000.png\" width=\"32\" height=\"24\">";
    let shapes = "<box label=\"a\"/><box label=\"b\"/><ellipse label=\"a\"/>";
    write(&path, format!("<annotations>{image}{shapes}</image></annotations>"));
    holds(&failure_of(&folder, &path), &["2 of kind box, 1 of kind ellipse", "draw masks or polygons"]);
    let path = folder.path().join("000000.json");
    write_json(&path, &json!({"version": "5.5.0", "shapes": [], "imagePath": "000000.png"}));
    holds(&failure_of(&folder, &path), &["LabelMe", "COCO"]);
}

fn write_grey(path: &Path, value: impl Fn(u32, u32) -> u8) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::GrayImage::from_fn(WIDTH, HEIGHT, |x, y| image::Luma([value(x, y)])).save(path).unwrap();
}

#[test]
fn arrays_of_ids_are_read_for_all_frames_at_once() {
    let folder = hypernerf(2);
    let mut bytes = npy_header("|u1", &format!("(2, {HEIGHT}, {WIDTH})"));
    for _ in 0..2 {
        bytes.extend((0..HEIGHT).flat_map(|_| (0..WIDTH).map(|x| object_at(x) as u8)));
    }
    let path = folder.path().join("ids.npy");
    write(&path, &bytes);
    assert_eq!(imported(&folder, &path).2, vec![BOTH; 2]);
    write(&path, &bytes[..bytes.len() - 9]);
    holds(&failure_of(&folder, &path), &["ids.npy", "cut short"]);
}

fn npy_header(descr: &str, shape: &str) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes
}

#[test]
fn the_smaller_of_two_objects_is_in_front_unless_layers_say_so() {
    let folder = hypernerf(1);
    let path = folder.path().join("annotations.xml");
    let polygon = |label: &str, x: u32, z: i32| {
        format!("<polygon label=\"{label}\" points=\"0,0;{x},0;{x},24;0,24\" z_order=\"{z}\"/>")
    };
    let xml = |shapes: String| {
        format!(
            "<?xml version=\"1.0\"?><annotations><version>1.1</version><image id=\"0\" name=\"000000.png\" \
             width=\"32\" height=\"24\">{shapes}<box label=\"a\"/></image></annotations>"
        )
    };
    let dataset = open(&folder);
    for (front, back, expected) in [(0, 0, [2, 1]), (0, 1, [1, 1])] {
        write(&path, xml(polygon("table", 32, back) + &polygon("cup", 8, front)));
        let import = Import::open(&path, None, None, &dataset).unwrap();
        let drawn = import.draw(&dataset, 0).unwrap().unwrap();
        assert_eq!([3, 12].map(|x| *drawn.ids.at(x, 5)), expected);
        assert_eq!(drawn.disputed, 8 * 24);
        assert!(import.notes.iter().any(|note| note.contains("1 shapes of kind box")), "{:?}", import.notes);
    }
    write(
        &path,
        xml("<mask label=\"a\" rle=\"3, 5\" left=\"30\" top=\"0\" width=\"4\" height=\"2\"/>".to_owned()),
    );
    holds(&failure_of(&folder, &path), &["annotations.xml", "line 1", "leaves the picture"]);
    write(&path, "<annotations><image");
    holds(&failure_of(&folder, &path), &["annotations.xml", "no readable XML"]);
}

#[test]
fn tracks_of_a_cvat_video_stop_where_the_object_leaves() {
    let folder = hypernerf(3);
    let path = folder.path().join("annotations.xml");
    let shape = |frame: u32, outside: u32, left: u32, right: u32| {
        format!(
            "<polygon frame=\"{frame}\" outside=\"{outside}\" points=\"{left},0;{right},0;{right},24;{left},24\"/>"
        )
    };
    let xml = format!(
        "<annotations><meta><task><original_size><width>32</width><height>24</height></original_size></task></meta>\
         <track id=\"0\" label=\"cup\">{}{}{}</track><track id=\"1\" label=\"cup\">{}</track></annotations>",
        shape(0, 0, 0, 8),
        shape(1, 0, 0, 8),
        shape(2, 1, 0, 8),
        shape(1, 0, 24, 32)
    );
    write(&path, &xml);
    let (kind, labels, frames) = imported(&folder, &path);
    assert_eq!((kind, labels), (SourceKind::Cvat, vec!["cup 1".to_owned(), "cup 2".to_owned()]));
    assert_eq!(frames, [Some([1, 0, 0]), BOTH, None]);
}

#[test]
fn brushes_and_polygons_of_label_studio_join_by_label() {
    let folder = hypernerf(2);
    let path = folder.path().join("export.json");
    // A brush on the right, in percent a polygon on the left.
    let opaque: Vec<u8> = (0..HEIGHT).flat_map(|_| (0..WIDTH).map(|x| u8::from(object_at(x) == 2))).collect();
    let mut bits = format!("{:032b}00111{}", 4 * WIDTH * HEIGHT, "0010001101111111");
    for pixel in &opaque {
        // Four equal values, as a run.
        bits += &format!("100011{:08b}", 255 * u32::from(*pixel));
    }
    let rle: Vec<u8> = bits
        .as_bytes()
        .chunks(8)
        .map(|byte| byte.iter().enumerate().fold(0, |value, (k, bit)| value | (bit - b'0') << (7 - k)))
        .collect();
    let region = |kind: &str, value: serde_json::Value| json!({"id": kind, "type": kind, "original_width": WIDTH, "original_height": HEIGHT, "value": value});
    let task = |image: &str, rle: &[u8]| {
        json!({"id": 4, "data": {"image": image}, "annotations": [
            {"result": [], "was_cancelled": false},
            {"result": [
                region("polygonlabels", json!({"points": [[0, 0], [25, 0], [25, 100], [0, 100]], "polygonlabels": ["cup"]})),
                region("brushlabels", json!({"format": "rle", "rle": rle, "brushlabels": ["plate"]})),
            ], "was_cancelled": false}]})
    };
    write_json(
        &path,
        &json!([
            task("/data/upload/3/1f2e3d4c-000000.png", &rle),
            task("/data/local-files/?d=a/000001.png", &rle)
        ]),
    );
    let (kind, labels, frames) = imported(&folder, &path);
    assert_eq!((kind, labels), (SourceKind::LabelStudio, vec!["cup".to_owned(), "plate".to_owned()]));
    assert_eq!(frames, vec![BOTH; 2]);
    write_json(&path, &json!([task("000000.png", &rle[..rle.len() / 2])]));
    holds(&failure_of(&folder, &path), &["task 4", "cut short"]);
}

#[test]
fn mattes_are_channels_or_files_and_cut_at_a_half() {
    use exr::prelude::*;
    let folder = hypernerf(2);
    let (channels, files) = (folder.path().join("channels"), folder.path().join("files"));
    let write_exr = |path: &Path, mattes: &[(&str, u32)]| {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let values = |object: u32| -> Vec<f32> {
            (0..HEIGHT)
                .flat_map(|_| (0..WIDTH).map(move |x| if object_at(x) == object { 0.6 } else { 0.4 }))
                .collect()
        };
        let list: Vec<AnyChannel<FlatSamples>> = mattes
            .iter()
            .map(|(name, object)| AnyChannel::new(*name, FlatSamples::F32(values(*object))))
            .collect();
        let size = Vec2(WIDTH as usize, HEIGHT as usize);
        let layer = Layer::new(
            size,
            LayerAttributes::default(),
            Encoding::SMALL_LOSSLESS,
            AnyChannels::sort(list.into()),
        );
        Image::from_layer(layer).write().to_file(path).unwrap();
    };
    for k in 0..2 {
        write_exr(&channels.join(format!("{k:06}.exr")), &[("R", 0), ("cup.alpha", 1), ("mattes.plate", 2)]);
        for (name, object) in [("cup", 1), ("plate", 2)] {
            write_exr(&files.join(format!("{name}.{k:04}.exr")), &[("A", object)]);
        }
    }
    for (source, kind) in [(&channels, SourceKind::Mattes), (&files, SourceKind::ObjectFolders)] {
        let (found, labels, frames) = imported(&folder, source);
        assert_eq!((found, labels), (kind, vec!["cup".to_owned(), "plate".to_owned()]));
        assert_eq!(frames, vec![BOTH; 2]);
        std::fs::remove_dir_all(folder.path().join("imported")).unwrap();
    }
}

#[test]
fn sizes_and_frames_that_do_not_fit_are_reported() {
    let folder = hypernerf(3);
    let source = folder.path().join("tracked");
    write_mask(&source.join("000001.png"), WIDTH, 2 * HEIGHT, |_, _| 1);
    holds(&failure_of(&folder, &source), &["000001.png", "32 x 48", "32 x 24", "another aspect"]);
    std::fs::remove_file(source.join("000001.png")).unwrap();
    write_mask(&source.join("frame_000701.png"), WIDTH, HEIGHT, |_, _| 1);
    holds(&failure_of(&folder, &source), &["none of its 1 pictures", "000000"]);
    // Numbers that are places in the order of the frames, not their names.
    std::fs::remove_file(source.join("frame_000701.png")).unwrap();
    for (name, id) in [("1", 5), ("2", 6), ("3", 7)] {
        write_mask(&source.join(format!("clip{name}.png")), WIDTH, HEIGHT, |_, _| id);
    }
    let dataset = open(&folder);
    let import = Import::open(&source, None, None, &dataset).unwrap();
    assert!(import.notes.iter().any(|note| note.contains("from 1")), "{:?}", import.notes);
    assert_eq!(*import.draw(&dataset, 2).unwrap().unwrap().ids.at(0, 0), 7);
    holds(&failure_of(&folder, &folder.path().join("nothing")), &["no such file"]);
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    holds(&failure_of(&folder, &folder.path().join("empty")), &["no PNG"]);
}
