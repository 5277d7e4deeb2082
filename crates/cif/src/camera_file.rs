//! Camera files: views that no capture has.

use std::collections::BTreeMap;
use std::path::Path;

use cif_geometry::{PinholeCamera, RigidTransform};
use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;

use crate::error::Error;

/// The format, for `--help`.
pub const FORMAT_HELP: &str = r#"Camera file (JSON): a list of views, each with a size in pixels, a focal length and a pose.

  [
    { "name": "above", "time": 0.5, "width": 640, "height": 480, "vertical_fov_deg": 45,
      "position": [0, -1, 1.5], "look_at": [0, 0, 0], "up": [0, 0, 1] },
    { "name": "as_captured", "width": 640, "height": 480, "focal_px": [600, 600],
      "principal_px": [320, 240],
      "world_from_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]] }
  ]

name       file name of the pictures (default: 0000, 0001, ...)
time       normalised time in [0, 1]; --time overrides it (default: 0)
focal      either focal_px [x, y] or vertical_fov_deg
principal  principal_px, default the image centre; the centre of the first pixel is (0.5, 0.5)
pose       either position, look_at and up, in world units, or world_from_camera, 4 rows of 4, for a
           camera that looks along +z with x to the right and y down"#;

/// A view to render.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// File name of its pictures, without extension.
    pub name: String,
    /// Normalised time; `None` leaves it to the command.
    pub time: Option<f64>,
    /// The camera.
    pub camera: PinholeCamera,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: Option<String>,
    time: Option<f64>,
    width: u32,
    height: u32,
    focal_px: Option<[f64; 2]>,
    vertical_fov_deg: Option<f64>,
    principal_px: Option<[f64; 2]>,
    position: Option<[f64; 3]>,
    look_at: Option<[f64; 3]>,
    up: Option<[f64; 3]>,
    world_from_camera: Option<[[f64; 4]; 4]>,
}

/// Reads a camera file.
///
/// # Errors
/// When it cannot be read, is not in the format, or describes an impossible camera.
pub fn read(path: &Path) -> Result<Vec<View>, Error> {
    let text = cif_input::read_to_string(path).map_err(Error::io("read the camera file", path))?;
    let entries: Vec<Entry> = serde_json::from_str(&text).map_err(|error| {
        let start =
            text.split_inclusive('\n').take(error.line().saturating_sub(1)).map(str::len).sum::<usize>();
        let at = start + error.column().saturating_sub(1);
        Error::in_text(path, &text, at..at + 1, error.to_string(), Some(FORMAT_HELP.to_owned()))
    })?;
    if entries.is_empty() {
        return Err(Error::failed(format!("{} holds no view", path.display()), FORMAT_HELP));
    }
    let mut names = BTreeMap::new();
    entries
        .into_iter()
        .enumerate()
        .map(|(index, entry)| {
            let name = entry.name.clone().unwrap_or_else(|| format!("{index:04}"));
            let refused = |problem: String| {
                Error::failed(format!("{}: view {index} ({name}): {problem}", path.display()), FORMAT_HELP)
            };
            // Some file systems take names that differ in case for one.
            if let Some(other) = names.insert(name.to_lowercase(), index) {
                return Err(refused(format!("view {other} has this name too; every view needs its own")));
            }
            view(entry, &name).map_err(refused)
        })
        .collect()
}

fn view(entry: Entry, name: &str) -> Result<View, String> {
    cif_geometry::camera::check_image_size(entry.width, entry.height)?;
    cif_output::check_name(name).map_err(|problem| format!("name {name:?} {problem}"))?;
    let size = DVec2::new(f64::from(entry.width), f64::from(entry.height));
    let focal_px = match (entry.focal_px, entry.vertical_fov_deg) {
        (Some(focal), None) => DVec2::from(focal),
        (None, Some(degrees)) if degrees > 0.0 && degrees < 180.0 => {
            DVec2::splat(size.y / 2.0 / (degrees.to_radians() / 2.0).tan())
        }
        (None, Some(degrees)) => return Err(format!("vertical_fov_deg {degrees}: expected 0 to 180")),
        _ => return Err("give either focal_px or vertical_fov_deg".to_owned()),
    };
    if !(focal_px.is_finite() && focal_px.cmpgt(DVec2::ZERO).all()) {
        return Err(format!("focal_px [{}, {}]: expected positive numbers", focal_px.x, focal_px.y));
    }
    let world_from_camera = match (entry.world_from_camera, entry.position, entry.look_at) {
        (Some(rows), None, None) => from_rows(&rows)?,
        (None, Some(position), Some(target)) => {
            look_at(position.into(), target.into(), entry.up.map_or(DVec3::Z, DVec3::from))?
        }
        _ => return Err("give either world_from_camera, or position and look_at".to_owned()),
    };
    if entry.time.is_some_and(|time| !(0.0..=1.0).contains(&time)) {
        return Err("time: expected 0 to 1".to_owned());
    }
    let principal_px = entry.principal_px.map_or(size / 2.0, DVec2::from);
    if !principal_px.is_finite() {
        return Err("principal_px: expected finite numbers".to_owned());
    }
    Ok(View {
        name: name.to_owned(),
        time: entry.time,
        camera: PinholeCamera {
            width: entry.width,
            height: entry.height,
            focal_px,
            principal_px,
            camera_from_world: world_from_camera.inverse(),
        },
    })
}

