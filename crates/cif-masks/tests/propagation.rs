//! Propagation on clips of moving shapes whose masks are known.

use std::collections::BTreeMap;

use cif_dataset::{Frame, Split};
use cif_geometry::{LensDistortion, PinholeCamera, PixelGrid, RigidTransform};
use cif_masks::flow::{Pyramid, flow};
use cif_masks::plane::Plane;
use cif_masks::rig::{View, carry};
use cif_masks::{Clip, Error, Keyframe, Mask, propagate};
use glam::{DMat3, DVec2, DVec3};

const WIDTH: usize = 96;
const HEIGHT: usize = 72;

/// Smooth noise in 0 to 1 that is the same at the same place: sums of waves of a texture.
fn texture(seed: f32, x: f32, y: f32) -> f32 {
    let wave = |a: f32, b: f32, phase: f32| (a * x + b * y + phase * seed).sin();
    0.5 + 0.13
        * (wave(0.31, 0.17, 1.0) + wave(-0.23, 0.41, 2.3) + wave(0.71, -0.53, 3.1) + wave(0.11, 0.83, 4.7))
}

/// A disk or box with a texture of its own that moves along.
struct Shape {
    id: u16,
    color: [f32; 3],
    half: f32,
    round: bool,
    /// Centre at a frame, pixels.
    at: fn(f32) -> (f32, f32),
}

/// Image and mask of a frame: shapes, later ones in front, on a textured ground that moves slowly.
fn render(shapes: &[Shape], frame: usize) -> (PixelGrid<[u8; 3]>, PixelGrid<u16>) {
    let t = frame as f32;
    let (mut pixels, mut ids) = (Vec::new(), Vec::new());
    for k in 0..WIDTH * HEIGHT {
        let (x, y) = ((k % WIDTH) as f32, (k / WIDTH) as f32);
        let shade = texture(1.0, x - 0.3 * t, y);
        let (mut color, mut id) = ([90.0, 100.0, 80.0].map(|c| c * (0.6 + 0.8 * shade)), 0);
        for shape in shapes {
            let (cx, cy) = (shape.at)(t);
            let (dx, dy) = (x - cx, y - cy);
            let inside = if shape.round {
                dx * dx + dy * dy < shape.half * shape.half
            } else {
                dx.abs().max(dy.abs()) < shape.half
            };
            if inside {
                let shade = texture(f32::from(shape.id), dx, dy);
                (color, id) = (shape.color.map(|c| c * (0.6 + 0.8 * shade)), shape.id);
            }
        }
        pixels.push(color.map(|c| c.clamp(0.0, 255.0) as u8));
        ids.push(id);
    }
    let size = (WIDTH as u32, HEIGHT as u32);
    (PixelGrid::from_pixels(size.0, size.1, pixels), PixelGrid::from_pixels(size.0, size.1, ids))
}

fn run(shapes: &[Shape], frames: usize, keys: &[usize]) -> Vec<Mask> {
    let keyframes: BTreeMap<usize, Keyframe> =
        keys.iter().map(|key| (*key, Keyframe::painted(render(shapes, *key).1))).collect();
    let image = |k: usize| Ok(render(shapes, k).0);
    let clip = Clip { frames, image: &image, keyframes: &keyframes, stop: &|| false };
    let mut masks = vec![None; frames];
    propagate(&clip, &mut |k, mask| {
        assert!(masks[k].replace(mask).is_none(), "frame {k} comes twice");
        Ok(())
    })
    .expect("the clip can be propagated");
    masks.into_iter().map(|mask| mask.expect("every frame has a mask")).collect()
}

fn overlap(mask: &PixelGrid<u16>, truth: &PixelGrid<u16>, id: u16) -> f64 {
    let pairs = || mask.pixels.iter().zip(&truth.pixels);
    let both = pairs().filter(|(a, b)| **a == id && **b == id).count();
    let any = pairs().filter(|(a, b)| **a == id || **b == id).count();
    if any == 0 { 1.0 } else { both as f64 / any as f64 }
}

fn disk(id: u16, color: [f32; 3], at: fn(f32) -> (f32, f32)) -> Shape {
    Shape { id, color, half: 10.0, round: true, at }
}

