//! Opens a capture: recognise the layout, read it, check it, find masks, labels and points.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use cif_geometry::PinholeCamera;
use rayon::prelude::*;

use crate::files::points::RawPoints;
use crate::files::{image, json, listing};
use crate::formats::{self, Draft, Source, some_of};
use crate::mask_files::{MaskFolder, MaskListing};
use crate::orientation::Orientation;
use crate::sizes::{centred, reduced_size};
use crate::{
    CaptureFrame, Dataset, Error, Frame, Layout, OpenOptions, PointCloud, PointSource, Split, Turn,
    camera_check, cryptomatte, instances, mask_files, placement, points, recognition,
};

impl OpenOptions {
    /// The layout that a folder is read as, without reading it.
    ///
    /// # Errors
    /// When the folder is missing, nothing fits, two layouts fit, or the one of the options does not.
    pub fn layout_of(&self, root: impl AsRef<Path>) -> Result<Layout, Error> {
        recognition::recognise(root.as_ref(), self.layout, &mut Vec::new())
    }
}

impl Dataset {
    /// Opens a capture of any layout (see [`crate::Layout`]).
    ///
    /// Image headers are read, and every mask is decoded once, to know the instances; images are decoded by
    /// [`Dataset::load_frame`].
    ///
    /// # Errors
    /// When the folder is no capture, or something in it is missing or wrong; the message names file and fix.
    pub fn open(root: impl AsRef<Path>, options: &OpenOptions) -> Result<Self, Error> {
        let root = root.as_ref();
        let (mut warnings, mut notes) = (Vec::new(), Vec::new());
        if options.downscale == Some(0) {
            return Err(Error::invalid(root, "images cannot be reduced by 0; give 1, 2, 4, ..."));
        }
        let layout = recognition::recognise(root, options.layout, &mut notes)?;
        let mut draft = formats::read(layout, &Source { root, options })?;
        draft.leave_out(root, &options.without_cameras)?;
        warnings.extend(draft.warnings.iter().cloned());
        warnings.extend(draft.unknown.clone());
        notes.append(&mut draft.notes);
        let (frames, has_alpha, stored_sizes) = frames(root, &draft, options, &mut warnings)?;

        let mut times: Vec<f64> = frames.iter().map(|frame| frame.time).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        let mut dataset = Self {
            root: root.to_owned(),
            layout,
            frames,
            times,
            window: None,
            frames_per_second: draft.frames_per_second.filter(|rate| rate.is_finite() && *rate > 0.0),
            instances: Vec::new(),
            mask_objects: cryptomatte::ObjectIds::new(),
            points: PointCloud { positions: Vec::new(), colors: Vec::new(), source: PointSource::Random },
            has_alpha,
            warnings,
            notes,
            unknown: draft.unknown.clone(),
            frame: CaptureFrame::default(),
        };
        for frame in &mut dataset.frames {
            frame.time_index = dataset
                .times
                .binary_search_by(|time| time.total_cmp(&frame.time))
                .expect("times hold every time");
        }
        dataset.note_turned_images();
        dataset.read_groups()?;
        dataset.note_poor_coverage();
        let mut unused = draft.unused;
        if options.without_masks {
            for frame in &mut dataset.frames {
                frame.mask = None;
            }
        } else {
            let folder = options.masks.as_deref();
            dataset.attach_masks(folder, options.keyframes, &stored_sizes, &mut unused)?;
        }
        if !unused.is_empty() {
            dataset.notes.push(format!("{}: not used: {}", root.display(), unused.join("; ")));
        }
        dataset.points = dataset.initial_points(draft.points, draft.random_box)?;
        dataset.warnings.extend(points::unseen_warning(&dataset));
        match options.window {
            Some(window) => dataset.during(window),
            None => Ok(dataset),
        }
    }

    /// The same capture with the masks of another folder (a name inside the capture, or a path) and the
    /// instances found there, e.g. to score on `masks` what was trained on `masks_tracker`.
    ///
    /// # Errors
    /// When the folder holds no mask of this capture, or one that does not fit.
    pub fn with_masks(&self, folder: &Path) -> Result<Self, Error> {
        let mut dataset = self.clone();
        dataset.warnings.clear();
        dataset.notes.clear();
        let sizes = dataset
            .frames
            .iter()
            .map(|frame| image::probe(&frame.image).map(|header| header.size_in(frame.turn)))
            .collect::<Result<Vec<_>, _>>()?;
        dataset.attach_masks(Some(folder), false, &sizes, &mut Vec::new())?;
        Ok(dataset)
    }