fn from_rows(rows: &[[f64; 4]; 4]) -> Result<RigidTransform, String> {
    let row = |index: usize| DVec3::new(rows[index][0], rows[index][1], rows[index][2]);
    let transform = RigidTransform {
        rotation: DMat3::from_cols(row(0), row(1), row(2)).transpose(),
        translation: DVec3::new(rows[0][3], rows[1][3], rows[2][3]),
    };
    let error = transform.orthonormality_error();
    let rigid = error < 1e-3 && transform.translation.is_finite() && rows[3] == [0.0, 0.0, 0.0, 1.0];
    if rigid { Ok(transform) } else { Err("world_from_camera is no rotation and translation".to_owned()) }
}

fn look_at(position: DVec3, target: DVec3, up: DVec3) -> Result<RigidTransform, String> {
    let problem = || "position, look_at and up do not define a direction".to_owned();
    let forward = (target - position).try_normalize().ok_or_else(problem)?;
    let right = forward.cross(up).try_normalize().ok_or_else(problem)?;
    let down = forward.cross(right);
    Ok(RigidTransform { rotation: DMat3::from_cols(right, down, forward), translation: position })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<View>, Error> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cameras.json");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn the_documented_example_is_read() {
        let start = FORMAT_HELP.find('[').unwrap();
        let end = FORMAT_HELP.find("\n\nname").unwrap();
        let views = parse(&FORMAT_HELP[start..end]).unwrap();
        assert_eq!(views.len(), 2);
        let camera = &views[0].camera;
        // What is looked at lies in the image centre, and up is up.
        let (pixel, _) = camera.project(DVec3::ZERO).unwrap();
        assert!((pixel - DVec2::new(320.0, 240.0)).length() < 1e-9);
        assert!(camera.project(DVec3::new(0.0, 0.0, 0.1)).unwrap().0.y < 240.0);
        assert!(camera.project(DVec3::new(0.1, 0.0, 0.0)).unwrap().0.x > 320.0);
        assert!(camera.camera_from_world.orthonormality_error() < 1e-12);
        assert_eq!(views[1].camera.centre(), DVec3::new(0.0, 0.0, -2.0));
        assert_eq!((views[0].time, views[1].time), (Some(0.5), None));
    }

    #[test]
    fn impossible_cameras_are_named() {
        let size = r#"[{"width": 60000, "height": 60000, "focal_px": [5, 5]}]"#;
        let error = parse(size).unwrap_err().to_string();
        assert!(error.contains("view 0") && error.contains("3600000000"), "{error}");
        let base = r#""name": "a", "width": 8, "height": 8"#;
        for (rest, expected) in [
            (r#""position": [0,0,0], "look_at": [0,0,1]"#, "focal_px"),
            (r#""focal_px": [5, -1], "position": [0,0,0], "look_at": [1,0,0]"#, "positive"),
            (r#""focal_px": [5, 5], "position": [0,0,0], "look_at": [0,0,0]"#, "direction"),
            (r#""focal_px": [5, 5], "position": [0,0,0], "look_at": [0,0,1]"#, "direction"),
            (r#""focal_px": [5, 5]"#, "world_from_camera"),
            (
                r#""focal_px": [5, 5], "world_from_camera": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"#,
                "rotation",
            ),
            (r#""focal_px": [5, 5], "position": [0,0,0], "look_at": [1,0,0], "time": 2"#, "0 to 1"),
        ] {
            let error = parse(&format!("[{{{base}, {rest}}}]")).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("view 0 (a)"), "{error}");
        }
        assert!(parse("[]").unwrap_err().to_string().contains("no view"));
        let error = parse("[\n{\"width\": 8, \"hight\": 8}]").unwrap_err().to_string();
        assert!(error.contains("cameras.json:2") && error.contains("hight"), "{error}");
        assert!(parse("[{\"name\": \"../a\", \"width\": 8, \"height\": 8}]").is_err());
    }
}
