//! Summary of a capture, for `cif info`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use cif_geometry::Bounds;
use serde::Serialize;

use crate::{Dataset, Error, Layout, PointSource, Split, mask_files};

/// A capture in numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaptureSummary {
    /// Folder of the capture.
    pub root: PathBuf,
    /// Recognised layout.
    pub layout: Layout,
    /// Cameras, by name.
    pub cameras: Vec<CameraSummary>,
    /// All frames.
    pub frames: usize,
    /// Frames to train on.
    pub train: usize,
    /// Held-out frames.
    pub val: usize,
    /// Named groups of held-out frames.
    pub groups: BTreeMap<String, usize>,
    /// Distinct times.
    pub times: usize,
    /// First and last normalised time.
    pub time_range: [f64; 2],
    /// Frames per second, where the capture says so.
    pub frames_per_second: Option<f64>,
    /// Sizes at which frames are loaded (width, height), with the number of frames.
    pub resolutions: Vec<(u32, u32, usize)>,
    /// Smallest and largest focal length, pixels.
    pub focal_px: [f64; 2],
    /// Smallest and largest horizontal field of view, degrees.
    pub field_of_view_degrees: [f64; 2],
    /// Frames whose lens is removed on loading.
    pub frames_with_lens: usize,
    /// True when images carry alpha.
    pub has_alpha: bool,
    /// Masks, where there are any.
    pub masks: Option<MaskSummary>,
    /// Instances, ascending id.
    pub instances: Vec<InstanceSummary>,
    /// Initial points.
    pub points: usize,
    /// Where the points come from.
    pub point_source: PointSource,
    /// Box of the points, metres; `None` without points.
    pub point_bounds: Option<Bounds>,
    /// Box of the camera centres, metres.
    pub camera_bounds: Bounds,
    /// Scene extent, metres; see [`Dataset::extent`].
    pub extent: f64,
    /// Oddities, one sentence each.
    pub warnings: Vec<String>,
    /// Findings and decisions of reading, one sentence each.
    pub notes: Vec<String>,
}

/// One camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraSummary {
    /// Name.
    pub name: String,
    /// Frames to train on.
    pub train: usize,
    /// Held-out frames.
    pub val: usize,
    /// True when its pose changes.
    pub moves: bool,
}

/// Masks of a capture.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MaskSummary {
    /// Frames that have a mask.
    pub frames: usize,
    /// Training frames among them.
    pub train: usize,
    /// Share of labelled pixels in those masks.
    pub labelled: f64,
}

/// One instance in the masks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct InstanceSummary {
    /// Value in the masks.
    pub id: u16,
    /// Name.
    pub label: String,
    /// Class.
    pub category: String,
    /// Names of its class in vocabularies of others, by taxonomy.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub taxonomies: BTreeMap<String, String>,
    /// Masks that show it.
    pub frames: usize,
    /// Masks of training frames that show it.
    pub train_frames: usize,
    /// Pixels over all masks as stored.
    pub pixels: u64,
}

