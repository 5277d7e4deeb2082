//! RealityCapture: the registration as "Internal/External camera parameters", a CSV file. Focal lengths are of
//! 35 mm film; angles as nerfstudio's importer reads them. The world has z up; its unit is what was set there.

use std::collections::BTreeMap;
use std::path::Path;

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec3};

use super::imported::{Imported, add};
use crate::Error;
use crate::frames::Shot;
use crate::poses::{Lens, Poses};
use crate::times::entry;

/// Width of 35 mm film, to which focal lengths refer, mm.
const FILM_MM: f64 = 36.0;

pub(super) fn read(path: &Path, shots: &[Shot]) -> Result<Imported, Error> {
    let bytes = cif_input::read_text(path).map_err(Error::io("read", path))?;
    let text = String::from_utf8_lossy(&bytes);
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let heading = lines.next().map(|(_, line)| line.trim()).unwrap_or_default();
    let columns: Vec<&str> = heading.split(',').map(str::trim).collect();
    let refused = |problem: String| {
        Error::refused(
            format!("{}: {problem}", path.display()),
            "export the registration from RealityCapture as \"Internal/External camera parameters\"",
        )
    };
    // The table knows names alone; sizes are those of the images.
    let sizes: BTreeMap<String, (u32, u32)> = shots
        .iter()
        .map(|shot| (shot.name.rsplit('/').next().unwrap_or(&shot.name).to_owned(), shot.size))
        .collect();
    let mut poses = Poses::default();
    for (number, line) in lines {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let cell = |name: &str| columns.iter().position(|column| *column == name).and_then(|k| cells.get(k));
        let value = |name: &str| {
            let value =
                cell(name).and_then(|text| text.parse::<f64>().ok()).filter(|value| value.is_finite());
            value.ok_or_else(|| refused(format!("line {}: column {name} has no number", number + 1)))
        };
        let or_zero = |name: &str| if columns.contains(&name) { value(name) } else { Ok(0.0) };
        let name = *cell("#name").ok_or_else(|| refused("there is no column #name".to_owned()))?;
        let Some(size) = entry(&sizes, name).copied() else { continue };
        let (width, height) = (f64::from(size.0), f64::from(size.1));
        let side = width.max(height);
        let rotation = DMat3::from_rotation_z(-value("heading")?.to_radians())
            * DMat3::from_rotation_x(value("pitch")?.to_radians())
            * DMat3::from_rotation_y(value("roll")?.to_radians());
        let focal = value("f")? * side / FILM_MM;
        if focal <= 0.0 {
            return Err(refused(format!("line {}: the focal length is not positive", number + 1)));
        }
        let lens = Lens {
            size,
            focal_px: [focal; 2],
            // Offsets are in units of film width as well.
            principal_px: [
                or_zero("px")? * side / FILM_MM + 0.5 * width,
                or_zero("py")? * side / FILM_MM + 0.5 * height,
            ],
            distortion: LensDistortion {
                radial: [or_zero("k1")?, or_zero("k2")?, or_zero("k3")?, or_zero("k4")?],
                tangential: [or_zero("t1")?, or_zero("t2")?],
                skew_px: 0.0,
            },
        };
        let world_from_camera = RigidTransform {
            // From x right, y up, z backwards.
            rotation: rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
            translation: DVec3::new(value("x")?, value("y")?, value("alt")?),
        };
        add(&mut poses, name.to_owned(), lens, world_from_camera);
    }
    if poses.images.is_empty() {
        return Err(refused("none of its images is given".to_owned()));
    }
    Ok(Imported {
        poses,
        times: BTreeMap::new(),
        tool: "RealityCapture",
        metres_known: false,
        up_known: true,
        of_stored_pixels: false,
        notes: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;

    #[test]
    fn a_registration_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("registration.csv");
        let head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n";
        // Level, looking north (+y), and east after a heading of 90 degrees.
        let rows = "a.jpg,1,2,3,0,90,0,36,0,0,-0.1,0,0,0,0,0\nb.jpg,4,5,6,90,90,0,36,0.36,0,0,0,0,0,0,0\n";
        std::fs::write(&path, format!("{head}{rows}")).unwrap();
        let shot = |name: &str| Shot {
            camera: "a".to_owned(),
            name: name.to_owned(),
            file: name.into(),
            time: None,
            size: (1000, 500),
            turned: cif_dataset::orientation::Orientation::NoTransforms,
            impression: Impression::of(&board(50, 0)),
            source: None,
        };
        let found = read(&path, &[shot("cam/a.jpg"), shot("cam/b.jpg")]).unwrap();
        let of = |name: &str| found.poses.images[name];
        let near = |a: DVec3, b: DVec3| (a - b).length() < 1e-9;
        assert!(near(of("a.jpg").world_from_camera.translation, DVec3::new(1.0, 2.0, 3.0)));
        assert!(near(of("a.jpg").world_from_camera.rotation * DVec3::Z, DVec3::Y));
        assert!(near(of("a.jpg").world_from_camera.rotation * -DVec3::Y, DVec3::Z));
        assert!(near(of("b.jpg").world_from_camera.rotation * DVec3::Z, DVec3::X));
        let lens = &found.poses.lenses[of("b.jpg").lens];
        assert_eq!((lens.focal_px, lens.principal_px), ([1000.0; 2], [510.0, 250.0]));
        std::fs::write(&path, format!("{head}a.jpg,1,2,3,0,north,0,36,0,0,0,0,0,0,0,0\n")).unwrap();
        let error = read(&path, &[shot("a.jpg")]).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("pitch"), "{error}");
    }
}
