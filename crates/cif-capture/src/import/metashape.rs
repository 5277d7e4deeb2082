//! Metashape: cameras exported as XML (File > Export > Export Cameras, Agisoft XML). Read as nerfstudio's
//! importer does, but for p1 and p2, which OpenCV names the other way round (camera models of the Metashape
//! manual), and with the scale of the chunk.
//!
//! Axes and unit are those of the chunk's reference, the origin is that of its transform: georeferenced worlds
//! begin in the middle of the earth. The file does not say that the unit is a metre and +z is up for
//! certain.
//!
//! Of a rig, the master camera has a pose at each moment, and the sensors of the others have a rotation and a location in
//! it, the same at all moments.

use std::collections::BTreeMap;
use std::path::Path;

use cif_geometry::{LensDistortion, RigidTransform};
use glam::{DMat3, DVec3};
use roxmltree::{Document, Node};

use super::imported::{Imported, add};
use crate::Error;
use crate::poses::{Lens, Poses};
use crate::similarity::Similarity;

/// Skews that change no pixel by more than about half of one are left out.
const MAX_SKEW_PX: f64 = 1.0;

/// A camera with a pose.
struct Camera<'a> {
    label: &'a str,
    sensor: Node<'a, 'a>,
    component: Option<&'a str>,
    chunk_from_camera: RigidTransform,
}

pub(super) fn read(path: &Path) -> Result<Imported, Error> {
    let text = cif_input::read_to_string(path).map_err(Error::io("read", path))?;
    let refused = |problem: String| {
        Error::refused(
            format!("{}: {problem}", path.display()),
            "export the cameras again, as Agisoft XML (File > Export > Export Cameras)",
        )
    };
    let document = Document::parse(&text).map_err(|error| refused(format!("no readable XML ({error})")))?;
    let chunk = document
        .descendants()
        .find(|node| node.has_tag_name("chunk"))
        .ok_or_else(|| refused("it has no <chunk>, as cameras of Metashape do".to_owned()))?;
    let sensors: BTreeMap<&str, Node<'_, '_>> = chunk
        .descendants()
        .filter(|node| node.has_tag_name("sensor"))
        .filter_map(|node| Some((node.attribute("id")?, node)))
        .collect();
    let nodes: Vec<Node<'_, '_>> = chunk.descendants().filter(|node| node.has_tag_name("camera")).collect();
    let by_id: BTreeMap<&str, Node<'_, '_>> =
        nodes.iter().filter_map(|node| Some((node.attribute("id")?, *node))).collect();
    let mut cameras = Vec::new();
    let mut unplaced = Vec::new();
    for node in nodes.iter().filter(|node| !is_off(**node)) {
        match camera(*node, &sensors, &by_id).map_err(&refused)? {
            Some(camera) => cameras.push(camera),
            None => unplaced.extend(node.attribute("label")),
        }
    }
    let mut notes = Vec::new();
    if !unplaced.is_empty() {
        notes.push(format!(
            "{}: {} cameras were not aligned and have no pose, the first is {}",
            path.display(),
            unplaced.len(),
            unplaced[0]
        ));
    }
    let worlds = worlds(chunk).map_err(&refused)?;
    // Components without a place in the world have nothing to do with each other.
    let largest = largest(&cameras);
    let aligned = cameras.len();
    cameras.retain(|camera| {
        camera.component == largest
            || (world_of(&worlds, camera.component).is_some() && world_of(&worlds, largest).is_some())
    });
    if cameras.len() < aligned {
        notes.push(format!(
            "{}: {} of {aligned} cameras belong to other components than most, and are left out",
            path.display(),
            aligned - cameras.len()
        ));
    }
    let origin = world_of(&worlds, largest).map_or(DVec3::ZERO, |world| world.translation);
    let mut poses = Poses::default();
    for camera in cameras {
        let lens =
            lens(camera.sensor).map_err(|problem| refused(format!("camera {}: {problem}", camera.label)))?;
        let mut world_from_camera = match world_of(&worlds, camera.component) {
            Some(world) => world.camera(&camera.chunk_from_camera),
            None => camera.chunk_from_camera,
        };
        world_from_camera.translation -= origin;
        add(&mut poses, camera.label.to_owned(), lens, world_from_camera);
    }
    if poses.images.is_empty() {
        return Err(refused("none of its cameras is enabled and aligned".to_owned()));
    }
    Ok(Imported {
        poses,
        times: BTreeMap::new(),
        tool: "Metashape",
        metres_known: false,
        up_known: false,
        of_stored_pixels: true,
        notes,
    })
}

