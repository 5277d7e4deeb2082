//! The near plane, from what the cameras of a capture see.
//!
//! A Gaussian close to one camera covers much of its image and little of any other, so that it explains that image by
//! itself: of a rig, whose cameras are far apart, such Gaussians become a haze before every camera that is left out.
//! Points that several images agree on say how near the scene comes, and what is nearer than that is not drawn.

use cif_dataset::{Dataset, PointSource};
use glam::DVec3;

/// Near plane where nothing says that the scene comes nearer, units of the capture, as in 3DGS.
const TYPICAL: f64 = 0.2;

/// Share of the depths at which cameras see points that are taken for mismatches.
const MISMATCHES: f64 = 0.01;

/// Part of the way to the nearest points beyond which Gaussians are drawn, where points are of what moves too, as those of
/// a rig are. Chosen on one rig alone, whose held-out images were the better the larger it was, up to 0.93, and worse at
/// 1.08, where people were cut: 0.7 leaves room to what has no points, such as plain surfaces.
const OF_RIG: f64 = 0.7;

/// The same where points are of what stands still alone: what moves may pass much nearer, and is not drawn nearer than
/// [`TYPICAL`]. Not measured.
const OF_WALK: f64 = 0.5;

/// The same where points were drawn at random, from which little follows. Not measured.
const OF_RANDOM: f64 = 0.1;

/// Frames and points that are looked at, spread evenly.
const FRAMES: usize = 200;
const POINTS: usize = 2_000;

/// Depth from which on Gaussians are drawn, units of the capture.
pub(super) fn automatic(dataset: &Dataset) -> f32 {
    let Some(nearest) = nearest(dataset) else { return TYPICAL as f32 };
    let near = match dataset.points.source {
        PointSource::Random => (OF_RANDOM * nearest).min(TYPICAL),
        _ if dataset.is_rig() => OF_RIG * nearest,
        _ => (OF_WALK * nearest).min(TYPICAL),
    };
    near as f32
}

/// Depth beyond which training cameras see all points but the mismatches; `None` where they see none.
fn nearest(dataset: &Dataset) -> Option<f64> {
    let train = dataset.train_frames();
    let positions = &dataset.points.positions;
    let points: Vec<DVec3> = positions
        .iter()
        .step_by(positions.len().div_ceil(POINTS).max(1))
        .map(|position| DVec3::from(position.map(f64::from)))
        .collect();
    let mut depths: Vec<f64> = train
        .iter()
        .step_by(train.len().div_ceil(FRAMES).max(1))
        .map(|index| &dataset.frames[*index].camera)
        .flat_map(|camera| {
            let seen = points.iter().filter(|point| camera.pixel_of(**point).is_some());
            seen.map(|point| camera.forward().dot(*point - camera.centre()))
        })
        .collect();
    depths.sort_unstable_by(f64::total_cmp);
    depths.get((MISMATCHES * depths.len() as f64) as usize).copied().filter(|depth| *depth > 0.0)
}

#[cfg(test)]
mod tests {
    use cif_dataset::{PointCloud, PointSource};

    use super::super::guard_tests::support::{Scene, capture};
    use super::*;

    /// A capture of some cameras at once whose points lie so far before them, in units `size` times as large.
    fn seen_at(views: usize, depth: f64, size: f64, source: PointSource) -> Dataset {
        let folder = tempfile::tempdir().unwrap();
        let one_camera = views == 1;
        let (times, views) = if one_camera { (5, 5) } else { (1, views) };
        let mut dataset = capture(folder.path(), Scene { times, views, one_camera, ..Scene::default() });
        let mut positions = Vec::new();
        for frame in &mut dataset.frames {
            frame.camera.camera_from_world.translation *= size;
            let camera = &frame.camera;
            let reach =
                |k: usize| (camera.centre() + camera.forward() * depth * (1.0 + 1e-3 * k as f64)).as_vec3();
            if frame.split == cif_dataset::Split::Train {
                positions.extend((0..40).map(|k| reach(k).to_array()));
            }
        }
        let colors = vec![[9; 3]; positions.len()];
        dataset.points = PointCloud { positions, colors, source };
        dataset
    }

    #[test]
    fn points_of_a_rig_say_how_near_it_comes_in_whatever_unit() {
        for size in [1.0, 100.0] {
            let dataset = seen_at(4, 0.5 * size, size, PointSource::Triangulated);
            assert_eq!(dataset.images_at_once(), 4);
            let near = f64::from(automatic(&dataset));
            assert!((near / (OF_RIG * 0.5 * size) - 1.0).abs() < 0.1, "{near} in units of {size}");
        }
        // One mismatch among a hundred points says nothing.
        let mut dataset = seen_at(4, 0.5, 1.0, PointSource::Triangulated);
        let camera = &dataset.frames[0].camera;
        dataset.points.positions[0] = (camera.centre() + camera.forward() * 0.01).as_vec3().to_array();
        assert!(automatic(&dataset) > 0.3);
    }

    #[test]
    fn what_moves_before_one_camera_may_be_nearer_than_its_points() {
        let far = automatic(&seen_at(1, 3.0, 1.0, PointSource::Triangulated));
        assert_eq!(far, TYPICAL as f32);
        let close = f64::from(automatic(&seen_at(1, 0.02, 0.05, PointSource::Triangulated)));
        assert!((close / (OF_WALK * 0.02) - 1.0).abs() < 0.1, "a small scene: {close}");
    }

    #[test]
    fn without_measured_points_little_is_known() {
        assert_eq!(automatic(&seen_at(4, 5.0, 1.0, PointSource::Random)), TYPICAL as f32);
        let small = f64::from(automatic(&seen_at(4, 0.1, 0.1, PointSource::Random)));
        assert!((small / (OF_RANDOM * 0.1) - 1.0).abs() < 0.1, "{small}");
        let mut none = seen_at(4, 5.0, 1.0, PointSource::Random);
        none.points.positions.clear();
        assert_eq!(automatic(&none), TYPICAL as f32);
    }
}
