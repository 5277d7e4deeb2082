//! Check that a capture is the one that a scene was trained on, as far as the scene's record shows.
//!
//! Compared is what decides where and when a view shows the scene: poses and times. Image sizes, splits and lenses
//! may differ, and frames, cameras and masks may be missing or new. A scene without recorded cameras fits every
//! capture.

use cif_dataset::{Dataset, Frame, InstanceLabel, Split};
use cif_field::{Field, RecordedCamera};
use cif_geometry::PinholeCamera;
use cif_geometry::stats::upper_median;

/// Camera centres that are nearer to each other are one place, in scene extents.
const SAME_PLACE: f64 = 1e-3;

/// Camera axes whose components differ by less are the same.
const SAME_AXES: f64 = 1e-2;

/// Instances that a message names at most.
const MOST_NAMED: usize = 3;

/// Severity of a misfit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    /// Pictures and scores say nothing about the scene.
    Warning,
    /// Possible on purpose; scores may mean less.
    Note,
}

/// Something in which a capture differs from what a scene recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Misfit {
    /// Severity.
    pub severity: Severity,
    /// The difference, its size and the remedy.
    pub message: String,
}

/// Compares the views of a split, and the instances, with what a scene recorded of its own capture. Nothing is
/// compared where the scene records no cameras.
#[must_use]
pub fn misfits(field: &Field, dataset: &Dataset, split: Split) -> Vec<Misfit> {
    let frames: Vec<&Frame> = dataset.frames.iter().filter(|frame| frame.split == split).collect();
    if field.cameras.is_empty() || frames.is_empty() {
        return Vec::new();
    }
    let root = dataset.root.display();
    let trained_on = field.record.capture.as_ref().map_or_else(String::new, |name| format!(" of `{name}`"));
    let extent = f64::from(field.extent).max(f64::MIN_POSITIVE);
    let recorded: Vec<Recorded<'_>> = field.cameras.iter().map(Recorded::of).collect();
    let views: Vec<View> = frames.iter().map(|frame| View::of(frame, &recorded, field, extent)).collect();
    let mut unknown: Vec<f64> = views.iter().filter_map(|view| view.distance_if_unknown).collect();
    let mut found = Vec::new();
    let is_other_place = 2 * unknown.len() > views.len();
    if is_other_place {
        found.push(Misfit {
            severity: Severity::Warning,
            message: format!(
                "{root}: {} of {} views are none of the {} that the scene recorded{trained_on}; the nearest recorded \
                 camera is {:.2} scene extents away in the median. Give the capture that the scene was trained on; new \
                 views have to be in its world coordinates",
                unknown.len(),
                views.len(),
                recorded.len(),
                upper_median(&mut unknown).unwrap_or_default()
            ),
        });
    } else if !unknown.is_empty() {
        found.push(Misfit {
            severity: Severity::Note,
            message: format!(
                "{root}: {} of {} views are new to the scene, which recorded other cameras{trained_on}",
                unknown.len(),
                views.len()
            ),
        });
    }
    found.extend(other_times(field, dataset, &views));
    if field.identities.is_some() {
        found.extend(other_instances(field, dataset, is_other_place));
    }
    found
}

/// A recorded camera, ready to be compared.
struct Recorded<'a> {
    camera: &'a PinholeCamera,
    centre: glam::DVec3,
    time_index: usize,
}

impl<'a> Recorded<'a> {
    fn of(record: &'a RecordedCamera) -> Self {
        Self { camera: &record.camera, centre: record.camera.centre(), time_index: record.time_index }
    }
}

/// A view of the capture compared with the record.
struct View {
    /// Distance of the nearest recorded camera, scene extents, where none has the pose of the view.
    distance_if_unknown: Option<f64>,
    /// Smallest difference from the normalised times at which the pose was recorded; `None` for an unknown pose.
    late: Option<f64>,
}