fn is_off(camera: Node<'_, '_>) -> bool {
    matches!(camera.attribute("enabled"), Some("0" | "false" | "False"))
}

/// A camera; `None` where neither it nor, in a rig, its master was aligned.
fn camera<'a>(
    node: Node<'a, 'a>,
    sensors: &BTreeMap<&str, Node<'a, 'a>>,
    cameras: &BTreeMap<&str, Node<'a, 'a>>,
) -> Result<Option<Camera<'a>>, String> {
    let Some(label) = node.attribute("label") else { return Ok(None) };
    let of_camera = |problem: String| format!("camera {label}: {problem}");
    let sensor_of = |node: Node<'a, 'a>| {
        node.attribute("sensor_id")
            .and_then(|id| sensors.get(id).copied())
            .ok_or_else(|| of_camera("its sensor is not in the file".to_owned()))
    };
    let component = |node: Node<'a, 'a>| node.attribute("component_id");
    if let Some(transform) = child(node, "transform") {
        let chunk_from_camera = pose(transform).map_err(of_camera)?;
        return Ok(Some(Camera {
            label,
            sensor: sensor_of(node)?,
            component: component(node),
            chunk_from_camera,
        }));
    }
    let master = node.attribute("master_id").filter(|id| node.attribute("id") != Some(id));
    let Some(master) = master else { return Ok(None) };
    let master = cameras
        .get(master)
        .copied()
        .ok_or_else(|| of_camera(format!("the master of its rig, {master}, is not in the file")))?;
    let Some(transform) = child(master, "transform") else { return Ok(None) };
    let sensor = sensor_of(node)?;
    let master_from_camera = place_in_rig(sensor).map_err(of_camera)?;
    let chunk_from_master = pose(transform).map_err(of_camera)?;
    Ok(Some(Camera {
        label,
        sensor,
        component: component(node).or(component(master)),
        chunk_from_camera: chunk_from_master.compose(&master_from_camera),
    }))
}

/// The pose of a camera in the chunk.
fn pose(transform: Node<'_, '_>) -> Result<RigidTransform, String> {
    let m = numbers::<16>(transform)?;
    // Rows; the camera has x right, y down, z forwards.
    let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
    let pose = RigidTransform {
        rotation: DMat3::from_cols(column(0), column(1), column(2)),
        translation: column(3),
    };
    if pose.orthonormality_error() > 1e-3 {
        return Err("its pose is no rigid transform".to_owned());
    }
    Ok(pose)
}

/// Where a sensor lies in the master of its rig.
fn place_in_rig(sensor: Node<'_, '_>) -> Result<RigidTransform, String> {
    let has_numbers = |node: &Node<'_, '_>| node.text().is_some_and(|text| !text.trim().is_empty());
    let of = |name: &str| child(sensor, name).filter(has_numbers);
    let (Some(rotation), Some(location)) = (of("rotation"), of("location")) else {
        return Err(
            "its sensor has no rotation and location in its rig; let Metashape estimate both".to_owned()
        );
    };
    let place = RigidTransform {
        rotation: DMat3::from_cols_array(&numbers::<9>(rotation)?).transpose(),
        translation: DVec3::from_array(numbers::<3>(location)?),
    };
    if place.orthonormality_error() > 1e-3 {
        return Err("the rotation of its sensor in the rig is none".to_owned());
    }
    Ok(place)
}

/// The component with most cameras, of equal ones the first.
fn largest<'a>(cameras: &[Camera<'a>]) -> Option<&'a str> {
    let mut counts: BTreeMap<Option<&str>, usize> = BTreeMap::new();
    for camera in cameras {
        *counts.entry(camera.component).or_default() += 1;
    }
    counts.into_iter().rev().max_by_key(|(_, count)| *count).and_then(|(component, _)| component)
}