#[test]
fn flow_finds_a_known_warp() {
    // The second image is the first one moved, turned and enlarged a little.
    let warp = |x: f32, y: f32| {
        let (dx, dy) = (x - 60.0, y - 45.0);
        (60.0 + 1.02 * dx - 0.03 * dy + 3.4, 45.0 + 0.03 * dx + 1.02 * dy - 2.2)
    };
    let value = |x: f32, y: f32| 255.0 * texture(2.0, x, y);
    let second = Pyramid::new(Plane::from_fn(120, 90, |x, y| value(x as f32, y as f32)));
    let first = Pyramid::new(Plane::from_fn(120, 90, |x, y| {
        let (x, y) = warp(x as f32, y as f32);
        value(x, y)
    }));
    let found = flow(&first, &second);
    let mut errors = Vec::new();
    for y in 8..82 {
        for x in 8..112 {
            let (to_x, to_y) = warp(x as f32, y as f32);
            let k = y * 120 + x;
            let (u, v) = (found.u.data[k], found.v.data[k]);
            errors.push((x as f32 + u - to_x).hypot(y as f32 + v - to_y));
        }
    }
    let mean = errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(mean < 0.1, "mean end-point error {mean} px");
}

#[test]
fn flow_between_equal_images_is_zero() {
    let pyramid = Pyramid::new(Plane::from_fn(50, 41, |x, y| 255.0 * texture(3.0, x as f32, y as f32)));
    let found = flow(&pyramid, &pyramid);
    assert!(found.u.data.iter().chain(&found.v.data).all(|value| value.abs() < 1e-3));
    // No structure, and fewer pixels than a patch has.
    let flat = Pyramid::new(Plane::filled(5, 3, 7.0));
    assert!(flow(&flat, &flat).u.data.iter().all(|value| *value == 0.0));
}

#[test]
fn moving_objects_are_followed_from_one_keyframe() {
    let shapes = [
        disk(3, [200.0, 60.0, 50.0], |t| (20.0 + 2.5 * t, 25.0)),
        disk(7, [50.0, 80.0, 200.0], |t| (70.0 - 1.5 * t, 52.0)),
    ];
    let masks = run(&shapes, 16, &[0]);
    for k in [5, 10, 15] {
        let truth = render(&shapes, k).1;
        for id in [3, 7] {
            let score = overlap(&masks[k].ids, &truth, id);
            assert!(score > 0.85, "object {id} in frame {k}: {score}");
        }
    }
    assert_eq!(masks[0].ids, render(&shapes, 0).1);
    assert!(masks[0].confidence.pixels.iter().all(|value| *value == 255));
}

#[test]
fn an_object_comes_back_from_behind_another() {
    // A box slides over a disk of another colour, covers it whole for a while, and leaves.
    let shapes = [
        disk(1, [210.0, 190.0, 40.0], |_| (48.0, 36.0)),
        Shape {
            id: 2,
            color: [120.0, 40.0, 150.0],
            half: 14.0,
            round: false,
            at: |t| (10.0 + 3.5 * t, 36.0),
        },
    ];
    let masks = run(&shapes, 23, &[0, 22]);
    let hidden = render(&shapes, 11).1.pixels.iter().filter(|id| **id == 1).count();
    assert_eq!(hidden, 0, "the disk is hidden in the middle");
    for k in [3, 6, 11, 17, 20] {
        let truth = render(&shapes, k).1;
        for id in [1, 2] {
            let score = overlap(&masks[k].ids, &truth, id);
            let claimed = masks[k].ids.pixels.iter().filter(|found| **found == id).count();
            // A sliver that is left of the disk is hard; where it is hidden there must be next to none of it.
            assert!(score > 0.6 || claimed < 20, "object {id} in frame {k}: {score}, {claimed} pixels");
        }
    }
    assert!(overlap(&masks[20].ids, &render(&shapes, 20).1, 1) > 0.8);
}

