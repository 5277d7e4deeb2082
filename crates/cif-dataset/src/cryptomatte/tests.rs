use exr::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};

use super::*;
use crate::InstanceLabel;

/// Properties that tests vary of a file of 4 x 2 pixels with the objects mug (left), lid and table (mixed) and rest.
struct File {
    multi_part: bool,
    half: bool,
    without: &'static str,
    attributes: Vec<(&'static str, String)>,
}

const LAYER: &str = "View.CryptoObject";

fn manifest() -> String {
    let hexadecimal = |name: &str| format!("{:08x}", object_id(name));
    serde_json::json!({
        "red_mug": hexadecimal("red_mug"), "lid.001": hexadecimal("lid.001"), "table": hexadecimal("table"),
    })
    .to_string()
}

impl Default for File {
    fn default() -> Self {
        let attributes = vec![
            ("name", LAYER.to_owned()),
            ("hash", HASH.to_owned()),
            ("conversion", CONVERSION.to_owned()),
            ("manifest", manifest()),
        ];
        Self { multi_part: false, half: false, without: "-", attributes }
    }
}

impl File {
    fn set(mut self, name: &'static str, value: &str) -> Self {
        self.attributes.retain(|(known, _)| *known != name);
        self.attributes.push((name, value.to_owned()));
        self
    }

    fn write(&self, folder: &Path) -> PathBuf {
        let path = folder.join("000000.exr");
        let size = Vec2(4, 2);
        let id = |name| id_as_float(object_id(name));
        let ids =
            [vec![id("red_mug"); 8], vec![id("lid.001"), 0.0, id("table"), id("table"), 0.0, 0.0, 0.0, 0.0]];
        let coverages =
            [vec![0.4, 1.0, 0.3, 0.5, 1.0, 0.6, 0.4, 0.0], vec![0.3, 0.0, 0.7, 0.5, 0.0, 0.0, 0.0, 0.0_f32]];
        let channel = |name: &str, values: &Vec<f32>| {
            let samples = if self.half {
                FlatSamples::F16(values.iter().map(|value| f16::from_f32(*value)).collect())
            } else {
                FlatSamples::F32(values.clone())
            };
            AnyChannel::new(name, samples)
        };
        let crypto: Vec<AnyChannel<FlatSamples>> =
            [("r", &ids[0]), ("g", &coverages[0]), ("b", &ids[1]), ("a", &coverages[1])]
                .into_iter()
                .filter(|(component, _)| *component != self.without)
                .map(|(component, values)| channel(&format!("{LAYER}00.{component}"), values))
                .collect();
        let colors = ["R", "G", "B"].map(|name| channel(name, &vec![0.5; 8])).to_vec();
        let mut attributes = LayerAttributes::named("View.Combined");
        for (name, value) in &self.attributes {
            attributes.other.insert(
                Text::new_or_none(format!("cryptomatte/{}/{name}", layer_key(LAYER))).unwrap(),
                AttributeValue::Text(Text::new_or_none(value).unwrap()),
            );
        }
        let layer = |attributes: LayerAttributes, channels: Vec<AnyChannel<FlatSamples>>| {
            Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(channels.into()))
        };
        let layers = if self.multi_part {
            vec![layer(attributes, colors), layer(LayerAttributes::named("View.CryptoObject00"), crypto)]
        } else {
            vec![layer(attributes, colors.into_iter().chain(crypto).collect())]
        };
        Image::from_layers(ImageAttributes::new(IntegerBounds::from_dimensions(size)), layers)
            .write()
            .to_file(&path)
            .unwrap();
        path
    }

    fn failure(&self) -> String {
        let folder = tempfile::tempdir().unwrap();
        super::read(&self.write(folder.path())).unwrap_err().to_string()
    }
}

#[test]
fn hashes_are_those_of_the_specification() {
    // As Blender 5.0.1 writes them.
    for (name, id) in [
        ("table", 0x0cac_c161),
        ("area.001", 0x7f08_3aeb),
        ("copper_kettle", 0x9a90_b09a),
        ("kitchen_scissors.a", 0x2428_c975),
        ("orange", 0x84b7_e633),
    ] {
        assert_eq!(object_id(name), id, "{name}");
    }
    assert_eq!(layer_key("ViewLayer.CryptoObject"), "542cafa");
}

#[test]
fn every_id_is_a_normal_float() {
    let names: Vec<String> = (0..4000).map(|k| format!("object {k}")).collect();
    let mangled = names.iter().filter(|name| object_id(name) != super::murmur(name)).count();
    assert!(mangled > 5, "{mangled} of {} names need their exponent changed", names.len());
    assert!(names.iter().all(|name| id_as_float(object_id(name)).is_normal()));
}

#[test]
fn files_of_one_and_of_several_parts_are_read() {
    let ids =
        ObjectIds::from([(object_id("red_mug"), 3), (object_id("lid.001"), 3), (object_id("table"), 0)]);
    for multi_part in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let path = File { multi_part, ..File::default() }.write(folder.path());
        let matte = super::read(&path).unwrap();
        assert_eq!((matte.layer.as_str(), matte.objects.len(), matte.ranks.len()), (LAYER, 3, 2));
        // Mug and lid count together; half a pixel of mug wins over half a pixel of table, less does not.
        assert_eq!(matte.flatten(&ids).pixels, [3, 3, 0, 3, 3, 3, 0, 0]);
        let header = read_header(&path).unwrap();
        assert_eq!((header.width, header.height), (4, 2));
    }
}

