//! Variants of captures whose changes must not matter, or must not break a run.

use std::path::{Path, PathBuf};

use cif_dataset::{Dataset, InstanceLabel, Split};
use cif_geometry::{LensDistortion, PixelGrid, RigidTransform};
use glam::{DMat3, DVec3};
use image::{ImageBuffer, Luma, Rgb};

use crate::Error;

/// Loss of quality that a change may cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Demand {
    /// Nothing: the same scene in another form.
    Same,
    /// The run ends with a finite scene; the loss is reported.
    Finite,
}

/// One change.
#[derive(Clone, Copy)]
pub struct HardCapture {
    /// Name, as typed.
    pub name: &'static str,
    /// The change, in a few words.
    pub what: &'static str,
    /// Loss of quality that it may cost.
    pub demand: Demand,
    /// Part of the quick subset.
    pub quick: bool,
    make: fn(&mut Dataset, &Path) -> Result<(), Unfit>,
}

impl std::fmt::Debug for HardCapture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("HardCapture").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Reason why a capture has no such variant.
#[derive(Debug)]
pub enum Unfit {
    /// The capture lacks what is changed.
    Lacks(&'static str),
    /// A file could not be read or written.
    Failed(Error),
}

impl From<Error> for Unfit {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

/// Every change, in the order of the report.
pub const HARD_CAPTURES: [HardCapture; 22] = [
    same("scaled-down", "lengths times 1e-3", true, |d, _| move_world(d, 1e-3, DMat3::IDENTITY, 0.0)),
    same("scaled-up", "lengths times 1e3", false, |d, _| move_world(d, 1e3, DMat3::IDENTITY, 0.0)),
    same("moved", "moved by 1e4 scene sizes", true, |d, _| move_world(d, 1.0, DMat3::IDENTITY, 1e4)),
    // The planes of the deformation and their smoothness know the axes, so that the change is reported and not held to
    // 0.
    finite("axes-swapped", "x, y, z become y, z, x", false, |d, _| {
        move_world(d, 1.0, DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X), 0.0)
    }),
    finite("times-reversed", "time runs backwards", false, |d, _| retime(d, |t| 1.0 - t)),
    finite("times-uneven", "times squared", false, |d, _| retime(d, |t| t * t)),
    finite("background-box", "a fifth more points, in a box of 1000 extents", true, background_box),
    finite("one-frame", "one training frame", true, |d, _| keep_training(d, 1)),
    finite("two-frames", "the first and the last training frame", false, |d, _| keep_training(d, 2)),
    finite("two-cameras", "training frames of two cameras or places", false, two_cameras),
    finite("one-pixel-instance", "an instance of one pixel", true, |d, f| edit_masks(d, f, one_pixel)),
    finite("one-frame-instance", "an instance in one training mask only", false, one_frame_instance),
    finite("one-instance", "all pixels of all training masks one instance", true, |d, f| {
        let id = first_id(d)?;
        edit_masks(d, f, move |_, mask, _| mask.pixels.fill(id))
    }),
    finite("few-masks", "masks on 5 % of the training frames", false, few_masks),
    finite("duplicate-points", "every point twice", true, duplicate_points),
    finite("black-frame", "one training image black", false, |d, f| edit_image(d, f, |_| 0)),
    finite("over-exposed", "one training image over-exposed four times", false, |d, f| {
        edit_image(d, f, |v| (u32::from(v) * 4).min(255) as u8)
    }),
    finite("wrong-camera", "one training camera turned by a quarter", true, wrong_camera),
    finite("empty-masks", "no labelled pixel", false, |d, f| {
        edit_masks(d, f, |_, mask, _| mask.pixels.fill(0))
    }),
    finite("swapped-ids", "ids of two instances swapped in a tenth of the masks", false, |d, f| {
        edit_masks(d, f, |position, mask, labels| swap_ids(position, mask, labels))
    }),
    finite("shifted-masks", "masks two pixels off", false, |d, f| {
        edit_masks(d, f, |_, mask, _| shift(mask, 2))
    }),
    finite("lost-masks", "an instance lost in a third of the masks", false, |d, f| {
        edit_masks(d, f, |position, mask, labels| lose(position, mask, labels))
    }),
];

const fn same(
    name: &'static str,
    what: &'static str,
    quick: bool,
    make: fn(&mut Dataset, &Path) -> Result<(), Unfit>,
) -> HardCapture {
    HardCapture { name, what, demand: Demand::Same, quick, make }
}

const fn finite(
    name: &'static str,
    what: &'static str,
    quick: bool,
    make: fn(&mut Dataset, &Path) -> Result<(), Unfit>,
) -> HardCapture {
    HardCapture { name, what, demand: Demand::Finite, quick, make }
}

impl HardCapture {
    /// The changed capture; files that change are written into `folder`. Held-out frames keep their images and
    /// masks, so that scores compare.
    ///
    /// # Errors
    /// When the capture lacks what is changed, or a file cannot be read or written.
    pub fn of(&self, dataset: &Dataset, folder: &Path) -> Result<Dataset, Unfit> {
        let mut changed = dataset.clone();
        changed.warnings.clear();
        (self.make)(&mut changed, folder)?;
        // As it would be read from files.
        changed.enter_own_frame();
        Ok(changed)
    }
}

/// Scales and turns the world, then moves it by so many scene extents.
fn move_world(dataset: &mut Dataset, scale: f64, rotation: DMat3, extents: f64) -> Result<(), Unfit> {
    let offset = DVec3::new(0.8, -0.5, 0.33) * extents * dataset.extent() * scale;
    for frame in &mut dataset.frames {
        let pose = frame.camera.camera_from_world;
        let turned = pose.rotation * rotation.transpose();
        frame.camera.camera_from_world =
            RigidTransform { rotation: turned, translation: scale * pose.translation - turned * offset };
    }
    for position in &mut dataset.points.positions {
        let place = DVec3::from_array(position.map(f64::from));
        // Rounded where a capture would round it.
        *position = (scale * (rotation * place) + offset).as_vec3().to_array();
    }
    Ok(())
}

fn retime(dataset: &mut Dataset, time: impl Fn(f64) -> f64) -> Result<(), Unfit> {
    if dataset.times.len() < 2 {
        return Err(Unfit::Lacks("a second time"));
    }
    for frame in &mut dataset.frames {
        frame.time = time(frame.time);
    }
    dataset.times = dataset.frames.iter().map(|frame| frame.time).collect();
    dataset.times.sort_by(f64::total_cmp);
    dataset.times.dedup();
    for frame in &mut dataset.frames {
        frame.time_index = dataset.times.partition_point(|time| *time < frame.time);
    }
    Ok(())
}

fn background_box(dataset: &mut Dataset, _: &Path) -> Result<(), Unfit> {
    let side = 1000.0 * dataset.extent();
    let count = (dataset.points.positions.len() / 5).max(100);
    for k in 0..count {
        // The R3 sequence fills a cube evenly without a generator.
        let place =
            [0.819_172_513, 0.671_043_607, 0.549_700_478].map(|step: f64| (0.5 + step * k as f64).fract());
        dataset.points.positions.push(place.map(|u| ((u - 0.5) * side) as f32));
        dataset.points.colors.push([128; 3]);
    }
    Ok(())
}

/// Keeps `count` training frames, evenly spread, and everything that is held out.
fn keep_training(dataset: &mut Dataset, count: usize) -> Result<(), Unfit> {
    let train = dataset.train_frames();
    if train.len() <= count {
        return Err(Unfit::Lacks("more training frames"));
    }
    let kept: Vec<usize> = match count {
        1 => vec![train[train.len() / 2]],
        _ => (0..count).map(|k| train[k * (train.len() - 1) / (count - 1)]).collect(),
    };
    let mut index = 0;
    dataset.frames.retain(|frame| {
        index += 1;
        frame.split == Split::Val || kept.contains(&(index - 1))
    });
    Ok(())
}

fn two_cameras(dataset: &mut Dataset, _: &Path) -> Result<(), Unfit> {
    let train = dataset.train_frames();
    let mut names: Vec<String> =
        train.iter().map(|index| dataset.frames[*index].camera_name.clone()).collect();
    names.sort();
    names.dedup();
    if names.len() > 2 {
        let kept = [names[0].clone(), names[names.len() / 2].clone()];
        dataset.frames.retain(|frame| frame.split == Split::Val || kept.contains(&frame.camera_name));
        return Ok(());
    }
    if names.len() == 2 {
        return Err(Unfit::Lacks("a third camera"));
    }
    // One moving camera: the four frames around two of its places.
    if train.len() < 8 {
        return Err(Unfit::Lacks("more training frames"));
    }
    let (a, b) = (train.len() / 4, 3 * train.len() / 4);
    let kept = [train[a], train[a + 1], train[b], train[b + 1]];
    let mut index = 0;
    dataset.frames.retain(|frame| {
        index += 1;
        frame.split == Split::Val || kept.contains(&(index - 1))
    });
    Ok(())
}

fn duplicate_points(dataset: &mut Dataset, _: &Path) -> Result<(), Unfit> {
    dataset.points.positions.extend_from_within(..);
    dataset.points.colors.extend_from_within(..);
    Ok(())
}

fn wrong_camera(dataset: &mut Dataset, _: &Path) -> Result<(), Unfit> {
    let train = dataset.train_frames();
    let pose = &mut dataset.frames[train[train.len() / 2]].camera.camera_from_world;
    let centre = pose.inverse().translation;
    pose.rotation = DMat3::from_rotation_y(std::f64::consts::FRAC_PI_2) * pose.rotation;
    pose.translation = -(pose.rotation * centre);
    Ok(())
}

fn few_masks(dataset: &mut Dataset, _: &Path) -> Result<(), Unfit> {
    first_id(dataset)?;
    let masked: Vec<usize> =
        dataset.train_frames().into_iter().filter(|index| dataset.frames[*index].mask.is_some()).collect();
    let kept = masked.len().div_ceil(20);
    for (position, index) in masked.iter().enumerate() {
        if position % (masked.len() / kept).max(1) != 0 {
            dataset.frames[*index].mask = None;
        }
    }
    Ok(())
}

fn one_frame_instance(dataset: &mut Dataset, folder: &Path) -> Result<(), Unfit> {
    first_id(dataset)?;
    let id = dataset.instances[dataset.instances.len() - 1].id;
    // In the mask where it is largest.
    let mut largest = (0, usize::MAX);
    for (position, index) in masked_training(dataset).into_iter().enumerate() {
        let mask = dataset.load_mask(index).map_err(Error::plain)?;
        let pixels = mask.map_or(0, |mask| mask.pixels.iter().filter(|pixel| **pixel == id).count());
        if pixels > largest.0 {
            largest = (pixels, position);
        }
    }
    edit_masks(dataset, folder, move |position, mask, _| {
        if position != largest.1 {
            replace(mask, id, 0);
        }
    })
}

fn one_pixel(_: usize, mask: &mut PixelGrid<u16>, labels: &mut Vec<InstanceLabel>) {
    const LABEL: &str = "one pixel";
    let id = match labels.iter().find(|label| label.label == LABEL) {
        Some(label) => label.id,
        None => {
            let free = (1..=u16::MAX).find(|id| labels.iter().all(|label| label.id != *id)).unwrap_or(1);
            labels.push(InstanceLabel {
                id: free,
                label: LABEL.into(),
                category: LABEL.into(),
                taxonomies: Default::default(),
            });
            labels.sort_by_key(|label| label.id);
            free
        }
    };
    let middle = mask.pixels.len() / 2;
    mask.pixels[middle] = id;
}

fn swap_ids(position: usize, mask: &mut PixelGrid<u16>, labels: &[InstanceLabel]) {
    if let ([a, b, ..], 0) = (labels, position % 10) {
        let (a, b) = (a.id, b.id);
        for pixel in &mut mask.pixels {
            *pixel = match *pixel {
                id if id == a => b,
                id if id == b => a,
                id => id,
            };
        }
    }
}

fn lose(position: usize, mask: &mut PixelGrid<u16>, labels: &[InstanceLabel]) {
    if position.is_multiple_of(3)
        && let Some(label) = labels.get(position / 3 % labels.len().max(1))
    {
        replace(mask, label.id, 0);
    }
}

fn shift(mask: &mut PixelGrid<u16>, by: u32) {
    let old = mask.clone();
    for y in 0..old.height {
        for x in 0..old.width {
            let moved = *old.at(x.saturating_sub(by), y.saturating_sub(by));
            mask.pixels[(y * old.width + x) as usize] = moved;
        }
    }
}

fn replace(mask: &mut PixelGrid<u16>, id: u16, by: u16) {
    for pixel in mask.pixels.iter_mut().filter(|pixel| **pixel == id) {
        *pixel = by;
    }
}

fn first_id(dataset: &Dataset) -> Result<u16, Unfit> {
    dataset.instances.first().map(|label| label.id).ok_or(Unfit::Lacks("masks"))
}

fn masked_training(dataset: &Dataset) -> Vec<usize> {
    dataset.train_frames().into_iter().filter(|index| dataset.frames[*index].mask.is_some()).collect()
}

/// Rewrites every training mask; `edit` gets its position among them.
fn edit_masks(
    dataset: &mut Dataset,
    folder: &Path,
    edit: impl Fn(usize, &mut PixelGrid<u16>, &mut Vec<InstanceLabel>),
) -> Result<(), Unfit> {
    first_id(dataset)?;
    let mut labels = dataset.instances.clone();
    for (position, index) in masked_training(dataset).into_iter().enumerate() {
        remove_lens(dataset, index, folder)?;
        let Some(mut mask) = dataset.load_mask(index).map_err(Error::plain)? else { continue };
        edit(position, &mut mask, &mut labels);
        dataset.frames[index].mask = Some(write_mask(mask, &folder.join(format!("mask_{index}.png")))?);
    }
    dataset.instances = labels;
    Ok(())
}

/// Changes the middle training image.
fn edit_image(dataset: &mut Dataset, folder: &Path, edit: impl Fn(u8) -> u8) -> Result<(), Unfit> {
    let train = dataset.train_frames();
    let index = train[train.len() / 2];
    remove_lens(dataset, index, folder)?;
    let mut image = dataset.load_image(index, [1.0; 3]).map_err(Error::plain)?;
    for channel in image.pixels.as_flattened_mut() {
        *channel = edit(*channel);
    }
    dataset.frames[index].image = write_image(&image, &folder.join("edited.png"))?;
    Ok(())
}

/// Puts files without lens in the place of those with one, so that what is rewritten stays as it is loaded.
fn remove_lens(dataset: &mut Dataset, index: usize, folder: &Path) -> Result<(), Unfit> {
    if dataset.frames[index].lens.is_identity() {
        return Ok(());
    }
    let data = dataset.load_frame(index, [1.0; 3]).map_err(Error::plain)?;
    let frame = &mut dataset.frames[index];
    frame.image = write_image(&data.image, &folder.join(format!("image_{index}.png")))?;
    if let Some(mask) = data.mask {
        frame.mask = Some(write_mask(mask, &folder.join(format!("mask_{index}.png")))?);
    }
    frame.lens = LensDistortion::default();
    Ok(())
}

fn write_mask(mask: PixelGrid<u16>, path: &Path) -> Result<PathBuf, Unfit> {
    let buffer = ImageBuffer::<Luma<u16>, _>::from_raw(mask.width, mask.height, mask.pixels)
        .expect("a mask has a pixel for every place");
    save(path, |path| buffer.save(path))?;
    Ok(path.to_owned())
}

fn write_image(image: &PixelGrid<[u8; 3]>, path: &Path) -> Result<PathBuf, Unfit> {
    let bytes = image.pixels.as_flattened().to_vec();
    let buffer = ImageBuffer::<Rgb<u8>, _>::from_raw(image.width, image.height, bytes)
        .expect("an image has a pixel for every place");
    save(path, |path| buffer.save(path))?;
    Ok(path.to_owned())
}

fn save(path: &Path, write: impl FnOnce(&Path) -> image::ImageResult<()>) -> Result<(), Unfit> {
    write(path)
        .map_err(|error| Unfit::Failed(Error::plain(format!("cannot write {}: {error}", path.display()))))
}