/// Places in the world by component; that of the chunk itself, which older versions write, under `None`.
type Worlds<'a> = BTreeMap<Option<&'a str>, Similarity>;

/// The place of a component, where it has one.
fn world_of<'a, 'b>(worlds: &'b Worlds<'a>, component: Option<&'a str>) -> Option<&'b Similarity> {
    worlds.get(&component).or_else(|| worlds.get(&None))
}

fn worlds<'a>(chunk: Node<'a, 'a>) -> Result<Worlds<'a>, String> {
    let components = chunk.descendants().filter(|node| node.has_tag_name("component"));
    let mut found = BTreeMap::new();
    for node in components.chain([chunk]) {
        let Some(transform) = child(node, "transform") else { continue };
        let or =
            |name: &str, default: Similarity, read: &dyn Fn(Node<'_, '_>) -> Result<Similarity, String>| {
                child(transform, name).map_or(Ok(default), read)
            };
        let world = or("rotation", Similarity::IDENTITY, &|node| {
            let m = numbers::<9>(node)?;
            Ok(Similarity { rotation: DMat3::from_cols_array(&m).transpose(), ..Similarity::IDENTITY })
        })?;
        let world = or("translation", world, &|node| {
            Ok(Similarity { translation: DVec3::from_array(numbers::<3>(node)?), ..world })
        })?;
        let world = or("scale", world, &|node| Ok(Similarity { scale: numbers::<1>(node)?[0], ..world }))?;
        let axes = RigidTransform { rotation: world.rotation, translation: DVec3::ZERO };
        if axes.orthonormality_error() > 1e-3 || world.scale <= 0.0 {
            return Err("the transform of its chunk is no rotation with a scale".to_owned());
        }
        found.insert(node.attribute("id").filter(|_| node != chunk), world);
    }
    Ok(found)
}

/// The lens of a sensor: its adjusted calibration, where it has several.
fn lens(sensor: Node<'_, '_>) -> Result<Lens, String> {
    let kind = sensor.attribute("type").unwrap_or("frame");
    if kind != "frame" {
        return Err(format!(
            "its sensor is of the kind {kind:?}, and only frame cameras can be read; let Metashape undistort the \
             photographs (Export > Undistort Photos), and export their cameras"
        ));
    }
    let calibrations: Vec<Node<'_, '_>> =
        sensor.children().filter(|node| node.has_tag_name("calibration")).collect();
    let adjusted = calibrations.iter().find(|node| node.attribute("class") == Some("adjusted"));
    let calibration = *adjusted.or(calibrations.first()).ok_or("its sensor has no calibration")?;
    let resolution = child(sensor, "resolution").or_else(|| child(calibration, "resolution"));
    let side = |name: &str| {
        let text = resolution.and_then(|node| node.attribute(name));
        text.and_then(|text| text.trim().parse::<u32>().ok()).filter(|side| *side > 0)
    };
    let size = side("width").zip(side("height")).ok_or("its sensor has no resolution")?;
    let value = |name: &str| match child(calibration, name) {
        Some(node) => numbers::<1>(node).map(|[value]| value),
        None => Ok(0.0),
    };
    let (focal, wider, skew) = (value("f")?, value("b1")?, value("b2")?);
    if focal <= 0.0 || focal + wider <= 0.0 {
        return Err("its focal length is not positive".to_owned());
    }
    if skew.abs() > MAX_SKEW_PX || value("p3")? != 0.0 || value("p4")? != 0.0 {
        return Err("its calibration has a skew b2, p3 or p4, which cannot be read; optimise the cameras without these, \
                    or let Metashape undistort the photographs"
            .to_owned());
    }
    Ok(Lens {
        size,
        focal_px: [focal + wider, focal],
        principal_px: [0.5 * f64::from(size.0) + value("cx")?, 0.5 * f64::from(size.1) + value("cy")?],
        distortion: LensDistortion {
            radial: [value("k1")?, value("k2")?, value("k3")?, value("k4")?],
            tangential: [value("p2")?, value("p1")?],
            skew_px: 0.0,
        },
    })
}

fn child<'a, 'input>(node: Node<'a, 'input>, name: &str) -> Option<Node<'a, 'input>> {
    node.children().find(|child| child.has_tag_name(name))
}

/// The numbers of an element.
fn numbers<const N: usize>(node: Node<'_, '_>) -> Result<[f64; N], String> {
    let text = node.text().unwrap_or_default();
    let values: Option<Vec<f64>> = text
        .split_whitespace()
        .map(|part| part.parse().ok().filter(|value: &f64| value.is_finite()))
        .collect();
    values
        .and_then(|values| values.try_into().ok())
        .ok_or_else(|| format!("<{}> holds {text:?}, where {N} numbers are expected", node.tag_name().name()))
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    const SENSOR: &str = r#"<sensor id="0" label="phone" type="frame"><resolution width="1000" height="500"/>
        <calibration type="frame" class="initial"><f>1</f></calibration>
        <calibration type="frame" class="adjusted"><resolution width="1000" height="500"/><f>800</f><cx>3</cx>
        <cy>-2</cy><b1>1.5</b1><k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><k4>0.0004</k4><p1>0.01</p1><p2>0.02</p2>
        </calibration></sensor>"#;
    /// At (1, 2, 3), looking along +x of the chunk, with its top along +y.
    const POSE: &str = "0 0 1 1  0 -1 0 2  1 0 0 3  0 0 0 1";

    fn camera(label: &str, rest: &str, pose: &str) -> String {
        format!(
            r#"<camera id="1" sensor_id="0" label="{label}" {rest}><transform>{pose}</transform></camera>"#
        )
    }

    fn document(sensor: &str, rest: &str, cameras: &str) -> String {
        format!(
            r#"<?xml version="1.0"?><document version="2.0.0"><chunk label="Chunk 1" enabled="true">
            <sensors>{sensor}</sensors>{rest}<cameras>{cameras}</cameras></chunk></document>"#
        )
    }

    fn read_text(text: &str) -> Result<Imported, Error> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cameras.xml");
        std::fs::write(&path, text).unwrap();
        super::super::read(&path, &[])
    }

    fn near(a: DVec3, b: DVec3) -> bool {
        (a - b).length() < 1e-12
    }

    #[test]
    fn cameras_come_with_their_calibration() {
        let group = format!("<group>{}</group>", camera("a.jpg", "", POSE));
        let cameras = [
            group,
            camera("off.jpg", r#"enabled="false""#, POSE),
            r#"<camera id="2" sensor_id="0" label="lost.jpg"/>"#.to_owned(),
        ];
        let found = read_text(&document(SENSOR, "", &cameras.concat())).unwrap();
        assert_eq!((found.tool, found.metres_known, found.up_known), ("Metashape", false, false));
        assert_eq!(found.poses.images.keys().collect::<Vec<_>>(), ["a.jpg"]);
        let pose = found.poses.images["a.jpg"].world_from_camera;
        assert!(near(pose.translation, DVec3::new(1.0, 2.0, 3.0)));
        assert!(near(pose.rotation * DVec3::Z, DVec3::X) && near(pose.rotation * -DVec3::Y, DVec3::Y));
        let lens = &found.poses.lenses[0];
        assert_eq!(
            (lens.size, lens.focal_px, lens.principal_px),
            ((1000, 500), [801.5, 800.0], [503.0, 248.0])
        );
        // x' = x + p1 (r^2 + 2 x^2) + 2 p2 x y, and so on, as the manual of Metashape has it.
        let tangential = LensDistortion { radial: [0.0; 4], ..lens.distortion };
        assert_eq!(lens.distortion.radial, [-0.1, 0.02, 0.003, 0.0004]);
        assert_eq!(tangential.distort(DVec2::X), DVec2::new(1.03, 0.02));
    }

    #[test]
    fn the_chunk_has_a_place_in_the_world() {
        // A quarter turn about x: y becomes z.
        let transform = "<transform><rotation>1 0 0 0 0 -1 0 1 0</rotation><translation>4e6 1e5 5e6</translation>\
                         <scale>2</scale></transform>";
        let component = format!(
            r#"<components><component id="7">{transform}</component><component id="8"/></components>"#
        );
        let cameras = [
            camera("a.jpg", r#"component_id="7""#, POSE),
            camera("b.jpg", r#"component_id="7""#, POSE),
            camera("c.jpg", r#"component_id="8""#, POSE),
        ];
        for (rest, count) in [(component.as_str(), 2), (transform, 3)] {
            let found = read_text(&document(SENSOR, rest, &cameras.concat())).unwrap();
            assert_eq!(found.poses.images.len(), count, "one of the parts of a chunk is left out");
            let pose = found.poses.images["a.jpg"].world_from_camera;
            assert!(near(pose.translation, DVec3::new(2.0, -6.0, 4.0)), "{pose:?}");
            assert!(near(pose.rotation * -DVec3::Y, DVec3::Z), "{pose:?}");
        }
    }

    #[test]
    fn cameras_of_a_rig_are_placed_in_their_master() {
        // A slave half a unit right of the master, turned to its right.
        let slave = SENSOR.replace("id=\"0\"", "id=\"1\" master_id=\"0\"").replace(
            "</sensor>",
            "<rotation>0 0 1 0 1 0 -1 0 0</rotation><location>0.5 0 0</location></sensor>",
        );
        let cameras = [
            r#"<camera id="1" sensor_id="0" label="left.jpg"><transform>"#,
            POSE,
            r#"</transform></camera><camera id="2" sensor_id="1" master_id="1" label="right.jpg"/>"#,
            r#"<camera id="3" sensor_id="0" label="lost.jpg"/>"#,
            r#"<camera id="4" sensor_id="1" master_id="3" label="lost too.jpg"/>"#,
        ];
        let text = document(&format!("{SENSOR}{slave}"), "", &cameras.concat());
        let found = read_text(&text).unwrap();
        assert_eq!(found.poses.images.keys().collect::<Vec<_>>(), ["left.jpg", "right.jpg"]);
        let [master, slave] =
            ["left.jpg", "right.jpg"].map(|name| found.poses.images[name].world_from_camera);
        assert!(near(slave.translation, master.apply(DVec3::new(0.5, 0.0, 0.0))), "{slave:?}");
        assert!(near(slave.rotation * DVec3::Z, master.rotation * DVec3::X), "it looks to the right");
        assert!(found.notes[0].contains("2 cameras were not aligned"), "{:?}", found.notes);
        let message = read_text(&text.replace("<location>0.5 0 0</location>", "<location fixed=\"true\"/>"));
        let message = message.unwrap_err().to_string();
        assert!(message.contains("right.jpg") && message.contains("location"), "{message}");
    }

    #[test]
    fn what_cannot_be_read_is_reported() {
        let good = document(SENSOR, "", &camera("a.jpg", "", POSE));
        for (from, to, message) in [
            ("<chunk", "<chank", "chunk"),
            ("0 0 1 1 ", "0 0 1 x ", "a.jpg: <transform>"),
            ("0 0 1 1 ", "0 0 2 1 ", "rigid"),
            ("sensor_id=\"0\"", "sensor_id=\"9\"", "sensor"),
            ("label=\"phone\" type=\"frame\"", "type=\"fisheye\"", "fisheye"),
            ("<b1>1.5</b1>", "<b2>30</b2>", "skew"),
            ("<f>800</f>", "", "focal"),
            ("<sensor ", "<sensor <", "XML"),
            ("<transform>", "<transfer>", "XML"),
        ] {
            let text = good
                .replace(from, to)
                .replace("</chunk>", if to == "<chank" { "</chank>" } else { "</chunk>" });
            assert_ne!(text, good, "{from}");
            let Error::System(cif_system::Error::Refused { problem, fix }) = read_text(&text).unwrap_err()
            else {
                panic!("another error")
            };
            assert!(problem.contains(message) && problem.contains("cameras.xml"), "{message}: {problem}");
            assert!(fix.contains("Agisoft XML"), "{fix}");
        }
        let unaligned = document(SENSOR, "", r#"<camera id="2" sensor_id="0" label="lost.jpg"/>"#);
        assert!(read_text(&unaligned).unwrap_err().to_string().contains("aligned"));
    }
}
