//! Losses of a scene on its way through a file: the field, and the copy of it that the file gives back, drawn from the
//! same views.
//!
//! Objects are judged inside the pixels where the field shows them ([`InstanceImage::foreground_label`]).

use std::collections::BTreeMap;

use cif_dataset::{Dataset, Split};
use cif_field::Field;
use cif_geometry::stats::mean;
use cif_geometry::{PinholeCamera, PixelGrid};
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, InstanceImage, RenderedImage};
use serde::Serialize;

use super::evaluate::{EvaluationError, EvaluationOptions, Scores, evaluate, mask_ids, trained_settings};
use super::image::{psnr, unit_color};
use super::instance::{FrameConfusion, instance_metrics};

/// A view in which the field and the copy are compared.
#[derive(Clone, Copy, Debug)]
pub struct SharedView<'a> {
    /// Name of the camera.
    pub name: &'a str,
    /// Place in the timeline of the field.
    pub time_index: usize,
    /// The view.
    pub camera: &'a PinholeCamera,
    /// The same moment in the normalised time of the field and in that of the copy.
    pub times: [f64; 2],
}

/// Likeness of the copy to the field: the pictures of the field count as truth.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Likeness {
    /// Views compared.
    pub views: usize,
    /// PSNR of the pictures of the copy, mean over those that differ, dB; `None` where all are equal.
    pub psnr: Option<f64>,
    /// mIoU of what the copy shows, as in [`super::InstanceMetrics::miou`], percent; `None` without instances.
    pub miou: Option<f64>,
    /// Every object that the field shows, ascending id.
    pub objects: Vec<ObjectLikeness>,
}

/// Likeness inside the pixels of an object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObjectLikeness {
    /// Mask id; 0 for everything that belongs to no object.
    pub id: u16,
    /// PSNR over its pixels in all views, dB; `None` where they are equal.
    pub psnr: Option<f64>,
    /// Mean over views of the intersection over union, percent; `None` for id 0.
    pub iou: Option<f64>,
}

/// Scores of the field and of the copy on the same held-out images.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HeldOutLoss {
    /// Scores of the field.
    pub field: Scores,
    /// Scores of the copy.
    pub copy: Scores,
    /// Every object that the field shows, ascending id.
    pub objects: Vec<ObjectLoss>,
}

/// Scores inside the pixels of an object; in arrays the field comes first, then the copy.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObjectLoss {
    /// Mask id; 0 for everything that belongs to no object.
    pub id: u16,
    /// PSNR over its pixels in all images, dB; `None` where they are equal.
    pub psnr: [Option<f64>; 2],
    /// IoU as in [`super::InstanceScore::iou`], percent; `None` where no mask shows the object.
    pub iou: [Option<f64>; 2],
}

