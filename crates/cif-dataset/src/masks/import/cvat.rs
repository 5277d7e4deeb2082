//! XML of CVAT 1.1: pictures with polygons and masks, and videos with tracks of them.
//!
//! In pictures, objects are distinguished by the attribute `track_id`, which CVAT adds for tracks; without, the label is
//! the object. Tracks of videos are objects, and frames have the numbers of the video; a task may take every `step`th of
//! them from `start_frame` on. Source: the XML annotation format of CVAT, version 1.1.

use std::collections::BTreeMap;
use std::path::Path;

use roxmltree::{Document, Node};

use super::frames::Task;
use super::picture::{Content, Listing, Picture, Piece, Place, Shape};
use super::{polygon, runs};
use crate::Error;

/// Larger files are not annotations.
const MAX_BYTES: u64 = 1 << 30;

pub(super) fn list(source: &Path) -> Result<Listing, Error> {
    let size = cif_input::check(source).map_err(Error::read(source))?;
    if size > MAX_BYTES {
        return Err(Error::invalid(source, format!("{size} bytes are too many for annotations")));
    }
    let text = cif_input::read_to_string(source).map_err(Error::read(source))?;
    let document = Document::parse(&text)
        .map_err(|error| Error::invalid(source, format!("no readable XML ({error}); export it again")))?;
    let root = document.root_element();
    if root.tag_name().name() != "annotations" {
        return Err(Error::invalid(
            source,
            format!("its root is <{}>, not the <annotations> of CVAT 1.1", root.tag_name().name()),
        ));
    }
    let mut file =
        File { source, document: &document, result: Listing::default(), left_out: BTreeMap::new() };
    let tracks: Vec<Node<'_, '_>> = root.children().filter(|node| node.has_tag_name("track")).collect();
    if tracks.is_empty() {
        for image in root.children().filter(|node| node.has_tag_name("image")) {
            file.image(image)?;
        }
    } else {
        file.tracks(root, &tracks)?;
        file.result.task = task(root).map_err(|problem| Error::invalid(source, problem))?;
    }
    let has_masks = file.result.pictures.iter().any(|picture| match &picture.content {
        Content::Pieces(pieces) => !pieces.is_empty(),
        _ => true,
    });
    if !has_masks && !file.left_out.is_empty() {
        let shapes: Vec<String> =
            file.left_out.iter().map(|(kind, count)| format!("{count} of kind {kind}")).collect();
        let problem =
            format!("none of its shapes are masks ({}); draw masks or polygons in CVAT", shapes.join(", "));
        return Err(Error::invalid(source, problem));
    }
    for (kind, count) in file.left_out {
        let note = format!("{count} shapes of kind {kind} are no masks and were left out");
        file.result.notes.push(note);
    }
    Ok(file.result)
}

/// The frames of its video that a task took; `None` where it took all, or the file is of a job alone, which does not say
/// where its task begins, or of several tasks.
fn task(root: Node<'_, '_>) -> Result<Option<Task>, String> {
    let tasks: Vec<Node<'_, '_>> = root.descendants().filter(|node| node.has_tag_name("task")).collect();
    let [task] = tasks[..] else { return Ok(None) };
    let text = |name: &str| {
        let node = task.children().find(|node| node.has_tag_name(name));
        node.and_then(|node| node.text()).map(str::trim).filter(|text| !text.is_empty())
    };
    let number = |name: &str, text: &str| {
        text.parse::<u64>()
            .map_err(|_| format!("<{name}> of its task is {text:?}, where a whole number is expected"))
    };
    let start = text("start_frame").map_or(Ok(0), |text| number("start_frame", text))?;
    let step = match text("frame_filter") {
        None => 1,
        Some(filter) => match filter.strip_prefix("step=") {
            Some(step) => number("frame_filter", step.trim())?.max(1),
            None => {
                return Err(format!("<frame_filter> of its task is {filter:?}, where step=N is expected"));
            }
        },
    };
    Ok(((start, step) != (0, 1)).then_some(Task { start, step }))
}

struct File<'a, 'input> {
    source: &'a Path,
    document: &'a Document<'input>,
    result: Listing,
    /// Shapes that cover no pixels, by kind.
    left_out: BTreeMap<String, usize>,
}

impl File<'_, '_> {
    fn place(&self, node: Node<'_, '_>) -> Place {
        let line = self.document.text_pos_at(node.range().start).row;
        Place::entry(self.source, format!("line {line}"))
    }