#[test]
fn bad_files_are_refused_in_words() {
    let hold = |message: &str, words: &[&str]| {
        for word in words {
            assert!(message.contains(word), "`{word}` is not in: {message}");
        }
    };
    hold(&File { without: "g", ..File::default() }.failure(), &["000000.exr", "CryptoObject00.G is missing"]);
    hold(&File { half: true, ..File::default() }.failure(), &["is half", "32-bit floats"]);
    hold(&File { attributes: Vec::new(), ..File::default() }.failure(), &["holds no Cryptomatte"]);
    let mut bare = File::default();
    bare.attributes.retain(|(name, _)| *name != "manifest");
    hold(&bare.failure(), &["has no manifest"]);
    hold(&File::default().set("manifest", "{\"mug\": ").failure(), &["manifest", "cannot be read"]);
    hold(
        &File::default().set("manifest", "{\"mug\": \"12\"}").failure(),
        &["'mug'", "00000012", "MurmurHash3_32"],
    );
    hold(&File::default().set("manifest", "{\"mug\": \"red\"}").failure(), &["'red'", "hexadecimal"]);
    hold(&File::default().set("conversion", "uint64_to_half").failure(), &["uint64_to_half"]);
    bare.attributes.push(("manif_file", "../manifest.json".to_owned()));
    hold(&bare.failure(), &["outside its folder"]);

    let folder = tempfile::tempdir().unwrap();
    let path = File::default().write(folder.path());
    let bytes = fs::read(&path).unwrap();
    for length in [0, 3, 200, bytes.len() / 2, bytes.len() - 5] {
        fs::write(&path, &bytes[..length]).unwrap();
        hold(&super::read(&path).unwrap_err().to_string(), &["000000.exr", "export it again"]);
    }
    fs::write(&path, "no EXR at all").unwrap();
    hold(&super::read(&path).unwrap_err().to_string(), &["not a readable EXR file"]);
}

#[test]
fn headers_that_claim_more_than_the_file_holds_are_not_believed() {
    let folder = tempfile::tempdir().unwrap();
    let path = File::default().write(folder.path());
    let mut bytes = fs::read(&path).unwrap();
    // Both windows are (0, 0) to (3, 1).
    let (old, new) = ([0, 0, 3, 1].map(i32::to_le_bytes), [0, 0, 14_999, 14_999].map(i32::to_le_bytes));
    for at in 0..bytes.len() - 16 {
        if bytes[at..at + 16] == *old.as_flattened() {
            bytes[at..at + 16].copy_from_slice(new.as_flattened());
        }
    }
    fs::write(&path, bytes).unwrap();
    let message = super::read(&path).unwrap_err().to_string();
    assert!(message.contains("15000 x 15000"), "{message}");
}

#[test]
fn manifests_next_to_the_file_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut file = File::default().set("manif_file", "names.json");
    file.attributes.retain(|(name, _)| *name != "manifest");
    let path = file.write(folder.path());
    assert!(super::read(&path).unwrap_err().to_string().contains("names.json"));
    fs::write(folder.path().join("names.json"), manifest()).unwrap();
    assert_eq!(super::read(&path).unwrap().objects.len(), 3);
}

fn labels(entries: &[(u16, &str)]) -> BTreeMap<u16, InstanceLabel> {
    entries
        .iter()
        .map(|(id, label)| {
            (
                *id,
                InstanceLabel {
                    id: *id,
                    label: (*label).into(),
                    category: "thing".into(),
                    taxonomies: Default::default(),
                },
            )
        })
        .collect()
}

fn named(names: &[&str]) -> BTreeMap<String, u32> {
    names.iter().map(|name| ((*name).to_owned(), object_id(name))).collect()
}

#[test]
fn objects_find_their_labels() {
    let objects =
        named(&["Red_Mug", "lid.001", "scissors.a", "scissors.b", "red_box_004", "table", "background"]);
    let mut instances =
        labels(&[(1, "red mug"), (2, "lid"), (3, "scissors"), (4, "red box"), (5, "red box")]);
    let mut warnings = Vec::new();
    let ids = assign(&objects, &BTreeMap::new(), &mut instances, Path::new("m"), &mut warnings).unwrap();
    let id = |name: &str| ids.get(&object_id(name)).copied();
    assert_eq!(
        ["Red_Mug", "lid.001", "scissors.a", "scissors.b", "red_box_004", "table", "background"].map(id),
        [Some(1), Some(2), Some(3), Some(3), Some(4), None, None]
    );
    assert!(warnings.len() == 1 && warnings[0].ends_with("unlabelled: table"), "{warnings:?}");

    let message = assign(&named(&["chair"]), &BTreeMap::new(), &mut instances, Path::new("m"), &mut warnings)
        .unwrap_err()
        .to_string();
    assert!(message.contains("chair") && message.contains("red mug"), "{message}");
}

#[test]
fn without_labels_objects_are_numbered_by_name() {
    let mut instances = BTreeMap::new();
    let objects = named(&["mug.001", "box", "background"]);
    let ids = assign(&objects, &BTreeMap::new(), &mut instances, Path::new("m"), &mut Vec::new()).unwrap();
    assert_eq!((ids[&object_id("box")], ids[&object_id("mug.001")], ids.len()), (1, 2, 2));
    assert_eq!((instances[&2].label.as_str(), instances[&2].category.as_str()), ("mug.001", "mug"));
}

#[test]
fn a_table_next_to_the_files_decides() {
    let mut instances = labels(&[(1, "mug"), (7, "box")]);
    let explicit = BTreeMap::from([("mug".to_owned(), 0), ("thing".to_owned(), 7)]);
    let objects = named(&["mug", "thing"]);
    let ids = assign(&objects, &explicit, &mut instances, Path::new("m"), &mut Vec::new()).unwrap();
    assert_eq!((ids[&object_id("mug")], ids[&object_id("thing")]), (0, 7));
}
