//! An object as one frame shows it: a crop around its mask, at several resolutions.

use std::collections::{BTreeSet, HashSet};
use std::f64::consts::PI;
use std::sync::Arc;

use cif_geometry::{PinholeCamera, PixelGrid, Ray, rays, stats};
use cif_render::{RenderSettings, UNLABELLED};
use glam::{DVec2, DVec3};

use crate::frames::TrainFrame;
use crate::mask_table::{MaskRow, MaskTable};

/// Pixels around the mask that belong to its crop.
const MARGIN: u32 = 5;

/// Masks of fewer pixels say nothing.
const FEWEST_PIXELS: u32 = 12;

/// Pixels of the mask of an object, in the median of its views, up to which these are looked at as they are: of larger
/// ones pixels are joined, since one across is less than 2 % of the object then and fits take as long as they have pixels.
const MOST_PIXELS: f64 = 3000.0;

/// Share of a reduced pixel that the mask must have for its colour to count.
const COLOR_SHARE: f32 = 0.3;

/// Share of the pixels of a mask that lie within its radius of its middle.
pub(super) const WITHIN: f64 = 0.98;

/// Share of the outline of a mask that touches others up to which nothing hides it, and visible share of a hidden one up
/// to which its place in the image is that of what hides it.
const WHOLE_TOUCHED: f64 = 0.1;
const SLIVER: f64 = 0.1;

/// Pixels of a mask that change, of its area, and mean change of its colours, in [0, 1], up to which nothing moved: of
/// what is at rest in rendered captures colours change by up to 0.045, of what moves by 0.06 and more.
const SAME: (f64, f64) = (0.02, 0.05);

/// Share of a whole mask in the disc around its middle from which it is that of a ball.
const DISC: f64 = 0.9;

/// The label of an object among those of all masks.
#[derive(Clone)]
pub(super) struct ObjectLabel {
    /// Dense index + 1.
    pub(super) label: u16,
    /// By label, true for those that cannot hide the object.
    pub(super) behind: Arc<[bool]>,
}

impl ObjectLabel {
    /// True for a label that cannot hide the object: what nobody labelled, or what lies behind it.
    pub(super) fn is_before(&self, other: u16) -> bool {
        other == UNLABELLED || self.behind[usize::from(other)]
    }
}

/// The crop at a resolution.
pub(super) struct Crop {
    pub(super) camera: PinholeCamera,
    /// Mean colour of the mask's share of each pixel, in [0, 1].
    pub(super) colors: Vec<[f32; 3]>,
    /// Share of each pixel that the mask has.
    pub(super) mask: Vec<f32>,
    /// Weight of the coverage of each pixel: 0 where other objects are, which may hide this one.
    pub(super) known: Vec<f32>,
    /// Pixels of the mask, at least 4.
    pub(super) pixels: f32,
    /// Dilation with which Gaussians look as they do in the whole image, its pixels joined: that of whole pixels would
    /// make small images of an object too large, and it would be put too far away.
    pub(super) low_pass: f32,
}

/// The object in a frame.
pub(super) struct ObjectView {
    pub(super) time_index: usize,
    /// Number that distinguishes cameras that stay in place.
    pub(super) camera_key: [i64; 3],
    pub(super) camera: PinholeCamera,
    /// Pixels of the mask: columns and rows.
    pub(super) pixels: Vec<[u32; 2]>,
    /// Size of the image.
    pub(super) size: [u32; 2],
    pub(super) centroid: DVec2,
    /// True when the mask touches the border of the image.
    pub(super) cut: bool,
    /// Share of the outline that touches masks which may hide it.
    pub(super) touched: f64,
    /// Visible share: area over the median area of the nearest whole masks, at most 1.
    pub(super) visible: f64,
    /// By reduction: 1, 2, 4 of the finest.
    pub(super) crops: [Crop; 3],
    /// Pixels of the image across one of the finest crop.
    joined: u32,
    label: ObjectLabel,
    frame: Arc<TrainFrame>,
}

