//! Cameras over time: ours with what was recorded about them, others as far as glTF describes them.

use cif_geometry::PinholeCamera;
use cif_scene::{CameraSample, CameraTrack, naming};
use glam::DVec2;
use gltf::json::camera::Perspective;
use gltf::json::validation::Checked;

use super::hierarchy::Placed;
use super::motion::Chain;
use super::objects::Reader;
use crate::conventions;
use crate::extras::{self, Cif};

/// Reads the cameras of the scene; those that cannot be taken over are said in the warnings.
pub(crate) fn read(reader: &mut Reader<'_>, placed: &[Placed]) -> Vec<CameraTrack> {
    let mut tracks: Vec<CameraTrack> = Vec::new();
    for placed in placed {
        let source = reader.stage.source;
        let node = &source.root.nodes[placed.index];
        let camera = node.camera.and_then(|camera| source.root.cameras.get(camera.value()));
        let perspective = camera.and_then(|camera| match &camera.type_ {
            Checked::Valid(_) => camera.perspective.as_ref(),
            Checked::Invalid => None,
        });
        let (name, label, views) = match (&placed.cif, perspective) {
            (Some(Cif::Camera(ours)), perspective) => {
                (ours.name.clone(), ours.label.clone(), our_views(ours, perspective))
            }
            (_, Some(perspective)) => {
                let label = node.name.clone().unwrap_or_else(|| format!("camera {}", placed.index));
                (naming::identifier(&label, "camera"), label, Views::Foreign(foreign_view(perspective)))
            }
            (_, None) => {
                if node.camera.is_some() {
                    let name = source.node_name(placed.index);
                    reader.warnings.push(format!("{name}: only perspective cameras are read; left out"));
                }
                continue;
            }
        };
        let (prefix, nodes) = reader.below_world(&placed.chain);
        let chain = reader.stage.chain(prefix, nodes, false);
        let samples = samples(reader, &chain, &views);
        if samples.is_empty() {
            let name = source.node_name(placed.index);
            reader.warnings.push(format!("{name}: the camera has no angle of view or no pose; left out"));
            continue;
        }
        tracks.push(CameraTrack { name, label, samples });
    }
    tracks
}

enum Views {
    /// Every time code has its view.
    Recorded(Vec<(f64, extras::View)>),
    /// One view at all keys.
    Foreign(Option<extras::View>),
}

fn our_views(camera: &extras::Camera, perspective: Option<&Perspective>) -> Views {
    let usable = |view: &extras::View| {
        view.width > 0
            && view.height > 0
            && view.focal_px.iter().all(|focal| focal.is_finite() && *focal > 0.0)
    };
    let ascending = camera.time_codes.windows(2).all(|pair| pair[0] < pair[1]);
    let complete = camera.views.len() == 1 || camera.views.len() == camera.time_codes.len();
    let (Some(first), true, true) = (camera.views.first(), ascending, complete) else {
        return Views::Foreign(perspective.and_then(foreign_view));
    };
    if !camera.views.iter().all(usable) {
        return Views::Foreign(perspective.and_then(foreign_view));
    }
    // An angle that was changed since scales the focal lengths.
    let (written, _) = conventions::perspective(first.width, first.height, DVec2::from_array(first.focal_px));
    let zoom = perspective.map_or(1.0, |now| (written / 2.0).tan() / (f64::from(now.yfov) / 2.0).tan());
    let zoom = if zoom.is_finite() && (zoom - 1.0).abs() > 1e-5 && zoom > 0.0 { zoom } else { 1.0 };
    let codes = camera.time_codes.iter().enumerate();
    let view = |k: usize| {
        let view = camera.views[if camera.views.len() == 1 { 0 } else { k }];
        extras::View { focal_px: view.focal_px.map(|focal| focal * zoom), ..view }
    };
    Views::Recorded(codes.map(|(k, &code)| (code, view(k))).collect())
}

fn foreign_view(perspective: &Perspective) -> Option<extras::View> {
    let yfov = f64::from(perspective.yfov);
    let aspect = perspective.aspect_ratio.map_or(16.0 / 9.0, f64::from);
    if !(yfov > 1e-6 && yfov < std::f64::consts::PI && aspect.is_finite() && aspect > 0.0) {
        return None;
    }
    let (width, height, focal_px) = conventions::intrinsics(yfov, aspect);
    let principal_px = [f64::from(width) / 2.0, f64::from(height) / 2.0];
    Some(extras::View { width, height, focal_px: focal_px.to_array(), principal_px })
}

fn samples(reader: &Reader<'_>, chain: &Chain, views: &Views) -> Vec<CameraSample> {
    let stage = reader.stage;
    let views: Vec<(f64, extras::View)> = match views {
        Views::Recorded(views) => views.clone(),
        Views::Foreign(None) => Vec::new(),
        Views::Foreign(Some(view)) => {
            let keys = stage.movement(chain).map(|movement| movement.track.samples).unwrap_or_default();
            if keys.is_empty() {
                vec![(stage.start, *view)]
            } else {
                keys.iter().map(|key| (key.time_code, *view)).collect()
            }
        }
    };
    let sample = |(time_code, view): (f64, extras::View)| {
        let pose = stage.at(chain, stage.clock.seconds(time_code))?;
        Some(CameraSample {
            time_code,
            exposure: 0.0,
            camera: PinholeCamera {
                width: view.width,
                height: view.height,
                focal_px: DVec2::from_array(view.focal_px),
                principal_px: DVec2::from_array(view.principal_px),
                camera_from_world: conventions::camera_from_world(pose.translation, pose.rotation),
            },
        })
    };
    views.into_iter().filter_map(sample).collect()
}
