//! What shows where no Gaussian is: in steps, and in the scenes that come out of them.

use std::path::Path;

use cif_dataset::{Dataset, PointSource};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};
use cif_train::{Start, TrainConfig, Trainer};
use image::{Rgb, RgbImage, Rgba, RgbaImage};

use crate::support::{Scene, capture, small_config, train};

/// A capture without masks of one time, its images painted over: column and row to colour.
fn painted(folder: &Path, paint: impl Fn(u32, u32) -> [u8; 3]) -> Dataset {
    let dataset = capture(folder, Scene { times: 1, masks: false, ..Scene::default() });
    for frame in &dataset.frames {
        let (width, height) = (frame.camera.width, frame.camera.height);
        RgbImage::from_fn(width, height, |x, y| Rgb(paint(x, y))).save(&frame.image).unwrap();
    }
    dataset
}

/// A wall that is a little brighter to the right, with points on it.
fn wall(folder: &Path) -> Dataset {
    let mut dataset = painted(folder, |x, y| [100 + (x / 8 + y % 2) as u8, 90, 80]);
    dataset.points.positions =
        (0..900).map(|k| [(k % 30) as f32 * 0.2 - 3.0, (k / 30) as f32 * 0.2 - 3.0, 0.5]).collect();
    dataset.points.colors = vec![[103, 90, 80]; 900];
    dataset.points.source = PointSource::File(folder.join("points.ply"));
    dataset
}

fn untrained(dataset: &Dataset, background: Option<[f32; 3]>) -> [f32; 3] {
    let config = TrainConfig { background, ..small_config() };
    Trainer::new(Start::from(dataset.clone()), config).unwrap().field().background
}

/// Mean coverage of the training views.
fn coverage(trainer: &Trainer) -> f64 {
    let (field, dataset) = (trainer.field(), trainer.dataset());
    let (settings, channels) = (RenderSettings::of_field(field), Channels { depth: false, instances: false });
    let mut renderer = Renderer::new(SimdLevel::Auto);
    let mut of_view = |index: usize| {
        let alpha = renderer.render(field, &dataset.frames[index].camera, 0.0, &settings, channels).alpha;
        alpha.pixels.iter().map(|alpha| f64::from(*alpha)).sum::<f64>() / alpha.pixels.len() as f64
    };
    let views = dataset.train_frames();
    views.iter().map(|index| of_view(*index)).sum::<f64>() / views.len() as f64
}

#[test]
fn what_has_the_colour_of_the_background_leaves_no_holes() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = wall(folder.path());
    let config = small_config();
    let free = train(dataset.clone(), config.clone());
    let shown = free.field().background;
    // Of the borders: 48 columns of 100 to 105, every other row one more.
    for (channel, mean) in [103.0, 90.0, 80.0].into_iter().enumerate() {
        assert!((255.0 * shown[channel] - mean).abs() < 1.0, "{shown:?}");
    }
    let constant = train(dataset, TrainConfig { background: Some(shown), ..config });
    let covered = [&free, &constant].map(coverage);
    println!("covered: {covered:?}");
    assert!(covered[0] > 0.98 && covered[1] < 0.9, "{covered:?}");
}

#[test]
fn backdrops_and_transparent_pixels_keep_their_colour() {
    let folder = tempfile::tempdir().unwrap();
    let white = capture(folder.path(), Scene { times: 1, ..Scene::default() });
    assert_eq!(untrained(&white, None), [1.0; 3]);
    assert_eq!(untrained(&white, Some([0.25, 0.5, 0.0])), [0.25, 0.5, 0.0]);

    let folder = tempfile::tempdir().unwrap();
    let noise = |x: u32, y: u32| [(37 * x + 91 * y) as u8; 3];
    let studio = painted(folder.path(), |x, y| if x < 24 && y < 24 { [0, 51, 255] } else { noise(x, y) });
    assert_eq!(untrained(&studio, None), [0.0, 0.2, 1.0], "a quarter of the border and more");

    // Alpha that is 1 everywhere hides nothing.
    let mut dataset = wall(folder.path());
    let without_alpha = untrained(&dataset, None);
    dataset.has_alpha = true;
    let lay = |alpha: u8| {
        for frame in &dataset.frames {
            let opaque = image::open(&frame.image).unwrap().to_rgb8();
            let of = |x: u32, y: u32| {
                let [r, g, b] = opaque.get_pixel(x, y).0;
                Rgba([r, g, b, if x == 30 { alpha } else { 255 }])
            };
            RgbaImage::from_fn(opaque.width(), opaque.height(), of).save(&frame.image).unwrap();
        }
    };
    lay(255);
    assert_eq!(untrained(&dataset, None), without_alpha);
    lay(100);
    assert_eq!(untrained(&dataset, None), [1.0; 3]);
}