/// Finding at a pixel of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Seen {
    /// The object, in this colour.
    Object([f32; 3]),
    /// Another object, which may hide this one.
    Other,
    /// Nothing that is labelled, or something behind it.
    Nothing,
    /// Beyond the image, or behind the camera.
    Outside,
}

impl ObjectView {
    /// The view of an object in a frame with its masks, so many of its pixels joined to one of the finest crop across;
    /// `None` where the masks show too little of it.
    pub(super) fn new(
        object: &ObjectLabel,
        time_index: usize,
        camera: &PinholeCamera,
        frame: &Arc<TrainFrame>,
        joined: u32,
        table: &MaskTable,
    ) -> Option<Self> {
        let labels = frame.labels.as_ref()?;
        let label = object.label;
        let row = table.rows.get(&label).filter(|row| row.pixels >= FEWEST_PIXELS)?;
        let MaskRow { low, high, .. } = row;
        let in_box = (low[1]..=high[1]).flat_map(|y| (low[0]..=high[0]).map(move |x| [x, y]));
        let pixels: Vec<[u32; 2]> = in_box.filter(|[x, y]| *labels.at(*x, *y) == label).collect();
        let ring: u32 = row.touches.values().sum();
        let hiding = row.touches.iter().filter(|(other, _)| !object.is_before(**other));
        let touching: u32 = hiding.map(|(_, sides)| sides).sum();
        let centre = camera.centre();
        Some(Self {
            time_index,
            camera_key: (centre * 1e4).round().to_array().map(|value| value as i64),
            camera: *camera,
            size: [labels.width, labels.height],
            centroid: row.centroid(),
            cut: row.is_cut(),
            touched: f64::from(touching) / f64::from(ring.max(1)),
            visible: 1.0,
            crops: [1, 2, 4].map(|more| crop(joined * more, object, camera, row, labels, &frame.image)),
            joined,
            pixels,
            label: object.clone(),
            frame: Arc::clone(frame),
        })
    }

    /// Pixels of the mask in the image.
    pub(super) fn area(&self) -> f64 {
        self.pixels.len() as f64
    }

    /// Pixels of the mask in the finest crop.
    pub(super) fn detail(&self) -> f64 {
        self.area() / f64::from(self.joined * self.joined)
    }

    /// Distance from the middle of the mask, pixels, within which this share of it lies.
    pub(super) fn reach(&self, share: f64) -> f64 {
        let from = |[x, y]: &[u32; 2]| {
            (DVec2::new(f64::from(*x) + 0.5, f64::from(*y) + 0.5) - self.centroid).length()
        };
        let mut distances: Vec<f64> = self.pixels.iter().map(from).collect();
        distances.sort_by(f64::total_cmp);
        distances[((distances.len() - 1) as f64 * share) as usize]
    }

    /// Unit direction in the image from the middle of a mask to where the border cuts it; `None` where it does not.
    pub(super) fn outward(&self) -> Option<DVec2> {
        let [width, height] = self.size;
        let at_border = |[x, y]: &&[u32; 2]| *x == 0 || *y == 0 || *x + 1 == width || *y + 1 == height;
        let places = self.pixels.iter().filter(at_border);
        let apart = places.map(|[x, y]| DVec2::new(f64::from(*x) + 0.5, f64::from(*y) + 0.5) - self.centroid);
        apart.sum::<DVec2>().try_normalize()
    }

    /// The ray through the middle of the mask.
    pub(super) fn ray(&self) -> Ray {
        Ray::through(&self.camera, self.centroid)
    }

    /// True where the outline is the object's own.
    pub(super) fn is_whole(&self) -> bool {
        !self.cut && self.touched < WHOLE_TOUCHED
    }

    /// True where the mask may move a pose.
    pub(super) fn is_reliable(&self) -> bool {
        !self.cut && self.visible > 0.5
    }

    /// True where the mask shows where the object is: enough of it is seen, or the border alone hides the rest.
    pub(super) fn shows_place(&self) -> bool {
        !self.is_sliver() || (self.cut && self.touched < WHOLE_TOUCHED)
    }

