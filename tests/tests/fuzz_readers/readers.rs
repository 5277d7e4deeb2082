//! Every reader of the project, each with a small valid input. A new reader gets a row in [`all`].

use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use cif_dataset::cryptomatte::{CONVERSION, HASH, id_as_float, layer_key, object_id};
use cif_dataset::{Dataset, MotionTruth, OpenOptions};
use cif_field::tracks::{NO_GROUP, TrackGroup, TrackPose, Tracks};
use cif_field::{
    Checkpoint, Deformation, DeformationConfig, Field, Gaussians, Heads, Identities, Instance,
    RecordedCamera, SortMetric, TimeEncoding, Timeline, health,
};
use cif_geometry::{Bounds, PinholeCamera, RigidTransform};
use cif_scene::SceneOptions;
use cif_test::capture;
use cif_train::{Control, Preset, TrainConfig, Trainer};
use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds,
    Layer, LayerAttributes, Text, Vec2, WritableImage,
};
use glam::{DQuat, DVec2, DVec3};
use serde_json::json;

use crate::captures;
use crate::mask_files;
use crate::mutate::Form;
use crate::poses;

/// A reader and the file that is damaged for it.
pub(crate) struct Reader {
    /// What is read.
    pub(crate) name: &'static str,
    /// The file in the folder.
    pub(crate) file: &'static str,
    /// What it is made of.
    pub(crate) form: Form,
    /// Writes a valid input into an empty folder.
    pub(crate) write: fn(&Path),
    /// Reads the folder; the error is what people are shown.
    pub(crate) read: fn(&Path) -> Result<(), String>,
}

