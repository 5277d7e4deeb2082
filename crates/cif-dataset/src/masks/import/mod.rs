//! Masks of other tools as masks of a capture.
//!
//! | module | answers |
//! |---|---|
//! | `kind` | which tool a file or folder comes from |
//! | `frames` | which frame of the capture a picture of the source shows |
//! | `objects` | which objects there are, and which ids and labels they get |
//! | `draw` | which object a pixel belongs to, where several claim it |
//! | `coverage` | which pixels one object covers |
//! | `runs`, `polygon`, `brush` | which pixels a run-length code, a polygon or a brush covers |
//! | `tracker`, `files`, `mattes`, `arrays`, `coco`, `youtube_vis`, `label_studio`, `cvat` | what a source holds, one file each |
//!
//! Readers list what a source holds without decoding pictures; [`Import::draw`] decodes one frame at a time.

mod arrays;
mod brush;
mod coco;
mod coverage;
mod cvat;
mod draw;
mod files;
mod frames;
mod kind;
mod label_studio;
mod mattes;
mod objects;
mod polygon;
mod runs;
#[cfg(test)]
mod tests;
mod tracker;
mod youtube_vis;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cif_geometry::PixelGrid;

use self::draw::Content;
use self::frames::{FrameNames, Task};
pub use self::kind::SourceKind;
use self::objects::Objects;
use crate::files::listing;
use crate::load::same_aspect;
use crate::{Dataset, Error, InstanceLabel};

/// A picture of a source: a frame of the capture in the words of another tool.
struct Picture {
    /// Name of its frame, as the source has it: a path without ending, or a number.
    name: String,
    /// File, or entry of a file, for messages.
    place: Place,
    /// Width and height that the source states.
    size: Option<(u32, u32)>,
    content: Content,
}

/// A place in a source, for messages.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    file: PathBuf,
    /// Entry of the file, such as `annotation 12`; empty where the file is all.
    entry: String,
}

impl Place {
    fn file(path: &Path) -> Self {
        Self { file: path.to_owned(), entry: String::new() }
    }

    fn entry(path: &Path, entry: impl Into<String>) -> Self {
        Self { file: path.to_owned(), entry: entry.into() }
    }

    /// An error at this place.
    fn error(&self, problem: impl std::fmt::Display) -> Error {
        let entry = if self.entry.is_empty() { String::new() } else { format!("{}: ", self.entry) };
        Error::invalid(&self.file, format!("{entry}{problem}"))
    }
}

/// What a reader lists of a source.
#[derive(Default)]
struct Listing {
    objects: Objects,
    pictures: Vec<Picture>,
    /// The frames of a video that numbers of pictures count, where they are not all of them.
    task: Option<Task>,
    notes: Vec<String>,
}

/// Masks of another tool, listed and matched with the frames of a capture.
pub struct Import {
    /// Tool that they come from.
    pub kind: SourceKind,
    /// Every object of the source with its id, ascending.
    pub instances: Vec<InstanceLabel>,
    /// What people should know: how frames were matched, what was left out.
    pub notes: Vec<String>,
    /// Id of every object of the source.
    ids: Vec<u16>,
    /// Picture of every frame, `[frames]`.
    pictures: Vec<Option<Picture>>,
}

/// The mask of a frame.
pub struct Drawn {
    /// Id of every pixel, 0 for unlabelled, at the size of the frame.
    pub ids: PixelGrid<u16>,
    /// Pixels that several objects claimed.
    pub disputed: u64,
    /// Width and height of the source, of which the ids are the nearest pixels where the frame has another size.
    pub size: (u32, u32),
}

impl Import {
    /// Lists the masks of a file or folder and matches them with the frames of a capture. `first_number` is the number of
    /// the first frame of the video, where names end in numbers of its frames and nothing else shows it.
    ///
    /// # Errors
    /// When nothing tells what the source is, it is damaged, no picture belongs to a frame, or two belong to one.
    pub fn open(
        source: &Path,
        kind: Option<SourceKind>,
        first_number: Option<u64>,
        dataset: &Dataset,
    ) -> Result<Self, Error> {
        if !source.exists() {
            return Err(Error::invalid(source, "there is no such file or folder; give the masks to import"));
        }
        let names = FrameNames::new(dataset);
        let kind = match kind {
            Some(kind) => kind,
            None => kind::recognise(source, &names)?,
        };
        let mut listing = match kind {
            SourceKind::Tracker => tracker::list(source)?,
            SourceKind::FrameFolders => files::list(source, files::Order::FrameThenObject)?,
            SourceKind::ObjectFolders => files::list(source, files::Order::ObjectThenFrame)?,
            SourceKind::Mattes => mattes::list(source)?,
            SourceKind::Arrays => arrays::list(source)?,
            SourceKind::Coco => coco::list(source)?,
            SourceKind::YoutubeVis => youtube_vis::list(source, &names)?,
            SourceKind::LabelStudio => label_studio::list(source)?,
            SourceKind::Cvat => cvat::list(source)?,
        };
        if listing.pictures.is_empty() {
            return Err(Error::invalid(
                source,
                format!("no masks of {} in it; name another source with --from", kind.described()),
            ));
        }
        let stated: Vec<&str> = listing.pictures.iter().map(|picture| picture.name.as_str()).collect();
        let matched = match listing.task.filter(|_| first_number.is_none()) {
            Some(task) => names.of_task(&stated, task),
            None => names.resolve(&stated, first_number),
        };
        let matched = matched.map_err(|problem| Error::invalid(source, problem))?;
        listing.notes.extend(matched.note);
        let mut pictures: Vec<Option<Picture>> = dataset.frames.iter().map(|_| None).collect();
        let mut strangers = Vec::new();
        for (picture, frame) in listing.pictures.into_iter().zip(matched.frames) {
            let Some(frame) = frame else {
                strangers.push(picture.name);
                continue;
            };
            if let Some(other) = &pictures[frame] {
                return Err(picture.place.error(format!(
                    "it shows frame {}, and so does {} {}; keep one of them",
                    dataset.frames[frame].name,
                    other.place.file.display(),
                    other.place.entry,
                )));
            }
            pictures[frame] = Some(picture);
        }
        if let Some(first) = strangers.first().filter(|_| !matched.of_video) {
            listing.notes.push(format!("{} masks belong to no frame, the first is {first}", strangers.len()));
        }
        let (ids, instances) = listing.objects.finish().map_err(|problem| Error::invalid(source, problem))?;
        Ok(Self { kind, instances, notes: listing.notes, ids, pictures })
    }