    /// True of a mask that shows too little of what others hide, or the border cuts, to show how the object is turned.
    pub(super) fn is_sliver(&self) -> bool {
        self.visible < SLIVER
    }

    /// True where a camera that stays in place sees the same as at another time.
    fn looks_as(&self, other: &Self) -> bool {
        if self.camera_key != other.camera_key {
            return false;
        }
        let others: HashSet<[u32; 2]> = other.pixels.iter().copied().collect();
        let both: Vec<[u32; 2]> =
            self.pixels.iter().copied().filter(|pixel| others.contains(pixel)).collect();
        let apart = (self.pixels.len() - both.len()) + (others.len() - both.len());
        let change = |[x, y]: &[u32; 2]| {
            let (a, b) = (self.frame.image.at(*x, *y), other.frame.image.at(*x, *y));
            (0..3).map(|k| f64::from(a[k].abs_diff(b[k]))).sum::<f64>() / (3.0 * 255.0)
        };
        let changes: f64 = both.iter().map(change).sum();
        apart as f64 <= SAME.0 * self.area() && changes <= SAME.1 * both.len() as f64
    }

    /// Finding where a point of the world is seen.
    pub(super) fn at(&self, point: DVec3) -> Seen {
        let Some([x, y]) = self.camera.pixel_of(point) else { return Seen::Outside };
        match self.frame.labels.as_ref().map_or(UNLABELLED, |labels| *labels.at(x, y)) {
            label if label == self.label.label => {
                Seen::Object(self.frame.image.at(x, y).map(|c| f32::from(c) / 255.0))
            }
            other if self.label.is_before(other) => Seen::Nothing,
            _ => Seen::Other,
        }
    }
}

/// Pixels of images across one of the finest crops of an object, by the pixels of its masks.
pub(super) fn joined(mut areas: Vec<f64>) -> u32 {
    let area = median(&mut areas);
    let wide_enough = |joined: &u32| area <= MOST_PIXELS * f64::from(joined * joined);
    (0..u32::BITS / 2).map(|k| 1 << k).find(wide_enough).unwrap_or(1)
}

/// Sets the visible shares of views, which are in the order of times: each camera that stays in place is compared
/// with itself, for others are at other distances.
pub(super) fn set_visible(views: &mut [ObjectView]) {
    let known: Vec<(bool, [i64; 3], usize, f64)> =
        views.iter().map(|v| (v.is_whole(), v.camera_key, v.time_index, v.area())).collect();
    let has_whole = known.iter().any(|(whole, ..)| *whole);
    for view in views {
        let of_camera = |whole: bool| {
            let own = known.iter().filter(|(w, camera, ..)| (*w || !whole) && *camera == view.camera_key);
            own.copied().collect::<Vec<_>>()
        };
        let stays = of_camera(false).len() > 2;
        let mut nearest = match of_camera(true) {
            own if stays && own.len() > 2 => own,
            _ if stays => of_camera(false),
            _ => known.iter().filter(|(whole, ..)| *whole || !has_whole).copied().collect(),
        };
        nearest.sort_by_key(|(_, _, time, _)| time.abs_diff(view.time_index));
        let mut near: Vec<f64> = nearest.into_iter().take(5).map(|(.., area)| area).collect();
        view.visible = (view.area() / median(&mut near)).min(1.0);
    }
}

/// True where all cameras see the same at two times.
pub(super) fn look_alike(views: &[ObjectView], a: usize, b: usize) -> bool {
    let at = |time: usize| views.iter().filter(move |view| view.time_index == time);
    at(a).count() == at(b).count() && at(a).all(|view| at(b).any(|other| view.looks_as(other)))
}

/// True where all cameras see the same at a time as at that before or after it at which any sees it.
pub(super) fn is_at_rest(views: &[ObjectView], time: usize) -> bool {
    let before = views.iter().map(|view| view.time_index).filter(|other| *other < time).max();
    let after = views.iter().map(|view| view.time_index).filter(|other| *other > time).min();
    [before, after].into_iter().flatten().any(|other| look_alike(views, time, other))
}