/// The readers. Captures stand once for each of their files.
pub(crate) fn all() -> Vec<Reader> {
    let capture = |name, file, form, write| Reader { name, file, form, write, read: open_capture };
    vec![
        capture("hypernerf-dataset", "dataset.json", Form::Json, hypernerf),
        capture("hypernerf-metadata", "metadata.json", Form::Json, hypernerf),
        capture("hypernerf-scene", "scene.json", Form::Json, hypernerf),
        capture("hypernerf-camera", "camera/000001.json", Form::Json, hypernerf),
        capture("capture-image", "rgb/1x/000001.png", Form::Binary, hypernerf),
        capture("capture-mask", "masks/000000.png", Form::Binary, hypernerf),
        capture("capture-confidence", "masks/confidence/000001.png", Form::Binary, confidence),
        capture("capture-instances", "instances.json", Form::Json, hypernerf),
        capture("capture-splits", "splits.json", Form::Json, hypernerf),
        capture("capture-points-npy", "points.npy", Form::Binary, hypernerf),
        capture("capture-cryptomatte", "masks/000000.exr", Form::Binary, cryptomatte),
        capture("capture-cryptomatte-objects", "masks/objects.json", Form::Json, cryptomatte),
        capture("neu3d-poses", "poses_bounds.npy", Form::Binary, neu3d),
        capture("llff-poses", "poses_bounds.npy", Form::Binary, llff),
        capture("dynamic-gaussians-cameras", "train_meta.json", Form::Json, dynamic_gaussians),
        capture("dynamic-gaussians-points", "init_pt_cld.npz", Form::Binary, dynamic_gaussians),
        capture("dycheck-splits", "splits/val.json", Form::Json, dycheck),
        capture("dycheck-extra", "extra.json", Form::Json, dycheck),
        capture("capture-classes", "class_mapping.json", Form::Json, classes),
        capture("dnerf-transforms", "transforms_train.json", Form::Json, dnerf),
        capture("nerfstudio-transforms", "transforms.json", Form::Json, nerfstudio),
        capture("capture-points-ply", "sfm.ply", Form::Text, nerfstudio),
        capture("colmap-cameras-text", "sparse/0/cameras.txt", Form::Text, colmap_text),
        capture("colmap-images-text", "sparse/0/images.txt", Form::Text, colmap_text),
        capture("colmap-points-text", "sparse/0/points3D.txt", Form::Text, colmap_text),
        capture("colmap-cameras-binary", "sparse/0/cameras.bin", Form::Binary, colmap_binary),
        capture("colmap-images-binary", "sparse/0/images.bin", Form::Binary, colmap_binary),
        capture("colmap-points-binary", "sparse/0/points3D.bin", Form::Binary, colmap_binary),
        Reader {
            name: "camera-file",
            file: "views.json",
            form: Form::Json,
            write: |folder| {
                let help = cif::camera_file::FORMAT_HELP;
                let (start, end) = (help.find('[').unwrap(), help.find("\n\nname").unwrap());
                fs::write(folder.join("views.json"), &help[start..end]).unwrap();
            },
            read: |folder| shown(cif::camera_file::read(&folder.join("views.json"))),
        },
        Reader {
            name: "known-motion",
            file: "motion.json",
            form: Form::Json,
            write: |folder| capture::write_motion(folder, 3),
            read: known_motion,
        },
        Reader {
            name: "known-motion-tracks",
            file: "tracks.npz",
            form: Form::Binary,
            write: |folder| capture::write_motion(folder, 3),
            read: known_motion,
        },
        Reader {
            name: "masks-coco",
            file: "coco.json",
            form: Form::Json,
            write: |folder| {
                hypernerf(folder);
                fs::write(folder.join("coco.json"), mask_files::coco()).unwrap();
            },
            read: |folder| mask_files::import(folder, "coco.json"),
        },
        Reader {
            name: "masks-youtube-vis",
            file: "vis.json",
            form: Form::Json,
            write: |folder| {
                hypernerf(folder);
                fs::write(folder.join("vis.json"), mask_files::youtube_vis()).unwrap();
            },
            read: |folder| mask_files::import(folder, "vis.json"),
        },
        Reader {
            name: "masks-label-studio",
            file: "tasks.json",
            form: Form::Json,
            write: |folder| {
                hypernerf(folder);
                fs::write(folder.join("tasks.json"), mask_files::label_studio()).unwrap();
            },
            read: |folder| mask_files::import(folder, "tasks.json"),
        },
        Reader {
            name: "masks-cvat",
            file: "annotations.xml",
            form: Form::Binary,
            write: |folder| {
                hypernerf(folder);
                fs::write(folder.join("annotations.xml"), mask_files::cvat()).unwrap();
            },
            read: |folder| mask_files::import(folder, "annotations.xml"),
        },
        poses::reader("poses-colmap", "images.txt", Form::Text, poses::colmap),
        poses::reader("poses-transforms", "transforms.json", Form::Json, poses::transforms),
        poses::reader("poses-polycam", "cameras/0.json", Form::Json, poses::polycam),
        poses::reader("poses-reality-capture", "registration.csv", Form::Text, poses::reality_capture),
        poses::reader("poses-metashape", "cameras.xml", Form::Text, poses::metashape),
        Reader {
            name: "times",
            file: "times.csv",
            form: Form::Text,
            write: |folder| {
                fs::write(folder.join("times.csv"), "name,seconds\n0.png,0.5\n1.png,1.25\n").unwrap()
            },
            read: |folder| shown(cif_capture::times::read(&folder.join("times.csv"))),
        },
        Reader {
            name: "settings",
            file: "mine.toml",
            form: Form::Toml,
            write: |folder| {
                let text = toml::to_string(&TrainConfig::default()).unwrap();
                fs::write(folder.join("mine.toml"), text).unwrap();
            },
            read: |folder| {
                let mut layers = cif::settings::Layers::new(TrainConfig::default());
                shown(layers.file(&folder.join("mine.toml")))?;
                shown(layers.validated())
            },
        },
        Reader {
            name: "scene",
            file: "scene.cif",
            form: Form::Cif,
            write: |folder| field().save(folder.join("scene.cif")).unwrap(),
            read: |folder| {
                let path = folder.join("scene.cif");
                // Broken values are looked at and mended, too.
                if let Ok(broken) = Checkpoint::load_unchecked(&path) {
                    let _findings = health::check(&broken.field, None);
                }
                let field = Field::load(&path).map_err(|error| error.to_string())?;
                let _answers = field.query(&[DVec3::ZERO], 0.5);
                Ok(())
            },
        },
        Reader {
            name: "training-state",
            file: "scene.cif",
            form: Form::Cif,
            write: training_state,
            read: resume,
        },
        Reader {
            name: "splats-ply",
            file: "splats.ply",
            form: Form::Binary,
            write: |folder| {
                let options = cif_ply::ExportOptions::default();
                cif_ply::export(&graph(), &folder.join("splats.ply"), options).unwrap();
            },
            read: |folder| {
                let graph = cif_ply::read(&folder.join("splats.ply")).map_err(|error| error.to_string())?;
                // Not the reader's: may refuse, may not break.
                let _field = cif_scene::field_from_graph(&graph, "splats.ply");
                Ok(())
            },
        },
        Reader {
            name: "scene-glb",
            file: "scene.glb",
            form: Form::Glb,
            write: |folder| gltf(folder, "scene.glb"),
            read: |folder| read_gltf(&folder.join("scene.glb")),
        },
        Reader {
            name: "scene-gltf",
            file: "scene.gltf",
            form: Form::Json,
            write: |folder| gltf(folder, "scene.gltf"),
            read: |folder| read_gltf(&folder.join("scene.gltf")),
        },
        Reader {
            name: "scene-gltf-buffer",
            file: "scene.bin",
            form: Form::Binary,
            write: |folder| gltf(folder, "scene.gltf"),
            read: |folder| read_gltf(&folder.join("scene.gltf")),
        },
        Reader {
            name: "feature-map",
            file: "maps/000001.npy",
            form: Form::Binary,
            write: |folder| {
                capture::write(folder, 4);
                capture::write_maps(folder, 4, &folder.join("maps"), |id| [f32::from(id); 3]);
            },
            read: |folder| {
                let dataset =
                    Dataset::open(folder, &OpenOptions::default()).map_err(|error| error.to_string())?;
                let maps = cif_dataset::feature_maps(&dataset, &folder.join("maps"))
                    .map_err(|error| error.to_string())?;
                dataset.load_feature_map(1, &maps[&1]).map(drop).map_err(|error| error.to_string())
            },
        },
        Reader {
            name: "models",
            file: "models.toml",
            form: Form::Text,
            write: cif_test::models::write,
            read: |folder| {
                let models = cif_vision::Models::open(folder).map_err(|error| error.to_string())?;
                // A manifest may leave models out.
                models.embedder_name().map(drop).map_err(|error| error.to_string())
            },
        },
        Reader {
            name: "kept-mask",
            file: "mask.png",
            form: Form::Binary,
            write: |folder| {
                let mask =
                    cif_geometry::PixelGrid::from_pixels(8, 6, (0..48).map(|at| at % 5 == 0).collect());
                let found = cif_vision::grounding::FoundBox {
                    corners: [1.0, 1.0, 7.0, 5.0],
                    score: 0.5,
                    words: "steel jug".to_owned(),
                };
                cif_vision::cache::write(&folder.join("mask.png"), &mask, &[found]).unwrap();
            },
            read: |folder| {
                // A broken one is made anew, without a message.
                drop(cif_vision::cache::boxes(&folder.join("mask.png"), (8, 6)));
                Ok(())
            },
        },
        Reader {
            name: "label-glb",
            file: "scene.glb",
            form: Form::Glb,
            write: |folder| gltf(folder, "scene.glb"),
            read: |folder| {
                let path = folder.join("scene.glb");
                shown(cif_gltf::relabel(&path, &folder.join("other.glb"), "3", "blue mug", None))
            },
        },
    ]
}