    /// Whether the source shows a frame.
    #[must_use]
    pub fn shows(&self, frame: usize) -> bool {
        self.pictures[frame].is_some()
    }

    /// Decodes the mask of a frame; `None` where the source does not show it. Where several objects claim a pixel, the
    /// one on the higher layer has it (CVAT knows layers), on one layer the one with fewer pixels in this frame, and
    /// of equal ones the later one.
    ///
    /// # Errors
    /// When a picture is damaged, or of another aspect than the frame.
    ///
    /// # Panics
    /// When there is no frame `frame`, or the capture is another one.
    pub fn draw(&self, dataset: &Dataset, frame: usize) -> Result<Option<Drawn>, Error> {
        let Some(picture) = &self.pictures[frame] else { return Ok(None) };
        let frame = &dataset.frames[frame];
        let size = (frame.camera.width, frame.camera.height);
        draw::draw(picture, size, frame.turn, &self.ids).map(Some)
    }
}

/// Refuses a size of another aspect than that of the frame.
fn check_aspect(place: &Place, size: (u32, u32), frame: (u32, u32)) -> Result<(), Error> {
    if size.0 > 0 && size.1 > 0 && same_aspect(size, frame) {
        return Ok(());
    }
    Err(place.error(format!(
        "{} x {} pixels, its frame has {} x {}: another aspect; export the masks at the size of the images or of their \
         video",
        size.0, size.1, frame.0, frame.1
    )))
}

/// Most pixels of a source for one of its frame: captures are kept reduced by 8 at the most, along both sides.
const MOST_PIXELS: u64 = 64;

/// Refuses a size that a source only states, where drawing it would take far more memory than its frame.
fn check_stated(place: &Place, size: (u32, u32), frame: (u32, u32)) -> Result<(), Error> {
    let pixels = |(width, height): (u32, u32)| u64::from(width) * u64::from(height);
    let most = pixels(frame).saturating_mul(MOST_PIXELS);
    if pixels(size) <= most {
        return Ok(());
    }
    Err(place.error(format!(
        "it states {} x {} = {} pixels, more than {MOST_PIXELS} times the {} x {} of its frame ({most}); export the masks \
         at the size of the images or of their video",
        size.0,
        size.1,
        pixels(size),
        frame.0,
        frame.1
    )))
}

/// Refuses a part of a picture that has another size.
fn check_size(place: &Place, size: (u32, u32), picture: (u32, u32)) -> Result<(), Error> {
    if size == picture {
        return Ok(());
    }
    Err(place.error(format!(
        "{} x {} pixels, other masks of its frame {} x {}; export them at one size",
        size.0, size.1, picture.0, picture.1
    )))
}

/// Files of a folder and its folders with one of these endings, by their path inside without ending, in order of names.
fn files_below(folder: &Path, endings: &[&str]) -> Result<BTreeMap<String, PathBuf>, Error> {
    let mut found = BTreeMap::new();
    for path in listing::below(folder)?.into_iter().filter(|path| listing::has_extension(path, endings)) {
        let inside = path.strip_prefix(folder).unwrap_or(&path).with_extension("");
        let name = inside.to_string_lossy().replace('\\', "/");
        if let Some(other) = found.insert(name, path.clone()) {
            return Err(Error::invalid(
                &path,
                format!("{} has the same name; keep one of the two", other.display()),
            ));
        }
    }
    Ok(without_common_folder(found))
}

/// Names without the folders that all of them share, such as the name of the video.
fn without_common_folder(mut files: BTreeMap<String, PathBuf>) -> BTreeMap<String, PathBuf> {
    loop {
        let Some(folder) =
            files.keys().next().and_then(|name| name.split_once('/')).map(|(first, _)| format!("{first}/"))
        else {
            return files;
        };
        // One level is kept, since it may name an object or a camera.
        let shared =
            files.keys().all(|name| name.strip_prefix(&folder).is_some_and(|rest| rest.contains('/')));
        if !shared {
            return files;
        }
        files = files.into_iter().map(|(name, path)| (name[folder.len()..].to_owned(), path)).collect();
    }
}