    /// The list of instances that names the ids of a mask folder (its own `instances.json`, else that of the capture),
    /// and the ids in it; `None` without a list.
    ///
    /// # Errors
    /// When the list cannot be read.
    pub fn named_instances(&self, folder: &Path) -> Result<Option<(PathBuf, BTreeSet<u16>)>, Error> {
        let Some(file) = instances::file_for(&self.root, Some(folder)) else { return Ok(None) };
        let named = instances::read(&file, &mut Vec::new())?;
        Ok(Some((file, named.into_keys().collect())))
    }

    /// Mask file of every frame in another mask folder; `[frames]`, `None` where it has none.
    ///
    /// # Errors
    /// When the folder holds no mask of this capture.
    pub fn mask_paths(&self, folder: &Path) -> Result<Vec<Option<PathBuf>>, Error> {
        let asked = MaskFolder::asked(&self.root, folder);
        let listing = mask_files::locate(&self.root, self.layout, &self.frames, &asked);
        if listing.paths.iter().all(Option::is_none) {
            let known = mask_files::folders_like_masks(&self.root);
            let known = if known.is_empty() {
                "the capture has no folder of masks".to_owned()
            } else {
                format!("the capture has {}", known.join(", "))
            };
            let example = self.frames.first().map(|frame| frame.name.as_str()).unwrap_or_default();
            return Err(Error::MaskFolder {
                folder: folder.to_owned(),
                problem: if listing.folder.is_some() {
                    format!(
                        "no mask in it belongs to a frame; masks are PNG or Cryptomatte EXR files named as the frames, e.g. {example}.png"
                    )
                } else {
                    format!("there is no such mask folder in {}; {known}", self.root.display())
                },
            });
        }
        Ok(listing.paths)
    }

    /// Notes the orientation of images whose EXIF turns them.
    fn note_turned_images(&mut self) {
        let root = self.root.display().to_string();
        let of = |is: &dyn Fn(&Turn) -> bool| self.frames.iter().filter(|frame| is(&frame.turn)).count();
        let turned = of(&|turn| turn.image != Orientation::NoTransforms);
        let stored = of(&|turn| turn.image == Orientation::NoTransforms && *turn != Turn::NONE);
        if turned > 0 {
            self.notes.push(format!("{root}: {turned} images are turned upright, as their EXIF says"));
        }
        if stored > 0 {
            self.notes.push(format!(
                "{root}: {stored} images are read as they are stored, not upright as their EXIF says, since so their cameras are"
            ));
        }
    }

    /// Groups of `splits.json` (`interp`, `novel`, ...) for held-out frames.
    fn read_groups(&mut self) -> Result<(), Error> {
        let path = self.root.join("splits.json");
        if !listing::is_there(&path) {
            return Ok(());
        }
        let groups: BTreeMap<String, serde_json::Value> = json::read(&path)?;
        let index: BTreeMap<String, usize> =
            self.frames.iter().enumerate().map(|(index, frame)| (frame.name.clone(), index)).collect();
        for (group, names) in groups {
            if ["train", "val"].contains(&group.as_str()) {
                continue;
            }
            let Ok(names) = serde_json::from_value::<Vec<String>>(names) else {
                self.warnings.push(format!("{}: {group} is no list of frame names", path.display()));
                continue;
            };
            let mut unknown = Vec::new();
            let mut trained = Vec::new();
            for name in &names {
                match index.get(name) {
                    None => unknown.push(name.as_str()),
                    Some(k) if self.frames[*k].split == Split::Train => trained.push(name.as_str()),
                    Some(k) => self.frames[*k].group = Some(group.clone()),
                }
            }
            for (names, what) in
                [(unknown, "names frames that the capture lacks"), (trained, "names training frames")]
            {
                if !names.is_empty() {
                    self.warnings.push(format!(
                        "{}: group {group} {what}: {}",
                        path.display(),
                        some_of(names.into_iter())
                    ));
                }
            }
        }
        Ok(())
    }

    /// Says what a capture is too poor for.
    fn note_poor_coverage(&mut self) {
        let root = self.root.display().to_string();
        let train = self.train_frames();
        if self.frames.len() == 1 {
            self.warnings.push(format!(
                "{root}: one frame only: nothing is held out, and neither depth nor motion can be recovered"
            ));
            return;
        }
        if self.val_frames().is_empty() {
            self.warnings.push(format!("{root}: no frame is held out, so there is nothing to score"));
        }
        if train.len() > 1 && self.camera_spread() == 0.0 {
            self.warnings.push(format!(
                "{root}: all training frames share one camera centre: depth cannot be recovered from parallax"
            ));
        }
        if train.len() == 1 {
            self.warnings
                .push(format!("{root}: one training frame only: depth and motion cannot be recovered"));
        }
    }