fn known_motion(folder: &Path) -> Result<(), String> {
    let mut truth = MotionTruth::read(&folder.join("motion.json")).map_err(|error| error.to_string())?;
    shown(truth.add_tracks(&folder.join("tracks.npz")))
}

fn shown<T, E: std::fmt::Display>(result: Result<T, E>) -> Result<(), String> {
    result.map(drop).map_err(|error| error.to_string())
}

fn open_capture(folder: &Path) -> Result<(), String> {
    let dataset = Dataset::open(folder, &OpenOptions::default()).map_err(|error| error.to_string())?;
    (0..dataset.frames.len()).try_for_each(|frame| shown(dataset.load_frame(frame, [1.0; 3])))
}

fn read_gltf(path: &Path) -> Result<(), String> {
    let graph = cif_gltf::read_scene(path).map_err(|error| error.to_string())?;
    let _field = cif_scene::field_from_graph(&graph, "scene");
    Ok(())
}

/// Copies what a helper wrote into the folder.
fn adopt(made: &Path, folder: &Path) {
    fs::create_dir_all(folder).unwrap();
    for entry in fs::read_dir(made).unwrap() {
        let entry = entry.unwrap();
        let place = folder.join(entry.file_name());
        if entry.path().is_dir() {
            adopt(&entry.path(), &place);
        } else {
            fs::copy(entry.path(), place).unwrap();
        }
    }
}

