//! Paths of moving objects over the pictures of `cif render --what tracks`.

use cif_field::{Field, TrackGroup};
use cif_geometry::PinholeCamera;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_scene::SceneOptions;
use cif_scene::from_field::assignment::members;
use glam::{DVec2, DVec3};

use super::object_motion::followed;
use crate::pictures::{Polyline, instance_color};

/// Most times that a path is drawn through.
const MOST_TIMES: usize = 200;

/// Length on screen below which a path is that of an object at rest, as a share of the image's height, and the least,
/// pixels.
const AT_REST: (f64, f64) = (0.015, 3.0);

/// Turn below which an object that stays in place is at rest, radians.
const UNTURNED: f64 = 0.02;

/// Opacity of the path after the shown time.
const TO_COME: f64 = 0.4;

/// Width of lines as a share of the image's height, and the least, pixels.
const WIDTH: (f64, f64) = (0.005, 1.5);

/// Length of the axes, radii of the object.
const AXIS: f64 = 2.0;

/// Colours of the axes x, y and z of an object.
const AXES: [(DVec3, [u8; 3]); 3] =
    [(DVec3::X, [230, 60, 60]), (DVec3::Y, [70, 200, 70]), (DVec3::Z, [70, 110, 240])];

/// Paths of the centres of all objects.
#[derive(Debug)]
pub(in crate::commands) struct Trajectories<'a> {
    field: &'a Field,
    /// Normalised times, ascending.
    times: Vec<f64>,
    objects: Vec<Object>,
}

#[derive(Debug)]
struct Object {
    id: u16,
    rows: Vec<u32>,
    /// Centre at every time, world.
    path: Vec<DVec3>,
    /// Root of the mean squared distance of its Gaussians from the centre.
    radius: f64,
}

impl<'a> Trajectories<'a> {
    /// Follows the objects of a field through its captured times.
    pub(in crate::commands) fn new(field: &'a Field, simd: SimdLevel) -> Self {
        let captured = &field.timeline.times;
        let count = captured.len().min(MOST_TIMES);
        let times: Vec<f64> =
            (0..count).map(|k| captured[k * (captured.len() - 1) / count.saturating_sub(1).max(1)]).collect();
        let rows = members(field, &SceneOptions::default());
        let mut objects: Vec<Object> = field
            .instances
            .iter()
            .zip(rows)
            .filter(|(_, rows)| !rows.is_empty() && !times.is_empty())
            .map(|(instance, rows)| Object { id: instance.id, rows, path: Vec::new(), radius: 0.0 })
            .collect();
        let weights: Vec<f64> = (0..field.len()).map(|row| f64::from(field.gaussians.opacity(row))).collect();
        let mut renderer = Renderer::new(simd);
        for time in &times {
            let posed = renderer.deform_unhidden(field, *time);
            for object in &mut objects {
                object.follow(&posed.means, &weights);
            }
        }
        Self { field, times, objects }
    }

    /// Lines over the view of a camera at a time.
    pub(in crate::commands) fn lines(&self, camera: &PinholeCamera, time: f64) -> Vec<Polyline> {
        let pixels = |(share, least): (f64, f64)| (share * f64::from(camera.height)).max(least);
        let (width, at_rest) = (pixels(WIDTH), pixels(AT_REST));
        let mut lines = Vec::new();
        for object in &self.objects {
            let project = |point: &DVec3| camera.project(*point).map(|(pixel, _)| pixel);
            let group = followed(self.field, &object.rows).filter(|group| !group.poses.is_empty());
            let seen: Vec<DVec2> = object.path.iter().filter_map(project).collect();
            let travels = seen.iter().any(|pixel| pixel.distance(seen[0]) >= at_rest);
            if !travels && !group.is_some_and(turns) {
                continue;
            }
            let (past, here, future) = self.split(&object.path, time);
            let color = instance_color(object.id);
            let mut stroke = |points: &[DVec3], color, opacity, width| {
                // What lies behind the camera leaves gaps.
                let pixels: Vec<Option<DVec2>> = points.iter().map(project).collect();
                for run in pixels.split(Option::is_none).filter(|run| !run.is_empty()) {
                    let points = run.iter().copied().flatten().collect();
                    lines.push(Polyline { points, color, opacity, width });
                }
            };
            if travels {
                stroke(&future, color, TO_COME, width);
                stroke(&past, color, 1.0, width);
            }
            if let Some(group) = group {
                let (rotation, _) = group.pose(time);
                for (axis, color) in AXES {
                    stroke(&[here, here + rotation * axis * AXIS * object.radius], color, 1.0, width);
                }
            }
            stroke(&[here], color, 1.0, 3.0 * width);
        }
        lines
    }

    /// A path up to a time, its place there, and the path from there on.
    fn split(&self, path: &[DVec3], time: f64) -> (Vec<DVec3>, DVec3, Vec<DVec3>) {
        let after = self.times.partition_point(|captured| *captured <= time);
        let here = match after {
            0 => path[0],
            after if after == path.len() => path[after - 1],
            after => {
                let (a, b) = (self.times[after - 1], self.times[after]);
                path[after - 1].lerp(path[after], (time - a) / (b - a))
            }
        };
        let (before, later) = path.split_at(after);
        let past = before.iter().copied().chain([here]).collect();
        (past, here, std::iter::once(here).chain(later.iter().copied()).collect())
    }
}

/// True when the poses of a group turn it visibly.
fn turns(group: &TrackGroup) -> bool {
    group.poses.iter().any(|pose| pose.rotation.angle_between(group.poses[0].rotation) > UNTURNED)
}

impl Object {
    /// Adds the centre of its Gaussians at the next time.
    fn follow(&mut self, means: &[[f32; 3]], weights: &[f64]) {
        let mean = |row: u32| DVec3::from_array(means[row as usize].map(f64::from));
        let weight = |row: u32| weights[row as usize].max(f64::MIN_POSITIVE);
        let total: f64 = self.rows.iter().map(|row| weight(*row)).sum();
        let centre = self.rows.iter().map(|row| mean(*row) * weight(*row)).sum::<DVec3>() / total;
        if self.path.is_empty() {
            let squared = |row: &u32| weight(*row) * mean(*row).distance_squared(centre);
            self.radius = (self.rows.iter().map(squared).sum::<f64>() / total).sqrt();
        }
        self.path.push(centre);
    }
}