/// Compares the pictures of two fields in shared views; `observe` is called before each.
///
/// # Errors
/// When `observe` fails.
pub fn likeness<E>(
    field: &Field,
    copy: &Field,
    views: &[SharedView<'_>],
    simd: SimdLevel,
    mut observe: impl FnMut() -> Result<(), E>,
) -> Result<Likeness, E> {
    let mut painters = [field, copy].map(|field| Painter::new(field, simd));
    let mut errors = ObjectErrors::default();
    let (mut finite, mut confusions) = (Vec::new(), Vec::new());
    for view in views {
        observe()?;
        let [(truth, shown), (image, found)] =
            [0, 1].map(|which: usize| painters[which].draw(view.camera, view.times[which]));
        let truth = truth.color.map(|pixel| pixel.map(|value| value.clamp(0.0, 1.0)));
        finite.extend(Some(psnr(&image.color, &truth)).filter(|value| value.is_finite()));
        errors.add(&shown, &image.color, &truth);
        if copy.identities.is_some() {
            confusions.push(FrameConfusion::new(view.name, view.time_index, &shown, &found));
        }
    }
    let instances = instance_metrics(&confusions);
    let iou = |id| instances.instances.iter().find(|score| score.id == id).and_then(|score| score.iou);
    let objects = errors.ids().map(|id| ObjectLikeness { id, psnr: errors.psnr(id), iou: iou(id) });
    Ok(Likeness { views: views.len(), psnr: mean(&finite), miou: instances.miou, objects: objects.collect() })
}

/// Scores two fields on the held-out frames of captures that differ in nothing but times, those of `field` and those of
/// `copy`; `observe` is called after each frame.
///
/// # Errors
/// As [`evaluate`](fn@evaluate).
pub fn held_out_loss<E: From<EvaluationError>>(
    [field, copy]: [&Field; 2],
    [dataset, copy_dataset]: [&Dataset; 2],
    simd: SimdLevel,
    mut observe: impl FnMut() -> Result<(), E>,
) -> Result<HeldOutLoss, E> {
    let options = |field| EvaluationOptions {
        split: Split::Val,
        settings: trained_settings(field),
        simd,
        depth: false,
        covisible: false,
        decoder: None,
    };
    let mut errors = [ObjectErrors::default(), ObjectErrors::default()];
    let mut shown = Vec::new();
    let of_field = evaluate(field, dataset, &options(field), |view| {
        let ids = shown_ids(field, view.rendered);
        errors[0].add(&ids, &view.rendered.color, &unit_color(&view.truth.image));
        shown.push(ids);
        observe()
    })?;
    let mut frames = shown.iter();
    let of_copy = evaluate(copy, copy_dataset, &options(copy), |view| {
        if let Some(ids) = frames.next() {
            errors[1].add(ids, &view.rendered.color, &unit_color(&view.truth.image));
        }
        observe()
    })?;
    let [of_field, of_copy] = [of_field.overall, of_copy.overall];
    let iou = |scores: &Scores, id| {
        scores.instance.instances.iter().find(|score| score.id == id).and_then(|score| score.iou)
    };
    let objects = errors[0].ids().map(|id| ObjectLoss {
        id,
        psnr: [0, 1].map(|which: usize| errors[which].psnr(id)),
        iou: [&of_field, &of_copy].map(|scores| iou(scores, id)),
    });
    Ok(HeldOutLoss { objects: objects.collect(), field: of_field, copy: of_copy })
}

/// A field and the renderer that draws it as it was trained.
struct Painter<'a> {
    field: &'a Field,
    renderer: Renderer,
}

impl<'a> Painter<'a> {
    fn new(field: &'a Field, simd: SimdLevel) -> Self {
        Self { field, renderer: Renderer::new(simd) }
    }

    /// The picture, and the ids of the objects that show in it.
    fn draw(&mut self, camera: &PinholeCamera, time: f64) -> (RenderedImage, PixelGrid<u16>) {
        let settings = trained_settings(self.field);
        let channels = Channels { depth: false, instances: settings.instances.is_some() };
        let image = self.renderer.render(self.field, camera, time, &settings, channels);
        let ids = shown_ids(self.field, &image);
        (image, ids)
    }
}

/// Ids of the objects that show; 0 where none does.
fn shown_ids(field: &Field, image: &RenderedImage) -> PixelGrid<u16> {
    match &image.instances {
        Some(instances) => mask_ids(field, &InstanceImage::foreground_label(instances)),
        None => image.alpha.map(|_| 0),
    }
}

/// Squared colour errors summed over the pixels of every object.
#[derive(Debug, Default)]
struct ObjectErrors(BTreeMap<u16, (f64, u64)>);

impl ObjectErrors {
    /// Adds a picture, clamped to [0, 1] as in [`psnr`]; `ids` says which object shows where.
    fn add(&mut self, ids: &PixelGrid<u16>, rendered: &PixelGrid<[f32; 3]>, truth: &PixelGrid<[f32; 3]>) {
        for ((id, a), b) in ids.pixels.iter().zip(&rendered.pixels).zip(&truth.pixels) {
            let (squares, values) = self.0.entry(*id).or_default();
            for (a, b) in a.iter().zip(b) {
                *squares += (f64::from(a.clamp(0.0, 1.0)) - f64::from(*b)).powi(2);
            }
            *values += 3;
        }
    }

    fn ids(&self) -> impl Iterator<Item = u16> {
        self.0.keys().copied()
    }

