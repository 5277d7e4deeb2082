//! Changes to a scene that must not change its image, and empty scenes.

use crate::support::{Cotangents, plain_camera};
use cif_field::{Field, Gaussians};
use cif_geometry::PixelGrid;
use cif_render::reference::{self, Scene};
use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
use cif_render::{Channels, InstanceSettings, RenderSettings};

const EVERYTHING: Channels = Channels { depth: true, instances: true };

fn settings() -> RenderSettings {
    RenderSettings { instances: Some(InstanceSettings::default()), ..RenderSettings::default() }
}

/// `field` with Gaussian 0 repeated at the end, to be edited.
fn with_another(field: &Field) -> Field {
    let mut rows: Vec<u32> = (0..field.gaussians.len() as u32).collect();
    rows.push(0);
    Field {
        gaussians: field.gaussians.gather(&rows),
        identities: field.identities.as_ref().map(|identities| identities.gather(&rows)),
        ..field.clone()
    }
}

fn image(field: &Field, scene: &SyntheticScene) -> cif_render::RenderedImage {
    reference::render::<f64>(field, &scene.camera, scene.time, &settings(), EVERYTHING)
}

#[test]
fn what_cannot_be_seen_changes_nothing() {
    let scene = generate(&SyntheticConfig::default());
    let before = image(&scene.field, &scene);
    let n = scene.field.gaussians.len();
    type Edit<'a> = &'a dyn Fn(&mut Gaussians);
    let edits: [(&str, Edit<'_>); 5] = [
        ("behind the camera", &|g| {
            let behind = scene.camera.centre() - scene.camera.forward() * 2.0;
            g.means[n] = behind.as_vec3().to_array();
        }),
        ("far outside the image", &|g| {
            let centre = scene.camera.centre();
            let sideways = scene.camera.camera_from_world.rotation.row(0);
            g.means[n] = (centre + scene.camera.forward() * 3.0 + sideways * 40.0).as_vec3().to_array();
            g.log_scales[n] = [-3.0; 3];
        }),
        ("transparent", &|g| {
            g.opacity_logits[n] = -5.6;
            g.occupancy_logits[n] = -5.6;
        }),
        ("not a number", &|g| g.means[n][1] = f32::NAN),
        ("without orientation", &|g| g.quaternions[n] = [0.0; 4]),
    ];
    for (name, edit) in edits {
        let mut field = with_another(&scene.field);
        edit(&mut field.gaussians);
        assert!(image(&field, &scene) == before, "{name} changed the image");
    }
    // The comparison can fail: a visible one does change it.
    assert!(image(&with_another(&scene.field), &scene) != before);
}

#[test]
fn a_hidden_splat_changes_nothing() {
    // Four saturated walls stop every pixel before the hidden splat is reached.
    let mut field = generate(&SyntheticConfig { gaussians: 5, ..SyntheticConfig::default() }).field;
    let camera = plain_camera(16, 12, 14.0);
    for (index, depth) in [2.0, 2.1, 2.2, 2.3, 5.0].into_iter().enumerate() {
        field.gaussians.means[index] = [0.0, 0.0, depth];
        field.gaussians.log_scales[index] = if index < 4 { [4.0; 3] } else { [-1.0; 3] };
        field.gaussians.opacity_logits[index] = 12.0;
        field.gaussians.occupancy_logits[index] = 12.0;
    }
    let render = |field: &Field| reference::render::<f64>(field, &camera, 0.0, &settings(), EVERYTHING);
    let before = render(&field);
    field.gaussians.sh_coefficients[4] = [3.0; 48];
    assert!(render(&field) == before);
    field.gaussians.sh_coefficients[0] = [3.0; 48];
    assert!(render(&field) != before, "the comparison must be able to fail");
}

#[test]
fn nothing_gives_the_background() {
    // Methods reference 7, row 41: an empty visible set, no labels, all pixels unlabelled.
    let config = SyntheticConfig { gaussians: 0, ..SyntheticConfig::default() };
    let synthetic = generate(&config);
    let rendered = image(&synthetic.field, &synthetic);
    assert!(rendered.color.pixels.iter().all(|color| *color == settings().background));
    assert!(rendered.alpha.pixels.iter().all(|alpha| *alpha == 0.0));
    assert!(rendered.depth.unwrap().pixels.iter().all(|depth| *depth == 0.0));
    let instances = rendered.instances.unwrap();
    assert!(instances.label.pixels.iter().all(|label| *label == 0));
    assert!(instances.entropy.pixels.iter().all(|entropy| *entropy == 0.0));
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let forward = crate::support::render(&scene, &synthetic, &settings());
    assert_eq!(forward.loss.labelled_pixels, forward.loss.unsupported_pixels);
    assert!((forward.loss.mean + f64::from(1e-8_f32).ln()).abs() < 1e-9);
    let gradients = Cotangents::random(3, config.width, config.height).backward(&scene, &forward);
    assert!(gradients.parameters.is_empty() && gradients.clipped == 0);
}

#[test]
fn a_frame_without_labels_has_no_instance_loss() {
    let mut synthetic = generate(&SyntheticConfig::default());
    synthetic.labels.pixels.fill(0);
    let scene = Scene::<f64>::from_field(&synthetic.field);
    let forward = crate::support::render(&scene, &synthetic, &settings());
    assert_eq!((forward.loss.mean, forward.loss.labelled_pixels), (0.0, 0));
    let (width, height) = (synthetic.camera.width, synthetic.camera.height);
    let mut cotangents = Cotangents::random(3, width, height);
    cotangents.color = PixelGrid::filled(width, height, [0.0; 3]);
    (cotangents.depth, cotangents.alpha) = (None, None);
    let gradients = cotangents.backward(&scene, &forward);
    assert_eq!(gradients.parameters, scene.parameters.zeros_like());
}

#[test]
fn an_odd_image_is_the_crop_of_a_larger_one() {
    let config = SyntheticConfig { width: 17, height: 33, gaussians: 12, ..SyntheticConfig::default() };
    let synthetic = generate(&config);
    let small = image(&synthetic.field, &synthetic);
    let mut larger = synthetic.clone();
    (larger.camera.width, larger.camera.height) = (48, 48);
    let large = image(&synthetic.field, &larger);
    // The Jacobian clamp depends on the image size; this scene does not reach it.
    for y in 0..33 {
        for x in 0..17 {
            for channel in 0..3 {
                let (a, b) = (small.color.at(x, y)[channel], large.color.at(x, y)[channel]);
                assert!((a - b).abs() < 1e-6, "({x}, {y}): {a} {b}");
            }
            let labels =
                |image: &cif_render::RenderedImage| *image.instances.as_ref().unwrap().label.at(x, y);
            assert_eq!(labels(&small), labels(&large));
        }
    }
}

#[test]
fn coincident_splats_blend_in_index_order() {
    // Methods reference 7, row 33.
    let synthetic = generate(&SyntheticConfig { gaussians: 1, ..SyntheticConfig::default() });
    let mut field = with_another(&synthetic.field);
    field.gaussians.sh_coefficients[1] = [0.4; 48];
    let scene = Scene::<f64>::from_field(&field);
    let forward = reference::forward(&scene, &synthetic.camera, 0.0, &RenderSettings::default(), None);
    assert_eq!(forward.order, [0, 1]);
}
