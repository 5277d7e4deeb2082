//! Poses of rigid objects, from masks and colours, before the scene's motion is trained. Source: methods reference of
//! motion, 4.
//!
//! | file | answers |
//! |---|---|
//! | `view` | what a frame shows of an object |
//! | `plane` | which plane objects stand on |
//! | `outline`, `path` | how large an object is, and where it goes |
//! | `shape` | its Gaussians alone, against crops |
//! | `fit` | its poses and Gaussians, moved together |
//! | `start` | how it turns, and everything in order |

mod fit;
mod outline;
mod path;
mod plane;
mod shape;
mod start;
mod view;

use cif_dataset::Dataset;
use glam::DVec3;

pub(crate) use self::start::{Fitted, Rotation, Surroundings};
use self::view::ObjectView;
use crate::error::TrainError;
use crate::frames::FrameStore;
use crate::random::{Purpose, stream};

/// Distance from a plane within which a point is on it, of the extent of the cameras.
const ON_PLANE: f64 = 0.005;

/// Fits one object (a label: dense index + 1); `None` where its masks, or the scene, do not tell enough.
///
/// # Errors
/// When a frame cannot be read, or the run is to stop.
pub(crate) fn fit(
    label: u16,
    dataset: &Dataset,
    frames: &FrameStore,
    surroundings: Surroundings<'_>,
) -> Result<Option<Fitted>, TrainError> {
    let points: Vec<DVec3> =
        dataset.points.positions.iter().map(|p| DVec3::from_array(p.map(f64::from))).collect();
    let mut views = Vec::new();
    let mut cameras = Vec::new();
    for k in 0..frames.len() {
        surroundings.stop.check()?;
        let frame = &dataset.frames[frames.index(k)];
        cameras.push(frame.camera.centre());
        let data = frames.get(dataset, k)?;
        let Some(labels) = &data.labels else { continue };
        views.extend(ObjectView::new(label, frame.time_index, &frame.camera, labels, &data.image));
    }
    views.sort_by_key(|view| view.time_index);
    view::set_visible(&mut views);
    let rng = stream(surroundings.seed, Purpose::Objects, 0);
    let tolerance = ON_PLANE * dataset.extent();
    let Some(plane) = plane::support(&points, &cameras, tolerance, rng) else { return Ok(None) };
    let Some(outline) = outline::outline(&views, &plane) else { return Ok(None) };
    start::fit_object(label, &views, &plane, &outline, surroundings)
}

#[cfg(test)]
mod trial {
    #[test]
    #[ignore]
    fn trial() {
        let root = std::env::var("CAPTURE").unwrap();
        let dataset = cif_dataset::Dataset::open(&root, &cif_dataset::OpenOptions::default()).unwrap();
        let stop = crate::stop::Stop::when(|| false);
        let frames = super::FrameStore::open(&dataset, [1.0; 3], 1 << 30, &stop).unwrap();
        let mut out = serde_json::Map::new();
        let only: Vec<u16> = std::env::var("ONLY")
            .map(|s| s.split(',').map(|v| v.parse().unwrap()).collect())
            .unwrap_or_default();
        for (k, instance) in dataset.instances.iter().enumerate() {
            if !only.is_empty() && !only.contains(&instance.id) {
                continue;
            }
            let start = std::time::Instant::now();
            let fitted = super::fit(
                k as u16 + 1,
                &dataset,
                &frames,
                super::Surroundings { times: dataset.times.len(), near: 0.05, seed: 0, stop: &stop },
            )
            .unwrap();
            let Some(f) = fitted else {
                println!("{} {}: none, {:.1} s", instance.id, instance.label, start.elapsed().as_secs_f64());
                continue;
            };
            println!(
                "{} {}: {} {:?} size {:.4} error {:.4} {:.1} s",
                instance.id,
                instance.label,
                f.turns,
                f.rotation,
                f.size,
                f.error,
                start.elapsed().as_secs_f64()
            );
            let poses: Vec<_> = f
                .poses
                .iter()
                .map(|(t, (q, c))| serde_json::json!([t, [q.w, q.x, q.y, q.z], c.to_array()]))
                .collect();
            out.insert(instance.id.to_string(), poses.into());
        }
        std::fs::write("/tmp/poses.json", serde_json::to_string(&out).unwrap()).unwrap();
    }
}