    /// Gives frames their masks and finds the instances in them; files that belong to no frame go to `unused`.
    fn attach_masks(
        &mut self,
        asked: Option<&Path>,
        keyframes: bool,
        stored_sizes: &[(u32, u32)],
        unused: &mut Vec<String>,
    ) -> Result<(), Error> {
        let folder = match asked {
            Some(name) => MaskFolder::asked(&self.root, name),
            None => MaskFolder::of_capture(&self.root, self.layout),
        };
        let mut listing = self.locate_masks(asked, &folder)?;
        if listing.paths.iter().any(Option::is_some) {
            for ((frame, path), confidence) in
                self.frames.iter_mut().zip(listing.paths.drain(..)).zip(listing.confidences.drain(..))
            {
                (frame.mask, frame.confidence) = (path, confidence);
            }
        } else if listing.folder.is_some() && listing.strangers > 0 {
            self.warnings.push(format!(
                "{}: none of its {} files is named as a frame, e.g. {}.png",
                folder.path.display(),
                listing.strangers,
                self.frames[0].name
            ));
        }
        self.check_named_masks()?;
        if self.frames.iter().all(|frame| frame.mask.is_none()) {
            self.warnings.push(format!(
                "{}: no masks: only colour can be trained; give instance masks in {}/ or name their folder",
                self.root.display(),
                mask_files::DEFAULT_FOLDER
            ));
            return Ok(());
        }
        if !keyframes {
            self.note_frames_without_mask(&listing.place);
        }
        if listing.strangers > 0 {
            unused.push(format!(
                "{} mask files in {} that belong to no frame",
                listing.strangers,
                folder.name.display()
            ));
        }
        if listing.numbered {
            self.note_numbered_masks(&listing.place);
        }
        let headers = mask_files::check_headers(&self.frames, stored_sizes)?;
        if let Some(resized) = headers.resized {
            self.warnings.push(format!(
                "{}: {} x {} pixels where the image has {} x {}: resized by nearest neighbour ({} masks)",
                resized.example.display(),
                resized.mask_size.0,
                resized.mask_size.1,
                resized.image_size.0,
                resized.image_size.1,
                resized.count
            ));
        }
        self.find_instances(&folder, &listing, headers.largest_id, keyframes)
    }

    /// The masks of a folder; those that the capture itself names go before, unless the folder was asked for.
    fn locate_masks(&mut self, asked: Option<&Path>, folder: &MaskFolder) -> Result<MaskListing, Error> {
        let listing = mask_files::locate(&self.root, self.layout, &self.frames, folder);
        if let Some(name) = asked {
            self.mask_paths(name)?;
            return Ok(listing);
        }
        let (listing, left_out) = listing.after_named(folder, &self.frames);
        if left_out > 0 {
            self.warnings.push(format!(
                "{}: not used: the capture names the masks of its frames, and they are not in it ({}); to take \
                 these, name it as the folder of masks",
                folder.path.display(),
                listing.place
            ));
        }
        Ok(listing)
    }

    /// Refuses masks that the capture names and does not have.
    fn check_named_masks(&self) -> Result<(), Error> {
        for frame in &self.frames {
            if let Some(mask) = frame.mask.as_ref().filter(|mask| !listing::is_there(mask)) {
                return Err(Error::MissingFile {
                    path: mask.clone(),
                    fix: format!(
                        "it is named as the mask of frame {}; restore it, remove mask_path, or name a folder of masks",
                        frame.name
                    ),
                });
            }
        }
        Ok(())
    }

    /// Reports that training frames, or else held-out ones, have no mask.
    fn note_frames_without_mask(&mut self, place: &str) {
        let masked_of = |split: Split| {
            let frames = self.split_frames(split);
            (frames.iter().filter(|index| self.frames[**index].mask.is_some()).count(), frames.len())
        };
        let ((train, all_train), (val, all_val)) = (masked_of(Split::Train), masked_of(Split::Val));
        if train < all_train {
            let masked = self.frames.iter().filter(|frame| frame.mask.is_some()).count();
            self.warnings.push(format!("{place}: {masked} of {} frames have a mask", self.frames.len()));
        } else if val < all_val {
            self.notes.push(format!(
                "{place}: {val} of {all_val} held-out frames have a mask; instances are scored {}",
                if val == 0 { "on none" } else { "on these" }
            ));
        }
    }