#[test]
fn an_object_that_enters_late_is_not_there_before() {
    // It enters from the right at frame 8, and only the last keyframe shows it.
    let shapes = [
        disk(1, [200.0, 60.0, 50.0], |t| (20.0 + t, 25.0)),
        disk(4, [40.0, 170.0, 190.0], |t| (130.0 - 3.0 * t, 50.0)),
    ];
    let masks = run(&shapes, 24, &[0, 23]);
    for k in 1..23 {
        let truth = render(&shapes, k).1;
        let real = truth.pixels.iter().filter(|id| **id == 4).count();
        let claimed = masks[k].ids.pixels.iter().filter(|id| **id == 4).count();
        if real == 0 {
            assert!(claimed < 20, "frame {k} claims {claimed} pixels of what is not there");
        } else if real > 150 {
            let score = overlap(&masks[k].ids, &truth, 4);
            assert!(score > 0.7, "frame {k}: {score}");
        }
    }
}

#[test]
fn results_do_not_depend_on_threads() {
    let shapes = [
        disk(1, [200.0, 60.0, 50.0], |t| (20.0 + 2.0 * t, 25.0)),
        disk(2, [190.0, 70.0, 60.0], |t| (70.0 - 2.0 * t, 45.0)),
    ];
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&shapes, 8, &[0, 5]))
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn unsure_pixels_say_so() {
    let shapes = [
        disk(1, [200.0, 60.0, 50.0], |t| (20.0 + 2.5 * t, 30.0)),
        disk(2, [195.0, 65.0, 55.0], |t| (76.0 - 2.5 * t, 42.0)),
    ];
    let masks = run(&shapes, 23, &[0, 22]);
    let (mut wrong, mut right) = ((0.0, 0), (0.0, 0));
    for (k, mask) in masks.iter().enumerate() {
        let truth = render(&shapes, k).1;
        for (k, confidence) in mask.confidence.pixels.iter().enumerate() {
            let sum = if mask.ids.pixels[k] == truth.pixels[k] { &mut right } else { &mut wrong };
            *sum = (sum.0 + f64::from(*confidence), sum.1 + 1);
        }
    }
    assert!(wrong.1 > 50, "nothing is wrong, so nothing is tested");
    let mean = |(sum, count): (f64, usize)| sum / count as f64 / 255.0;
    assert!(mean(wrong) + 0.15 < mean(right), "wrong {:.2}, right {:.2}", mean(wrong), mean(right));
}

#[test]
fn keyframes_need_an_object_and_the_caller_may_stop() {
    let image = |k: usize| Ok(render(&[], k).0);
    let empty = BTreeMap::from([(0, Keyframe::painted(PixelGrid::filled(WIDTH as u32, HEIGHT as u32, 0)))]);
    let mut ignore = |_: usize, _: Mask| Ok(());
    let clip = Clip { frames: 3, image: &image, keyframes: &empty, stop: &|| false };
    assert!(matches!(propagate(&clip, &mut ignore), Err(Error::NoObject)));
    let none = BTreeMap::new();
    assert!(matches!(propagate(&Clip { keyframes: &none, ..clip }, &mut ignore), Err(Error::NoObject)));
    let some = BTreeMap::from([(0, Keyframe::painted(PixelGrid::filled(WIDTH as u32, HEIGHT as u32, 1)))]);
    let clip = Clip { frames: 3, image: &image, keyframes: &some, stop: &|| true };
    assert!(matches!(propagate(&clip, &mut ignore), Err(Error::Stopped)));
}

#[test]
fn large_images_are_followed_smaller_and_keep_their_size() {
    let big = |k: usize| {
        let (image, ids) = render(&[disk(5, [200.0, 60.0, 50.0], |t| (30.0 + 2.0 * t, 36.0))], k);
        let factor = 9;
        let (width, height) = (image.width * factor, image.height * factor);
        let at = |k: u32| (k % width / factor, k / width / factor);
        let pixels = (0..width * height).map(|k| *image.at(at(k).0, at(k).1)).collect();
        let ids = (0..width * height).map(|k| *ids.at(at(k).0, at(k).1)).collect();
        (PixelGrid::from_pixels(width, height, pixels), PixelGrid::from_pixels(width, height, ids))
    };
    let keyframes = BTreeMap::from([(0, Keyframe::painted(big(0).1))]);
    let image = |k: usize| Ok(big(k).0);
    let clip = Clip { frames: 2, image: &image, keyframes: &keyframes, stop: &|| false };
    propagate(&clip, &mut |k, mask| {
        let truth = big(k).1;
        assert_eq!((mask.ids.width, mask.ids.height), (864, 648));
        assert!(overlap(&mask.ids, &truth, 5) > 0.9);
        Ok(())
    })
    .unwrap();
}

