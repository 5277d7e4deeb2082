//! Masks of other tools as masks of a capture.
//!
//! | module | answers |
//! |---|---|
//! | `kind` | which tool a file or folder comes from |
//! | `frames` | which frame of the capture a picture of the source shows |
//! | `picture` | what a source holds: objects, and pictures that show them |
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
mod files_below;
mod frames;
mod kind;
mod label_studio;
mod mattes;
mod objects;
mod picture;
mod polygon;
mod runs;
#[cfg(test)]
mod tests;
mod tracker;
mod youtube_vis;

use std::path::Path;

pub use self::draw::Drawn;
use self::frames::FrameNames;
pub use self::kind::SourceKind;
use self::picture::Picture;
use crate::{Dataset, Error, InstanceLabel};

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

impl Import {
    /// Lists the masks of a file or folder and matches them with the frames of a capture. `first_number` is the number of
    /// the first frame of the video, where names end in numbers of its frames and nothing else shows it.
    ///
    /// # Errors
    /// When nothing shows what the source is, it is damaged, no picture belongs to a frame, or two belong to one.
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