    /// Notes which masks belong to which frames by their numbers.
    fn note_numbered_masks(&mut self, place: &str) {
        let numbered: Vec<String> = self
            .frames
            .iter()
            .filter_map(|frame| {
                let mask = frame.mask.as_ref()?;
                Some(format!("{} for {}", mask.file_name()?.to_string_lossy(), frame.name))
            })
            .collect();
        self.notes.push(format!(
            "{place}: the files belong to frames by their numbers: {}",
            some_of(numbered.iter().map(String::as_str))
        ));
    }

    /// Decodes the masks once and names the instances in them.
    fn find_instances(
        &mut self,
        folder: &MaskFolder,
        listing: &MaskListing,
        largest_id: u16,
        keyframes: bool,
    ) -> Result<(), Error> {
        let place = &listing.place;
        let file = instances::file_for(&self.root, listing.folder.as_deref());
        let mut named = match &file {
            Some(file) => instances::read(file, &mut self.warnings)?,
            None => BTreeMap::new(),
        };
        let manifests = mask_files::manifests(&self.frames)?;
        self.mask_objects = cryptomatte::ObjectIds::new();
        if !manifests.is_empty() {
            let explicit = cryptomatte::explicit(listing.folder.as_deref())?;
            self.mask_objects =
                cryptomatte::assign(&manifests, &explicit, &mut named, Path::new(place), &mut self.warnings)?;
        }
        let counts = mask_files::count_pixels(&self.frames, &self.mask_objects)?;
        let found: BTreeSet<u16> =
            counts.iter().flatten().flat_map(|(counts, _)| counts.keys().copied()).collect();
        if found.is_empty() {
            self.warnings
                .push(format!("{place}: the masks hold no labelled pixel; only colour can be trained"));
        } else if let (1, Some(&id)) = (found.len(), found.first())
            && (id == instances::WHITE || folder.name == Path::new(mask_files::SEGMENTS))
            && !named.contains_key(&id)
        {
            named.insert(id, instances::foreground(id));
            let what = format!("{place}: one value apart from 0 ({id}): taken as one instance, foreground");
            if folder.name == Path::new(mask_files::SEGMENTS) {
                self.notes.push(what);
            } else {
                self.warnings.push(format!(
                    "{what}; masks of valid pixels or of what to ignore are no instances (--no-masks)"
                ));
            }
        }
        let labelled_train = self.frames.iter().zip(&counts).any(|(frame, counts)| {
            frame.split == Split::Train && counts.as_ref().is_some_and(|c| !c.0.is_empty())
        });
        if !found.is_empty() && !labelled_train && !keyframes {
            self.warnings
                .push(format!("{place}: no training frame has a labelled pixel; only colour can be trained"));
        }
        if file.is_none() && named.is_empty() && !found.is_empty() {
            self.warnings.push(format!(
                "{}: there is no instances.json, so instances are called instance_<id>",
                self.root.display()
            ));
        }
        self.instances = instances::complete(&found, largest_id, named, file.as_deref(), &mut self.warnings);
        Ok(())
    }

    /// Points of the capture, else random ones; colours are sampled from the images where the source has none. Cameras
    /// and points enter the frame of the dataset.
    fn initial_points(
        &mut self,
        file: Option<(RawPoints, PathBuf)>,
        random_box: Option<f64>,
    ) -> Result<PointCloud, Error> {
        let (mut positions, colors, source) = match self.measured_points(file) {
            Some((raw, path)) => (raw.positions, raw.colors, PointSource::File(path)),
            None => {
                let cameras: Vec<PinholeCamera> =
                    self.train_frames().into_iter().map(|index| self.frames[index].camera).collect();
                (points::draw(&cameras, random_box), None, PointSource::Random)
            }
        };
        self.enter_own_frame_with(&mut positions);
        let positions = placement::singles(positions);
        let colors = match colors {
            Some(colors) => colors,
            None => points::sample_colors(self, &positions)?,
        };
        Ok(PointCloud { positions, colors, source })
    }