/// Image and ids of a wall at z = 0 with two squares, seen from (x, 0, -2) by a camera with some lens distortion.
fn wall(x: f64) -> (Frame, PixelGrid<[u8; 3]>, PixelGrid<u16>) {
    let (width, height) = (120, 90);
    let camera = PinholeCamera {
        width,
        height,
        focal_px: DVec2::splat(110.0),
        principal_px: DVec2::new(60.0, 45.0),
        camera_from_world: RigidTransform {
            rotation: DMat3::IDENTITY,
            translation: DVec3::new(-x, 0.0, 2.0),
        },
    };
    let lens = LensDistortion { radial: [-0.12, 0.0, 0.0, 0.0], ..LensDistortion::default() };
    let (mut pixels, mut ids) = (Vec::new(), Vec::new());
    for k in 0..width * height {
        let pixel = DVec2::new(f64::from(k % width) + 0.5, f64::from(k / width) + 0.5);
        let ideal = lens
            .undistort((pixel - camera.principal_px) / camera.focal_px)
            .expect("the lens covers the image");
        let place = camera.centre() + DVec3::new(ideal.x, ideal.y, 1.0) * 2.0;
        let near = |cx: f64, cy: f64| (place.x - cx).abs().max((place.y - cy).abs()) < 0.25;
        // Both squares look alike: only points can distinguish them.
        let id = if near(-0.4, 0.1) { 5 } else { u16::from(near(0.4, -0.1)) * 8 };
        let shade = 0.6 + 0.8 * texture(1.5, 40.0 * place.x as f32, 40.0 * place.y as f32);
        let color = if id == 0 { [60.0, 90.0, 110.0] } else { [190.0, 80.0, 60.0] };
        pixels.push(color.map(|c: f32| (c * shade).clamp(0.0, 255.0) as u8));
        ids.push(id);
    }
    let frame = Frame {
        name: format!("{x}"),
        camera_name: format!("{x}"),
        camera,
        lens,
        time: 0.0,
        time_index: 0,
        split: Split::Train,
        group: None,
        image: "image.png".into(),
        turn: cif_dataset::Turn::NONE,
        source: None,
        mask: None,
        confidence: None,
    };
    (frame, PixelGrid::from_pixels(width, height, pixels), PixelGrid::from_pixels(width, height, ids))
}

#[test]
fn points_bring_ids_to_another_camera() {
    let (left, left_image, left_ids) = wall(-0.15);
    let (right, right_image, truth) = wall(0.15);
    let mut points: Vec<DVec3> = (0..900)
        .map(|k| DVec3::new(f64::from(k % 30) * 0.07 - 1.0, f64::from(k / 30) * 0.06 - 0.9, 0.0))
        .collect();
    // Points behind the wall would bring wrong ids if they were taken as seen.
    points.extend(
        (0..300).map(|k| DVec3::new(f64::from(k % 20) * 0.1 - 1.0, f64::from(k / 20) * 0.1 - 0.7, 0.8)),
    );
    let known = Keyframe::painted(left_ids);
    let view = |frame, image| View { frame, image };
    let found = carry(&[(view(&left, &left_image), &known)], &view(&right, &right_image), &points).unwrap();
    for id in [5, 8] {
        let score = overlap(&found.ids, &truth, id);
        assert!(score > 0.8, "object {id}: {score}");
    }
    let confidence = found.confidence.unwrap();
    assert!(confidence.pixels.iter().all(|value| (0.0..=1.0).contains(value)));
    let behind = [DVec3::new(0.0, 0.0, -5.0)];
    assert!(carry(&[(view(&left, &left_image), &known)], &view(&right, &right_image), &behind).is_none());
}