impl View {
    fn of(frame: &Frame, recorded: &[Recorded<'_>], field: &Field, extent: f64) -> Self {
        let centre = frame.camera.centre();
        let axes = frame.camera.camera_from_world.rotation;
        let (mut nearest, mut late) = (f64::INFINITY, None::<f64>);
        for record in recorded {
            let distance = record.centre.distance(centre) / extent;
            nearest = nearest.min(distance);
            let rotation = record.camera.camera_from_world.rotation;
            if distance <= SAME_PLACE && rotation.abs_diff_eq(axes, SAME_AXES) {
                let time = field.timeline.times.get(record.time_index).copied().unwrap_or_default();
                let difference = (time - frame.time).abs();
                late = Some(late.map_or(difference, |least| least.min(difference)));
            }
        }
        Self { distance_if_unknown: late.is_none().then_some(nearest), late }
    }
}

/// Known poses at times that were not recorded for them.
fn other_times(field: &Field, dataset: &Dataset, views: &[View]) -> Option<Misfit> {
    let times = &field.timeline.times;
    // A view between two recorded times is one of its own.
    let gap = times.windows(2).map(|pair| pair[1] - pair[0]).fold(1.0, f64::min);
    let allowed = if times.len() > 1 { 0.5 * gap } else { 0.0 } + 1e-6;
    let known: Vec<f64> = views.iter().filter_map(|view| view.late).collect();
    let late: Vec<f64> = known.iter().copied().filter(|late| *late > allowed).collect();
    if late.is_empty() {
        return None;
    }
    let severity = if field.moves() { Severity::Warning } else { Severity::Note };
    let root = dataset.root.display();
    let message = if times.len() == 1 {
        format!(
            "{root}: it has {} times, and the scene recorded one, which all of its views show",
            dataset.times.len()
        )
    } else {
        format!(
            "{root}: {} of {} views have other times than the scene recorded for them, by up to {:.3} of its length. A \
             capture runs from its first frame (time 0) to its last (time 1), so that a part of one has other times; give \
             the whole capture",
            late.len(),
            known.len(),
            late.iter().copied().fold(0.0, f64::max)
        )
    };
    Some(Misfit { severity, message })
}

/// Instances of the masks that are unknown to the scene, or called otherwise there.
fn other_instances(field: &Field, dataset: &Dataset, is_other_place: bool) -> Option<Misfit> {
    let mut others: Vec<String> = Vec::new();
    for InstanceLabel { id, label, .. } in &dataset.instances {
        match field.instance_by_id(*id).map(|index| &field.instances[index].label) {
            None => others.push(format!("{id} ({label}) is unknown to the scene")),
            // Where nobody named an instance, its id is all there is to compare.
            Some(known) if known == label || [known, label].iter().any(|name| is_placeholder(name, *id)) => {}
            Some(known) => others.push(format!("{id} is {label} in the masks and {known} in the scene")),
        }
    }
    if others.is_empty() {
        return None;
    }
    let (count, all) = (others.len(), dataset.instances.len());
    let more = if count > MOST_NAMED { ", ..." } else { "" };
    others.truncate(MOST_NAMED);
    Some(Misfit {
        severity: if is_other_place { Severity::Warning } else { Severity::Note },
        message: format!(
            "{}: {count} of {all} instances of the masks are others in the scene: {}{more}; instance scores compare ids",
            dataset.root.display(),
            others.join(", ")
        ),
    })
}

/// True where a label only repeats the id.
fn is_placeholder(label: &str, id: u16) -> bool {
    label.strip_prefix("instance_").is_some_and(|number| number.parse() == Ok(id))
}

#[cfg(test)]
mod tests {
    use cif_dataset::{CaptureFrame, Layout, PointCloud, PointSource};
    use cif_field::{Instance, Timeline};
    use cif_geometry::{LensDistortion, RigidTransform};
    use cif_render::synthetic;
    use glam::{DMat3, DVec2, DVec3};