impl Dataset {
    /// Everything that `cif info` prints; decodes every mask.
    ///
    /// # Errors
    /// When a mask cannot be decoded.
    pub fn summary(&self) -> Result<CaptureSummary, Error> {
        let mut cameras: BTreeMap<&str, CameraSummary> = BTreeMap::new();
        let mut poses = BTreeMap::new();
        let mut groups = BTreeMap::new();
        let mut resolutions: BTreeMap<(u32, u32), usize> = BTreeMap::new();
        let mut focal_px = [f64::INFINITY, 0.0];
        let mut field_of_view_degrees = [f64::INFINITY, 0.0];
        for frame in &self.frames {
            let camera = cameras.entry(&frame.camera_name).or_insert_with(|| CameraSummary {
                name: frame.camera_name.clone(),
                train: 0,
                val: 0,
                moves: false,
            });
            match frame.split {
                Split::Train => camera.train += 1,
                Split::Val => camera.val += 1,
            }
            let pose = frame.camera.camera_from_world;
            camera.moves |= *poses.entry(&frame.camera_name).or_insert(pose) != pose;
            if let Some(group) = &frame.group {
                *groups.entry(group.clone()).or_default() += 1;
            }
            *resolutions.entry((frame.camera.width, frame.camera.height)).or_default() += 1;
            let widen =
                |range: &mut [f64; 2], value: f64| *range = [range[0].min(value), range[1].max(value)];
            widen(&mut focal_px, frame.camera.focal_px.x);
            widen(&mut focal_px, frame.camera.focal_px.y);
            let half = f64::from(frame.camera.width) / (2.0 * frame.camera.focal_px.x);
            widen(&mut field_of_view_degrees, 2.0 * half.atan().to_degrees());
        }
        let (masks, instances) = self.mask_summary()?;
        let bounds = self.point_bounds();
        Ok(CaptureSummary {
            root: self.root.clone(),
            layout: self.layout,
            cameras: cameras.into_values().collect(),
            frames: self.frames.len(),
            train: self.train_frames().len(),
            val: self.val_frames().len(),
            groups,
            times: self.times.len(),
            time_range: [
                self.times.first().copied().unwrap_or(0.0),
                self.times.last().copied().unwrap_or(0.0),
            ],
            frames_per_second: self.frames_per_second,
            resolutions: resolutions
                .into_iter()
                .map(|((width, height), frames)| (width, height, frames))
                .collect(),
            focal_px,
            field_of_view_degrees,
            frames_with_lens: self.frames.iter().filter(|frame| !frame.lens.is_identity()).count(),
            has_alpha: self.has_alpha,
            masks,
            instances,
            points: self.points.positions.len(),
            point_source: self.points.source.clone(),
            point_bounds: (!bounds.is_empty()).then_some(bounds),
            camera_bounds: Bounds::around(self.frames.iter().map(|frame| frame.camera.centre())),
            extent: self.extent(),
            warnings: self.warnings.clone(),
            notes: self.notes.clone(),
        })
    }

    fn mask_summary(&self) -> Result<(Option<MaskSummary>, Vec<InstanceSummary>), Error> {
        let counts = mask_files::count_pixels(&self.frames, &self.mask_objects)?;
        let mut instances: Vec<InstanceSummary> = self
            .instances
            .iter()
            .map(|instance| InstanceSummary {
                id: instance.id,
                label: instance.label.clone(),
                category: instance.category.clone(),
                taxonomies: instance.taxonomies.clone(),
                frames: 0,
                train_frames: 0,
                pixels: 0,
            })
            .collect();
        let mut masks = MaskSummary { frames: 0, train: 0, labelled: 0.0 };
        let (mut labelled, mut total) = (0_u64, 0_u64);
        for (frame, counts) in self.frames.iter().zip(&counts) {
            let Some((counts, pixels)) = counts else { continue };
            let train = usize::from(frame.split == Split::Train);
            masks.frames += 1;
            masks.train += train;
            total += pixels;
            labelled += counts.values().sum::<u64>();
            for instance in &mut instances {
                if let Some(pixels) = counts.get(&instance.id) {
                    instance.frames += 1;
                    instance.train_frames += train;
                    instance.pixels += pixels;
                }
            }
        }
        masks.labelled = labelled as f64 / total.max(1) as f64;
        Ok(((masks.frames > 0).then_some(masks), instances))
    }
}