    /// The points of a file, where there are any and they were measured.
    fn measured_points(&mut self, file: Option<(RawPoints, PathBuf)>) -> Option<(RawPoints, PathBuf)> {
        let (mut raw, path) = file?;
        let place = path.display();
        let dropped = raw.retain_finite();
        if dropped > 0 {
            self.warnings.push(format!("{place}: {dropped} points are not finite and are left out"));
        }
        if raw.positions.is_empty() {
            self.warnings.push(format!("{place}: it holds no point; random ones are taken"));
            return None;
        }
        if points::are_made_up(&raw) {
            self.notes.push(format!(
                "{place}: its {} points were drawn at random (they fill a box evenly, and colours do not depend on places), \
                 not measured; they count as none",
                raw.positions.len()
            ));
            return None;
        }
        self.notes.extend(raw.note.take().map(|note| format!("{place}: {note}")));
        Some((raw, path))
    }
}

/// Frames with checked cameras in order of camera, time and name; whether any image has alpha; the sizes of the
/// images in their files, once turned, in the same order.
#[allow(clippy::type_complexity, reason = "one caller")]
fn frames(
    root: &Path,
    draft: &Draft,
    options: &OpenOptions,
    warnings: &mut Vec<String>,
) -> Result<(Vec<Frame>, bool, Vec<(u32, u32)>), Error> {
    let mut names = BTreeSet::new();
    for frame in &draft.frames {
        // Whoever writes a file per frame joins its name to a folder.
        cif_output::check_name(&frame.name).map_err(|problem| Error::FrameName {
            path: frame.camera.source.clone(),
            frame: frame.name.clone(),
            problem,
        })?;
        if !names.insert(frame.name.as_str()) {
            return Err(Error::DuplicateFrame {
                path: frame.camera.source.clone(),
                frame: frame.name.clone(),
            });
        }
    }
    if let Some(frame) = draft.frames.iter().find(|frame| frame.camera_name.contains('\0')) {
        return Err(Error::Intrinsics {
            path: frame.camera.source.clone(),
            frame: frame.name.clone(),
            problem: format!(
                "its camera is called {:?}, with a NUL character; leave it out",
                frame.camera_name
            ),
        });
    }
    if !draft.frames.iter().any(|frame| frame.split == Split::Train) {
        return Err(Error::invalid(root, "no frame is left to train on; add frames to the training list"));
    }
    // `stored_reduction` divides what is asked for, unless the capture has no such images.
    let requested = options.downscale.unwrap_or(draft.stored_reduction);
    let reduction = if requested.is_multiple_of(draft.stored_reduction) {
        requested / draft.stored_reduction
    } else {
        warnings.push(format!(
            "{}: images are stored reduced by {}, so a reduction by {requested} is not to be had; they are read as they \
             are",
            root.display(),
            draft.stored_reduction
        ));
        1
    };
    let headers: Vec<Result<image::ImageHeader, Error>> =
        draft.frames.par_iter().map(|frame| image::probe(&frame.image)).collect();
    let mut has_alpha = false;
    let mut uncovered = Vec::new();
    let mut frames = Vec::with_capacity(draft.frames.len());
    for (frame, header) in draft.frames.iter().zip(headers) {
        let header = header?;
        has_alpha |= header.has_alpha;
        let stored = (header.width, header.height);
        let turn = Turn::for_camera(header.orientation, stored, frame.camera.size, draft.of_stored_pixels);
        let upright = header.size_in(turn);
        let loaded = reduced_size(upright.0, upright.1, reduction);
        let (camera, lens) = camera_check::finish(&frame.camera, &frame.name, upright, loaded)?;
        let camera = if options.centre_principal_point { centred(camera) } else { camera };
        if !lens.is_identity() && !camera_check::lens_covers_image(&camera, &lens) {
            uncovered.push(frame.name.as_str());
        }
        frames.push((
            Frame {
                name: frame.name.clone(),
                camera_name: frame.camera_name.clone(),
                camera,
                lens,
                // A negative zero is a zero: equal times are the same bits.
                time: frame.time + 0.0,
                time_index: 0,
                split: frame.split,
                group: None,
                image: frame.image.clone(),
                turn,
                source: draft.sources.get(&frame.name).cloned(),
                mask: frame.mask.clone(),
                confidence: None,
            },
            upright,
        ));
    }
    if !uncovered.is_empty() {
        warnings.push(format!(
            "{}: the lens model does not reach the corners of the image for {}; their corners repeat other pixels",
            root.display(),
            some_of(uncovered.into_iter())
        ));
    }
    frames.sort_by(|(a, _), (b, _)| {
        a.camera_name.cmp(&b.camera_name).then(a.time.total_cmp(&b.time)).then(a.name.cmp(&b.name))
    });
    let (frames, sizes) = frames.into_iter().unzip();
    Ok((frames, has_alpha, sizes))
}