    fn text<'b>(&self, node: Node<'b, '_>, name: &str) -> Result<&'b str, Error> {
        node.attribute(name).ok_or_else(|| {
            self.place(node).error(format!("<{}> has no {name}; export it again", node.tag_name().name()))
        })
    }

    fn number<T: std::str::FromStr>(&self, node: Node<'_, '_>, name: &str) -> Result<T, Error> {
        let text = self.text(node, name)?;
        text.trim().parse().map_err(|_| {
            self.place(node).error(format!("{name} is {text:?}, where a whole number is expected"))
        })
    }

    fn image(&mut self, image: Node<'_, '_>) -> Result<(), Error> {
        let size = (self.number(image, "width")?, self.number(image, "height")?);
        let mut pieces = Vec::new();
        for node in image.children().filter(Node::is_element) {
            let Some(shape) = self.shape(node)? else { continue };
            let label = self.text(node, "label")?;
            let track = node
                .children()
                .find(|child| child.has_tag_name("attribute") && child.attribute("name") == Some("track_id"))
                .and_then(|attribute| attribute.text())
                .map(|text| format!("track {}", text.trim()));
            let key = track.as_deref().unwrap_or(label);
            pieces.push(self.piece(node, key, label, shape)?);
        }
        let name = self.text(image, "name")?.to_owned();
        let place = self.place(image);
        self.result.pictures.push(Picture {
            name,
            place,
            size: Some(size),
            content: Content::Pieces(pieces),
        });
        Ok(())
    }

    fn tracks(&mut self, root: Node<'_, '_>, tracks: &[Node<'_, '_>]) -> Result<(), Error> {
        let original = root.descendants().find(|node| node.has_tag_name("original_size"));
        let side = |name: &str| {
            let node = original?.children().find(|node| node.has_tag_name(name))?;
            node.text()?.trim().parse::<u32>().ok()
        };
        let size = side("width").zip(side("height"));
        let mut frames: BTreeMap<u64, Vec<Piece>> = BTreeMap::new();
        for track in tracks {
            let label = self.text(*track, "label")?;
            let key = format!("track {}", self.text(*track, "id")?);
            for node in track.children().filter(Node::is_element) {
                // Where an object has left the picture, its last shape is repeated.
                if node.attribute("outside") == Some("1") {
                    continue;
                }
                let Some(shape) = self.shape(node)? else { continue };
                let frame = self.number(node, "frame")?;
                let piece = self.piece(node, &key, label, shape)?;
                frames.entry(frame).or_default().push(piece);
            }
        }
        for (frame, pieces) in frames {
            let place = Place::entry(self.source, format!("frame {frame}"));
            let content = Content::Pieces(pieces);
            self.result.pictures.push(Picture { name: frame.to_string(), place, size, content });
        }
        Ok(())
    }

    fn piece(&mut self, node: Node<'_, '_>, key: &str, label: &str, shape: Shape) -> Result<Piece, Error> {
        let place = self.place(node);
        let layer = if node.has_attribute("z_order") { self.number(node, "z_order")? } else { 0 };
        let object = self.result.objects.enter(key, Some(label)).map_err(|problem| place.error(problem))?;
        Ok(Piece { object, layer, place, shape })
    }

    /// The pixels of a node; `None` where it covers none.
    fn shape(&mut self, node: Node<'_, '_>) -> Result<Option<Shape>, Error> {
        let refused = |problem: String| self.place(node).error(problem);
        match node.tag_name().name() {
            "polygon" => {
                let numbers = numbers::<f64>(self.text(node, "points")?, &[';', ',']).map_err(refused)?;
                Ok(Some(Shape::Polygons(vec![polygon::corners(&numbers).map_err(refused)?])))
            }
            "mask" => {
                let counts = numbers(self.text(node, "rle")?, &[',']).map_err(refused)?;
                let code = runs::Code::Box {
                    left: self.number(node, "left")?,
                    top: self.number(node, "top")?,
                    width: self.number(node, "width")?,
                    height: self.number(node, "height")?,
                    counts,
                };
                Ok(Some(Shape::Runs(code, None)))
            }
            "tag" | "attribute" => Ok(None),
            other => {
                *self.left_out.entry(other.to_owned()).or_default() += 1;
                Ok(None)
            }
        }
    }
}

fn numbers<T: std::str::FromStr>(text: &str, separators: &[char]) -> Result<Vec<T>, String> {
    text.split(separators)
        .map(|part| {
            part.trim().parse().map_err(|_| format!("{:?} is no number; export it again", part.trim()))
        })
        .collect()
}