impl CaptureSummary {
    /// Lines for a terminal, oddities last.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![
            format!("capture     {} ({})", self.root.display(), self.layout),
            format!(
                "frames      {} ({} train, {} val{})",
                self.frames,
                self.train,
                self.val,
                self.group_text()
            ),
            format!("cameras     {}", self.camera_text()),
            format!("times       {}", self.time_text()),
        ];
        let sizes: Vec<String> = self
            .resolutions
            .iter()
            .map(|(width, height, frames)| {
                if self.resolutions.len() == 1 {
                    format!("{width} x {height}")
                } else {
                    format!("{width} x {height} ({frames})")
                }
            })
            .collect();
        lines.push(format!(
            "images      {}{}{}",
            sizes.join(", "),
            if self.has_alpha { ", alpha" } else { "" },
            if self.frames_with_lens > 0 {
                format!(", lens removed from {}", self.frames_with_lens)
            } else {
                String::new()
            }
        ));
        lines.push(format!(
            "focal       {} px, field of view {} degrees",
            range(self.focal_px),
            range(self.field_of_view_degrees)
        ));
        lines.push(match &self.masks {
            Some(masks) => format!(
                "masks       {} of {} frames ({} train), {:.1} % of the pixels labelled",
                masks.frames,
                self.frames,
                masks.train,
                100.0 * masks.labelled
            ),
            None => "masks       none".to_owned(),
        });
        lines.push(match &self.point_source {
            PointSource::File(path) => format!("points      {} from {}", self.points, path.display()),
            PointSource::Triangulated => format!("points      {} from its images", self.points),
            PointSource::Random => format!("points      {} at random", self.points),
        });
        if let Some(bounds) = &self.point_bounds {
            lines.push(format!("            {}", box_text(bounds)));
        }
        lines.push(format!("camera box  {}", box_text(&self.camera_bounds)));
        lines.push(format!("extent      {:.3} m", self.extent));
        if !self.instances.is_empty() {
            lines.push(format!("instances   {}", self.instances.len()));
            let width = self
                .instances
                .iter()
                .map(|instance| instance.label.chars().count())
                .max()
                .unwrap_or(0)
                .max(5);
            lines.push(format!("    id  {:width$}  frames      pixels  category", "label"));
            for instance in &self.instances {
                lines.push(format!(
                    "{:>6}  {:width$}  {:>6}  {:>10}  {}",
                    instance.id, instance.label, instance.frames, instance.pixels, instance.category
                ));
            }
        }
        lines.extend(self.notes.iter().map(|note| format!("note: {note}")));
        lines.extend(self.warnings.iter().map(|warning| format!("warning: {warning}")));
        lines
    }

    fn group_text(&self) -> String {
        if self.groups.is_empty() {
            return String::new();
        }
        let groups: Vec<String> = self.groups.iter().map(|(name, count)| format!("{count} {name}")).collect();
        format!(": {}", groups.join(", "))
    }

    fn camera_text(&self) -> String {
        let moving = self.cameras.iter().filter(|camera| camera.moves).count();
        let kinds: Vec<String> = [(moving, "moving"), (self.cameras.len() - moving, "fixed")]
            .iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, kind)| format!("{count} {kind}"))
            .collect();
        let shown: Vec<String> = self
            .cameras
            .iter()
            .take(8)
            .map(|camera| match (camera.train, camera.val) {
                (train, 0) => format!("{} {train} train", camera.name),
                (0, val) => format!("{} {val} val", camera.name),
                (train, val) => format!("{} {train} train {val} val", camera.name),
            })
            .collect();
        let more = self.cameras.len().saturating_sub(shown.len());
        let more = if more > 0 { format!(", {more} more") } else { String::new() };
        format!("{}: {}{more}", kinds.join(", "), shown.join(", "))
    }

    fn time_text(&self) -> String {
        if self.times <= 1 {
            return "1 (static)".to_owned();
        }
        let rate =
            self.frames_per_second.map(|rate| format!(", {rate} frames per second")).unwrap_or_default();
        format!("{} from {:.4} to {:.4}{rate}", self.times, self.time_range[0], self.time_range[1])
    }
}

impl fmt::Display for CaptureSummary {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for line in self.lines() {
            writeln!(formatter, "{line}")?;
        }
        Ok(())
    }
}

fn range([low, high]: [f64; 2]) -> String {
    if high - low < 0.05 { format!("{low:.1}") } else { format!("{low:.1} to {high:.1}") }
}

fn box_text(bounds: &Bounds) -> String {
    let (low, high) = (bounds.low, bounds.high);
    format!("({:.3}, {:.3}, {:.3}) to ({:.3}, {:.3}, {:.3}) m", low.x, low.y, low.z, high.x, high.y, high.z)
}