fn hypernerf(folder: &Path) {
    adopt(captures::hypernerf(3).path(), folder);
    fs::write(folder.join("splits.json"), r#"{ "interp": ["000001"], "novel": [] }"#).unwrap();
}

/// A capture one of whose masks has a confidence.
fn confidence(folder: &Path) {
    hypernerf(folder);
    fs::create_dir(folder.join("masks/confidence")).unwrap();
    image::GrayImage::from_fn(captures::WIDTH, captures::HEIGHT, |x, y| image::Luma([(x * y) as u8]))
        .save(folder.join("masks/confidence/000001.png"))
        .unwrap();
}

fn neu3d(folder: &Path) {
    adopt(captures::neu3d(2, 2).path(), folder);
}

fn llff(folder: &Path) {
    adopt(captures::llff(3).path(), folder);
}

fn dynamic_gaussians(folder: &Path) {
    adopt(captures::dynamic_gaussians(3, 2).path(), folder);
    let rows: Vec<f64> = (0..35).map(|k| f64::from(k) * 0.01).collect();
    fs::write(folder.join("init_pt_cld.npz"), captures::npz("data", "(5, 7)", &rows)).unwrap();
}

fn dycheck(folder: &Path) {
    adopt(captures::dycheck().path(), folder);
}

/// A capture whose instances a map of classes names.
fn classes(folder: &Path) {
    hypernerf(folder);
    fs::remove_file(folder.join("instances.json")).unwrap();
    fs::write(folder.join("class_mapping.json"), r#"{ "0": "background", "1": "sphere_1", "2": "cube" }"#)
        .unwrap();
}

fn dnerf(folder: &Path) {
    adopt(captures::dnerf(2, 1).path(), folder);
}

fn nerfstudio(folder: &Path) {
    adopt(captures::nerfstudio(3).path(), folder);
    captures::edit_json(&folder.join("transforms.json"), |value| value["ply_file_path"] = json!("sfm.ply"));
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 1 2 3\n1 0.5 0 9 9 9\n";
    fs::write(folder.join("sfm.ply"), text).unwrap();
}

fn colmap_text(folder: &Path) {
    adopt(captures::colmap_text(3).path(), folder);
}

fn colmap_binary(folder: &Path) {
    adopt(captures::colmap_binary(3).path(), folder);
}

/// A capture whose first mask is a Cryptomatte.
fn cryptomatte(folder: &Path) {
    hypernerf(folder);
    for frame in ["000000", "000001", "000002"] {
        fs::remove_file(folder.join(format!("masks/{frame}.png"))).unwrap();
    }
    let layer = "CryptoObject";
    let pixels = (captures::WIDTH * captures::HEIGHT) as usize;
    let channels = [id_as_float(object_id("red mug")), 0.75, id_as_float(object_id("blue ball")), 0.25];
    let channels = ["r", "g", "b", "a"].into_iter().zip(channels).map(|(component, value)| {
        let name = format!("{layer}00.{component}");
        AnyChannel::new(name.as_str(), FlatSamples::F32(vec![value; pixels]))
    });
    let hexadecimal = |name: &str| format!("{:08x}", object_id(name));
    let manifest =
        json!({ "red mug": hexadecimal("red mug"), "blue ball": hexadecimal("blue ball") }).to_string();
    let mut attributes = LayerAttributes::named("main");
    for (name, value) in
        [("name", layer), ("hash", HASH), ("conversion", CONVERSION), ("manifest", manifest.as_str())]
    {
        let name = Text::new_or_none(format!("cryptomatte/{}/{name}", layer_key(layer))).unwrap();
        attributes.other.insert(name, AttributeValue::Text(Text::new_or_none(value).unwrap()));
    }
    let size = Vec2(captures::WIDTH as usize, captures::HEIGHT as usize);
    let layer = Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(channels.collect()));
    Image::from_layers(ImageAttributes::new(IntegerBounds::from_dimensions(size)), vec![layer])
        .write()
        .to_file(folder.join("masks/000000.exr"))
        .unwrap();
    fs::write(folder.join("masks/objects.json"), r#"{ "red mug": 1, "blue ball": 2 }"#).unwrap();
}

/// Two objects, one of which moves, and a background.
fn field() -> Field {
    let positions: Vec<[f32; 3]> = (0..30_u8)
        .map(|k| [f32::from(k % 5) * 0.2, f32::from(k / 5) * 0.2, f32::from(k % 3) * 0.2])
        .collect();
    let mut gaussians = Gaussians::from_points(&positions, &vec![[0.3, 0.5, 0.7]; 30]).unwrap();
    gaussians.opacity_logits.fill(2.0);
    gaussians.occupancy_logits.fill(2.0);
    let owner = |row: usize| [Some(0_u16), Some(1), None][row / 10];
    let mut identities = Identities::empty();
    (0..30).for_each(|row| identities.push_certain(owner(row)));
    let config = DeformationConfig {
        spatial_resolution: [3, 2, 4],
        time_resolution: 3,
        multipliers: vec![1, 2],
        channels: 2,
        width: 4,
        heads: Heads { position: true, scale: true, rotation: true, opacity: false, sh: false },
        time_encoding: TimeEncoding::Compact,
    };
    let bounds = Bounds { low: DVec3::splat(-1.0), high: DVec3::splat(2.0) };
    let pose = |time: f64| TrackPose {
        time,
        translation: DVec3::new(0.2 + time, 0.3, 0.1),
        rotation: DQuat::from_rotation_z(time),
    };
    let still = TrackGroup::still("mug", DVec3::new(0.2, 0.3, 0.1));
    let groups = vec![TrackGroup { deformed: false, poses: vec![pose(0.0), pose(0.5), pose(1.0)], ..still }];
    let group_of = (0..30).map(|row| if owner(row) == Some(0) { 0 } else { NO_GROUP }).collect();
    let camera = PinholeCamera {
        width: 64,
        height: 48,
        focal_px: DVec2::splat(50.0),
        principal_px: DVec2::new(32.0, 24.0),
        camera_from_world: RigidTransform { translation: DVec3::Z, ..RigidTransform::IDENTITY },
    };
    let record = |time_index| RecordedCamera { name: "left".to_owned(), time_index, trained: true, camera };
    let instance = |id, label: &str| Instance {
        id,
        label: label.to_owned(),
        category: "thing".to_owned(),
        taxonomies: Default::default(),
    };
    Field {
        gaussians,
        deformation: Some(Deformation::new(config, bounds, 1.0, 1, false).unwrap()),
        tracks: Some(Tracks { group_of, groups }),
        identities: Some(identities),
        instances: vec![instance(3, "red mug"), instance(7, "blue ball")],
        timeline: Timeline { times: vec![0.0, 0.5, 1.0], frames_per_second: 24.0 },
        cameras: (0..3).map(record).collect(),
        sh_degree: 1,
        background: [1.0; 3],
        sort_metric: SortMetric::Z,
        extent: 1.0,
        record: Default::default(),
    }
}

fn graph() -> cif_scene::SceneGraph {
    let options =
        SceneOptions { most_expensive_motion: cif_gltf::MOST_EXPENSIVE_MOTION, ..SceneOptions::default() };
    cif_scene::build(&field(), &options).unwrap()
}

fn gltf(folder: &Path, name: &str) {
    cif_gltf::export(&graph(), &folder.join(name), cif_gltf::ExportOptions::default()).unwrap();
}

/// A run that was interrupted before its first step, and the capture next to it.
fn training_state(folder: &Path) {
    capture::write(&folder.join("capture"), 4);
    let dataset = Dataset::open(folder.join("capture"), &OpenOptions::default()).unwrap();
    let mut config = TrainConfig::preset(Preset::Draft, dataset.layout);
    (config.stages.coarse, config.stages.fine, config.stages.instance) = (4, 8, 4);
    config.model.max_initial_points = 20;
    config.model.spatial_resolution = [2; 3];
    config.model.multipliers = vec![1];
    (config.model.channels, config.model.width) = (1, 4);
    Trainer::new(dataset, config).unwrap().checkpoint(true).save(folder.join("scene.cif")).unwrap();
}

fn resume(folder: &Path) -> Result<(), String> {
    static CAPTURE: OnceLock<Dataset> = OnceLock::new();
    let open = || Dataset::open(folder.join("capture"), &OpenOptions::default()).unwrap();
    let dataset = CAPTURE.get_or_init(open).clone();
    let path = folder.join("scene.cif");
    let checkpoint = Checkpoint::load(&path).map_err(|error| error.to_string())?;
    let resumed = Trainer::resume(dataset, checkpoint).map_err(|error| error.of_scene(&path));
    let mut trainer = resumed.map_err(|error| error.to_string())?;
    // What a state that was taken leads to is not read any more; it may fail, but not break.
    let _outcome = trainer.run(&mut |_, _| Control::Stop);
    Ok(())
}