/// The point where rays through the middles of masks meet, by weights; `None` where they are parallel. Masks that show more
/// than the object, or another, count less where several others agree.
pub(super) fn meeting_point<'a>(views: impl Iterator<Item = (&'a ObjectView, f64)>) -> Option<DVec3> {
    rays::meeting_point(&views.map(|(view, weight)| (view.ray(), weight)).collect::<Vec<_>>())
}

/// True with one view at most of every time.
pub(super) fn is_one_camera<'a>(views: impl IntoIterator<Item = &'a ObjectView>) -> bool {
    let mut seen = BTreeSet::new();
    views.into_iter().all(|view| seen.insert(view.time_index))
}

/// True where whole masks are discs, as those of balls.
pub(super) fn are_discs<'a>(views: impl Iterator<Item = &'a ObjectView>) -> bool {
    let share = |view: &ObjectView| view.area() / (PI * view.reach(WITHIN).powi(2));
    median(&mut views.filter(|view| view.is_whole()).map(share).collect::<Vec<_>>()) > DISC
}

/// Middle value; 0 of nothing.
pub(super) fn median(values: &mut [f64]) -> f64 {
    stats::median(values).unwrap_or(0.0)
}

/// The crop around the mask of an object, reduced by a factor.
fn crop(
    factor: u32,
    object: &ObjectLabel,
    camera: &PinholeCamera,
    mask_row: &MaskRow,
    labels: &PixelGrid<u16>,
    colors: &PixelGrid<[u8; 3]>,
) -> Crop {
    let margin = MARGIN.max(2 * factor);
    let sizes = [labels.width, labels.height];
    let MaskRow { low, high, .. } = mask_row;
    let first = [0, 1].map(|axis| low[axis].saturating_sub(margin) / factor * factor);
    let size = [0, 1].map(|axis| {
        let end = ((high[axis] + 1 + margin).div_ceil(factor) * factor).min(sizes[axis]);
        ((end - first[axis]) / factor).max(1)
    });
    let (mut means, mut mask, mut known) = (Vec::new(), Vec::new(), Vec::new());
    let mut covered = 0.0;
    for row in 0..size[1] {
        for column in 0..size[0] {
            let (mut sum, mut own, mut other) = ([0.0_f32; 3], 0.0_f32, 0.0_f32);
            for y in first[1] + row * factor..(first[1] + (row + 1) * factor).min(sizes[1]) {
                for x in first[0] + column * factor..(first[0] + (column + 1) * factor).min(sizes[0]) {
                    let found = *labels.at(x, y);
                    if found == object.label {
                        own += 1.0;
                        let color = colors.at(x, y);
                        (0..3).for_each(|k| sum[k] += f32::from(color[k]) / 255.0);
                    } else if !object.is_before(found) {
                        other += 1.0;
                    }
                }
            }
            let all = (factor * factor) as f32;
            let (share, hidden) = (own / all, other / all);
            let weight = if hidden < 0.5 { 1.0 - hidden } else { 0.0 };
            means.push(sum.map(|sum| sum / own.max(1e-6)));
            covered += if weight > 0.0 { share } else { 0.0 };
            mask.push(share);
            known.push(weight);
        }
    }
    let scale = f64::from(factor);
    let offset = DVec2::new(f64::from(first[0]), f64::from(first[1]));
    Crop {
        camera: PinholeCamera {
            width: size[0],
            height: size[1],
            focal_px: camera.focal_px / scale,
            principal_px: (camera.principal_px - offset) / scale,
            camera_from_world: camera.camera_from_world,
        },
        colors: means,
        mask,
        known,
        pixels: covered.max(4.0),
        low_pass: RenderSettings::default().low_pass / (factor * factor) as f32,
    }
}

impl Crop {
    /// Weight of the colour of a pixel.
    pub(super) fn color_weight(&self, pixel: usize) -> f32 {
        let share = self.mask[pixel];
        if share > COLOR_SHARE { share } else { 0.0 }
    }
}
