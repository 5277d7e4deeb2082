//! Captures as they are published: reduced by others, as videos, with cameras or images that are no good.

mod support;

use cif_dataset::{Dataset, OpenOptions};
use support::*;
use tempfile::TempDir;

/// A Neu3D capture whose images are stored reduced by a factor.
fn neu3d_reduced_by(reduction: u32) -> TempDir {
    let folder = neu3d(2, 2);
    // The fixture's poses are of images of twice the size.
    let (width, height) = (2 * WIDTH / reduction, 2 * HEIGHT / reduction);
    for camera in 0..2 {
        for step in 0..2 {
            let image = folder.path().join(format!("cam{camera:02}/images/{step:04}.png"));
            write_rgb(&image, width, height, |_, _| [9, 9, 9]);
        }
    }
    folder
}

#[test]
fn neu3d_images_that_are_stored_reduced_are_not_reduced_again() {
    let loaded = |reduction: u32, downscale: Option<u32>| {
        let folder = neu3d_reduced_by(reduction);
        let options = OpenOptions { downscale, ..OpenOptions::default() };
        let dataset = Dataset::open(folder.path(), &options).unwrap();
        let image = dataset.load_image(0, [0.0; 3]).unwrap();
        assert_eq!(
            (image.width, image.height),
            (dataset.frames[0].camera.width, dataset.frames[0].camera.height)
        );
        (image.width, dataset.frames[0].camera.focal_px.x)
    };
    // As captured, and as 4DGaussians' preprocessing leaves them: the same images either way.
    assert_eq!(loaded(1, Some(2)), (WIDTH, FOCAL));
    assert_eq!(loaded(2, Some(2)), (WIDTH, FOCAL));
    assert_eq!(loaded(2, None), (WIDTH, FOCAL));
    assert_eq!(loaded(2, Some(4)), (WIDTH / 2, FOCAL / 2.0));
    assert_eq!(loaded(1, None), (2 * WIDTH, 2.0 * FOCAL));
}

#[test]
fn cameras_can_be_left_out() {
    let without = |folder: &TempDir, names: &[&str]| {
        let without_cameras = names.iter().map(|name| (*name).to_owned()).collect();
        Dataset::open(folder.path(), &OpenOptions { without_cameras, ..OpenOptions::default() })
    };
    let folder = neu3d(3, 2);
    let whole = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let kept = without(&folder, &["cam01"]).unwrap();
    let names: Vec<&str> = kept.frames.iter().map(|frame| frame.name.as_str()).collect();
    assert_eq!(names, ["cam00/0000", "cam00/0001", "cam02/0000", "cam02/0001"]);
    assert_eq!(kept.frames[2].camera.focal_px, whole.frames[4].camera.focal_px);
    let turned = |dataset: &Dataset, frame: usize| dataset.frames[frame].camera.camera_from_world.rotation;
    assert!(
        (turned(&kept, 0).transpose() * turned(&kept, 2))
            .abs_diff_eq(turned(&whole, 0).transpose() * turned(&whole, 4), 1e-12)
    );
    // Its files may be gone: the row of its pose stays its own.
    std::fs::remove_dir_all(folder.path().join("cam01")).unwrap();
    assert!(Dataset::open(folder.path(), &OpenOptions::default()).is_err());
    let gone = without(&folder, &["cam01"]).unwrap();
    assert_eq!(gone.frames[2].camera, kept.frames[2].camera);
    let error = without(&neu3d(3, 2), &["cam07"]).unwrap_err().to_string();
    assert!(error.contains("cam07") && error.contains("cam00, cam01, cam02"), "{error}");
    assert!(without(&neu3d(2, 2), &["cam00", "cam01"]).unwrap_err().to_string().contains("keep one"));
    let error = without(&hypernerf(3), &["cam01"]).unwrap_err().to_string();
    assert!(error.contains("camera_0"), "{error}");
}

#[test]
fn videos_give_their_first_frames_reduced_while_they_are_decoded() {
    let folder = neu3d(2, 1);
    for camera in 0..2 {
        let (name, video) = (format!("cam{camera:02}"), folder.path().join(format!("cam{camera:02}.mp4")));
        let source = format!("testsrc=size={}x{}:rate=10:duration=1", 2 * WIDTH, 2 * HEIGHT);
        let made = std::process::Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", &source, "-c:v", "mpeg4"])
            .arg(&video)
            .status();
        if !made.is_ok_and(|status| status.success()) {
            eprintln!("skipped: no ffmpeg that writes MPEG-4");
            return;
        }
        std::fs::remove_dir_all(folder.path().join(name)).unwrap();
    }
    let open = |video_frames, downscale| {
        Dataset::open(folder.path(), &OpenOptions { video_frames, downscale, ..OpenOptions::default() })
            .unwrap()
    };
    let all = open(None, None);
    assert_eq!((all.frames.len(), all.frames[0].camera.width), (20, 2 * WIDTH));
    let few = open(Some(4), Some(2));
    assert_eq!(few.times, [0.0, 0.25, 0.5, 0.75]);
    let (camera, image) = (&few.frames[0].camera, few.load_image(0, [0.0; 3]).unwrap());
    assert_eq!((camera.width, camera.height, camera.focal_px.x), (WIDTH, HEIGHT, FOCAL));
    // The frames in the cache are small, and show what those of the whole video show.
    let stored = image::image_dimensions(&few.frames[0].image).unwrap();
    assert_eq!(stored, (WIDTH, HEIGHT));
    let whole = open(None, Some(1)).load_image(0, [0.0; 3]).unwrap();
    let mean = |pixels: &[[u8; 3]]| {
        pixels.iter().flatten().map(|v| f64::from(*v)).sum::<f64>() / pixels.len() as f64
    };
    assert!((mean(&image.pixels) - mean(&whole.pixels)).abs() < 6.0);
}

#[test]
fn training_frames_without_an_image_are_left_out() {
    let folder = hypernerf(6);
    let whole = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    std::fs::remove_file(folder.path().join("rgb/1x/000005.png")).unwrap();
    let dataset = Dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    assert_eq!(dataset.frames.len(), 5);
    assert!(
        warns(&dataset, &["dataset.json", "1 training frames have no image", "000005"]),
        "{:?}",
        dataset.warnings
    );
    assert_eq!(dataset.frames[4].time, whole.frames[4].time, "times stay those of the whole list");
    for k in [0, 2, 3] {
        std::fs::remove_file(folder.path().join(format!("rgb/1x/{k:06}.png"))).unwrap();
    }
    holds(&failure(&folder), &["no frame is left to train on"]);
}
