//! Poses of other tools, of two photographs.

use std::fs;
use std::path::Path;

use cif_capture::frames::{self, Choice};
use cif_capture::source::Source;
use cif_capture::{Hooks, import};

use crate::mutate::Form;
use crate::readers::Reader;

/// A reader of poses of a tool, whose files `write` puts into the folder.
pub(crate) fn reader(name: &'static str, file: &'static str, form: Form, write: fn(&Path)) -> Reader {
    Reader { name, file, form, write, read }
}

/// Poses for the photographs of the folder, which are found anew.
fn read(folder: &Path) -> Result<(), String> {
    let photos = tempfile::tempdir().unwrap();
    let files: Vec<_> = (0..2)
        .map(|k| {
            let path = photos.path().join(format!("{k}.png"));
            image::GrayImage::from_fn(64, 48, |x, y| image::Luma([(7 * x + 3 * y) as u8]))
                .save(&path)
                .unwrap();
            path
        })
        .collect();
    let source = Source { camera: "walk".into(), path: photos.path().into(), photographs: Some(files) };
    let scratch = photos.path().join("frames");
    let mut shots =
        frames::collect(&[source], &Choice::default(), &scratch, &Hooks::silent(), &mut Vec::new()).unwrap();
    let path = ["cameras.xml", "registration.csv"]
        .map(|name| folder.join(name))
        .into_iter()
        .find(|path| path.exists())
        .unwrap_or_else(|| folder.to_owned());
    let found = import::read(&path, &shots).map_err(|error| error.to_string())?;
    found.matched(&path, &mut shots).map(drop).map_err(|error| error.to_string())
}

pub(crate) fn colmap(folder: &Path) {
    fs::write(folder.join("cameras.txt"), "1 PINHOLE 64 48 50 50 32 24\n").unwrap();
    fs::write(folder.join("images.txt"), "1 1 0 0 0 1 2 3 1 0.png\n\n2 1 0 0 0 0 0 4 1 1.png\n\n").unwrap();
}

pub(crate) fn transforms(folder: &Path) {
    let text = r#"{"fl_x": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [{"file_path": "0.png", "time": 1.5,
        "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]}]}"#;
    fs::write(folder.join("transforms.json"), text).unwrap();
}

pub(crate) fn polycam(folder: &Path) {
    let text = r#"{"fx": 60, "fy": 60, "cx": 32, "cy": 24, "width": 64, "height": 48, "timestamp": 2500000,
        "t_00": 1, "t_01": 0, "t_02": 0, "t_03": 0.25, "t_10": 0, "t_11": 1, "t_12": 0, "t_13": 1.5,
        "t_20": 0, "t_21": 0, "t_22": 1, "t_23": -2}"#;
    fs::create_dir(folder.join("cameras")).unwrap();
    fs::write(folder.join("cameras/0.json"), text).unwrap();
}

pub(crate) fn reality_capture(folder: &Path) {
    let text =
        "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n0.png,1,2,3,0,90,0,36,0,0,0,0,0,0,0,0\n";
    fs::write(folder.join("registration.csv"), text).unwrap();
}

/// A rig of two.
pub(crate) fn metashape(folder: &Path) {
    let calibration =
        "<resolution width=\"64\" height=\"48\"/><calibration><f>60</f><k1>-0.1</k1></calibration>";
    let text = format!(
        "<document><chunk><sensors><sensor id=\"0\" type=\"frame\">{calibration}</sensor><sensor id=\"1\" \
         type=\"frame\">{calibration}<rotation>1 0 0 0 1 0 0 0 1</rotation><location>1 0 0</location></sensor></sensors>\
         <cameras><camera id=\"0\" sensor_id=\"0\" label=\"0.png\"><transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform>\
         </camera><camera id=\"1\" sensor_id=\"1\" master_id=\"0\" label=\"1.png\"/></cameras></chunk></document>"
    );
    fs::write(folder.join("cameras.xml"), text).unwrap();
}