    use super::*;

    const TIMES: usize = 9;

    fn camera(turn: f64, shift: f64) -> PinholeCamera {
        let rotation = DMat3::from_rotation_y(turn);
        let centre = DVec3::new(3.0 * turn.sin() + shift, 0.2, -3.0 * turn.cos());
        PinholeCamera {
            width: 64,
            height: 48,
            focal_px: DVec2::splat(60.0),
            principal_px: DVec2::new(32.0, 24.0),
            camera_from_world: RigidTransform { rotation, translation: -(rotation * centre) },
        }
    }

    /// A capture by one moving camera; every third frame is held out.
    fn dataset() -> Dataset {
        let times: Vec<f64> = (0..TIMES).map(|k| k as f64 / (TIMES - 1) as f64).collect();
        let frame = |(index, time): (usize, &f64)| Frame {
            name: format!("{index:06}"),
            camera_name: "hand held".into(),
            camera: camera(0.1 * index as f64, 0.0),
            lens: LensDistortion::default(),
            time: *time,
            time_index: index,
            split: if index % 3 == 1 { Split::Val } else { Split::Train },
            group: None,
            image: "none.png".into(),
            turn: cif_dataset::Turn::NONE,
            source: None,
            mask: None,
            confidence: None,
        };
        let label = |(id, label): (u16, &str)| InstanceLabel {
            id,
            label: label.into(),
            category: label.into(),
            taxonomies: Default::default(),
        };
        Dataset {
            root: "table".into(),
            layout: Layout::HyperNerf,
            frames: times.iter().enumerate().map(frame).collect(),
            times,
            window: None,
            frames_per_second: None,
            instances: [(1, "red mug"), (2, "blue mug"), (5, "instance_5")].map(label).to_vec(),
            mask_objects: Default::default(),
            points: PointCloud { positions: Vec::new(), colors: Vec::new(), source: PointSource::Random },
            has_alpha: false,
            warnings: Vec::new(),
            notes: Vec::new(),
            unknown: None,
            frame: CaptureFrame::default(),
        }
    }

    /// A moving scene that recorded [`dataset`].
    fn field() -> Field {
        let dataset = dataset();
        let mut field = synthetic::generate(&synthetic::SyntheticConfig {
            gaussians: 20,
            instances: 3,
            heads: Some(synthetic::ALL_HEADS),
            ..Default::default()
        })
        .field;
        field.extent = 1.0;
        field.timeline = Timeline { times: dataset.times.clone(), frames_per_second: 24.0 };
        field.cameras = dataset
            .frames
            .iter()
            .map(|frame| RecordedCamera {
                name: frame.camera_name.clone(),
                time_index: frame.time_index,
                trained: frame.split == Split::Train,
                camera: frame.camera,
            })
            .collect();
        let instance = |label: &InstanceLabel| Instance {
            id: label.id,
            label: label.label.clone(),
            category: label.category.clone(),
            taxonomies: label.taxonomies.clone(),
        };
        field.instances = dataset.instances.iter().map(instance).collect();
        field.record.capture = Some("table".to_owned());
        assert!(field.moves() && field.identities.is_some());
        field
    }

    fn reported(dataset: &Dataset) -> Vec<(Severity, String)> {
        let found = misfits(&field(), dataset, Split::Val);
        found.into_iter().map(|misfit| (misfit.severity, misfit.message)).collect()
    }