    /// dB; `None` where nothing differs or the object shows nowhere.
    fn psnr(&self, id: u16) -> Option<f64> {
        let (squares, values) = self.0.get(&id)?;
        Some(-10.0 * (squares / *values as f64).log10()).filter(|value| value.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use cif_field::{Identities, Instance};
    use cif_render::synthetic::{SyntheticConfig, SyntheticScene, generate};
    use glam::DVec3;

    use super::*;

    /// Two objects, left and right, that fill the view.
    fn scene() -> SyntheticScene {
        let config = SyntheticConfig {
            seed: 4,
            gaussians: 120,
            instances: 2,
            width: 48,
            height: 32,
            heads: None,
            screen_size: (0.05, 0.1),
        };
        let mut scene = generate(&config);
        let field = &mut scene.field;
        field.gaussians.opacity_logits.fill(3.0);
        field.gaussians.occupancy_logits.fill(3.0);
        let camera_from_world = scene.camera.camera_from_world;
        let mut identities = Identities::empty();
        for mean in &field.gaussians.means {
            let mean = camera_from_world.rotation * DVec3::from_array(mean.map(f64::from));
            identities.push_certain(Some(u16::from((mean + camera_from_world.translation).x > 0.0)));
        }
        field.identities = Some(identities);
        field.instances = [(3, "left"), (8, "right")]
            .map(|(id, label)| Instance {
                id,
                label: label.into(),
                category: label.into(),
                taxonomies: Default::default(),
            })
            .into();
        scene
    }

    fn compare(field: &Field, copy: &Field, camera: &PinholeCamera) -> Likeness {
        let views =
            [0.0, 0.5].map(|time| SharedView { name: "left", time_index: 0, camera, times: [time; 2] });
        likeness(field, copy, &views, SimdLevel::Auto, || Ok::<(), ()>(())).unwrap()
    }

    #[test]
    fn a_perfect_copy_loses_nothing() {
        let SyntheticScene { field, camera, .. } = scene();
        let same = compare(&field, &field.clone(), &camera);
        assert_eq!((same.views, same.psnr, same.miou), (2, None, Some(100.0)));
        let reported: Vec<(u16, bool)> =
            same.objects.iter().map(|object| (object.id, object.psnr.is_none())).collect();
        assert!(reported.contains(&(3, true)) && reported.contains(&(8, true)), "{reported:?}");
    }

    #[test]
    fn the_object_that_changed_is_found() {
        let SyntheticScene { field, camera, .. } = scene();
        let owners = field.identities.as_ref().unwrap().argmax();
        let rows = || (0..field.len()).filter(|row| owners[*row] == Some(1));
        assert!(rows().count() > 20);
        let mut copy = field.clone();
        for row in rows() {
            copy.gaussians.sh_coefficients[row][0] += 0.7;
        }
        let reported = compare(&field, &copy, &camera);
        let of = |id: u16| reported.objects.iter().find(|object| object.id == id).unwrap();
        let [left, right] = [3, 8].map(|id| of(id).psnr.unwrap_or(f64::INFINITY));
        assert!(right < 25.0 && left > right + 5.0, "{reported:#?}");
        assert_eq!((reported.miou, of(8).iou), (Some(100.0), Some(100.0)), "shapes are as they were");

        // Without the object its pixels belong to nobody.
        for row in rows() {
            copy.gaussians.opacity_logits[row] = -9.0;
            copy.gaussians.occupancy_logits[row] = -9.0;
        }
        let reported = compare(&field, &copy, &camera);
        let iou = |id: u16| reported.objects.iter().find(|object| object.id == id).unwrap().iou.unwrap();
        assert!(iou(8) < 30.0 && iou(3) > 60.0, "{reported:#?}");
    }

    #[test]
    fn errors_are_pooled_over_the_pixels_of_an_object() {
        let mut errors = ObjectErrors::default();
        let grid = |values: [f32; 3]| PixelGrid::from_pixels(3, 1, values.map(|v| [v; 3]).to_vec());
        let ids = PixelGrid::from_pixels(3, 1, vec![0, 5, 5]);
        errors.add(&ids, &grid([0.5, 0.1, 2.0]), &grid([0.5, 0.2, 1.0]));
        errors.add(&ids, &grid([0.5, 0.1, 1.0]), &grid([0.5, 0.0, 1.0]));
        assert_eq!((errors.psnr(0), errors.psnr(7)), (None, None));
        // Two of four pixels miss 0.1.
        let expected = -10.0 * (0.5 * 0.01_f64).log10();
        assert!((errors.psnr(5).unwrap() - expected).abs() < 1e-5);
    }
}