    #[test]
    fn the_capture_of_the_scene_fits_in_all_its_variants() {
        let whole = dataset();
        assert_eq!(reported(&whole), []);
        // Another resolution, other splits.
        let mut other = whole.clone();
        for frame in &mut other.frames {
            frame.camera = frame.camera.resized(640, 480);
            frame.split = Split::Val;
        }
        assert_eq!(reported(&other), []);
        // Some of the frames, at the times of the whole.
        let mut some = whole.clone();
        some.frames.retain(|frame| frame.time_index % 4 == 0 || frame.time_index == 1);
        assert_eq!(reported(&some), []);
        // Poses that were written with few digits.
        let mut rounded = whole.clone();
        for frame in &mut rounded.frames {
            let pose = &mut frame.camera.camera_from_world;
            pose.translation = (pose.translation * 1e4).round() / 1e4;
        }
        assert_eq!(reported(&rounded), []);
        // Neither masks, nor instances.
        let unlabelled = Dataset { instances: Vec::new(), ..whole.clone() };
        assert_eq!(reported(&unlabelled), []);
        // Ids without names are compared as ids.
        let mut named = whole;
        named.instances[2].label = "spoon".into();
        named.instances[0].label = "instance_1".into();
        assert_eq!(reported(&named), []);
        // A scene that records no cameras.
        let imported = Field { cameras: Vec::new(), ..field() };
        assert_eq!(misfits(&imported, &dataset(), Split::Val), []);
    }

    #[test]
    fn another_capture_is_recognised_by_its_cameras() {
        // Half a unit to the right; cameras of the arc stand 0.3 apart.
        let mut other = dataset();
        for frame in &mut other.frames {
            frame.camera = camera(0.1 * frame.time_index as f64, 0.5);
        }
        other.instances = vec![InstanceLabel {
            id: 2,
            label: "dog".into(),
            category: "dog".into(),
            taxonomies: Default::default(),
        }];
        let found = reported(&other);
        assert_eq!(found.len(), 2, "{found:?}");
        assert_eq!((found[0].0, found[1].0), (Severity::Warning, Severity::Warning));
        for word in ["3 of 3 views", "none of the 9", "`table`", "0.26 scene extents"] {
            assert!(found[0].1.contains(word), "{word} in {}", found[0].1);
        }
        assert!(found[1].1.contains("2 is dog in the masks and blue mug in the scene"), "{}", found[1].1);
        // Cameras that look elsewhere from the same places.
        let mut turned = dataset();
        for frame in &mut turned.frames {
            let pose = &mut frame.camera.camera_from_world;
            let (half, centre) = (DMat3::from_rotation_y(std::f64::consts::PI), pose.inverse().translation);
            *pose = RigidTransform {
                rotation: half * pose.rotation,
                translation: -(half * pose.rotation * centre),
            };
        }
        let found = reported(&turned);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].1.contains("3 of 3 views"), "{found:?}");
    }

    #[test]
    fn a_few_new_views_are_a_note() {
        let mut more = dataset();
        more.frames[1].camera = camera(0.12, 0.0);
        let found = reported(&more);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].0, Severity::Note);
        assert!(found[0].1.contains("1 of 3 views are new"), "{found:?}");
    }

    #[test]
    fn a_part_of_a_capture_that_runs_from_0_to_1_again_has_other_times() {
        let mut part = dataset();
        part.frames.truncate(TIMES / 2 + 1);
        for frame in &mut part.frames {
            frame.time *= 2.0;
        }
        let found = reported(&part);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].0, Severity::Warning);
        assert!(found[0].1.contains("2 of 2 views") && found[0].1.contains("up to 0.500"), "{found:?}");
        // A scene that stands still looks the same at all times.
        let standing = Field { deformation: None, tracks: None, ..field() };
        assert_eq!(misfits(&standing, &part, Split::Val)[0].severity, Severity::Note);
        // Times between recorded ones are no misfit.
        let mut between = dataset();
        between.frames[1].time += 0.4 / (TIMES - 1) as f64;
        assert_eq!(reported(&between), []);
    }

    #[test]
    fn masks_of_another_tracker_are_a_note() {
        let mut other = dataset();
        for label in &mut other.instances {
            label.id += 100;
        }
        let found = reported(&other);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].0, Severity::Note);
        assert!(found[0].1.contains("3 of 3 instances") && found[0].1.contains("101"), "{found:?}");
    }
}
