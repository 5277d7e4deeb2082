//! PLY files of splats, ASCII and binary, whatever the order of their properties.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use cif_geometry::scalar::direct_sigmoid;
use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};
use cif_geometry::{Bounds, quaternion};
use cif_scene::assemble::{Prim, Prims, assemble, color_range, origin_of};
use cif_scene::files::FileError;
use cif_scene::{CaptureFrame, SceneGraph, Splats, UpAxis};
use glam::DVec3;
use ply_rs_bw::parser::{ParseError, Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use crate::PlyError;
use crate::pose::turn_up;
use crate::write::{RENDER_MODE, RENDER_MODE_MIP, TURNED, WORLD_OFFSET, WORLD_SCALE};

/// Positions of what is read in a row.
const POSITION: usize = 0;
const OPACITY: usize = 3;
const SCALE: usize = 4;
const ROTATION: usize = 7;
const COLOR: usize = 11;
const REST: usize = 14;
const FILTER: usize = REST + 45;
const SLOTS: usize = FILTER + 1;

/// Rows reserved before any is seen.
const FIRST_ROWS: usize = 1 << 16;

/// An element that is read past.
struct Ignored;

impl PropertyAccess for Ignored {
    fn new() -> Self {
        Self
    }

    fn set_property(&mut self, _: &str, _: Property) -> PropertyAccessResult {
        PropertyAccessResult::Ignored
    }
}

/// Reads splats: INRIA layout, ASCII or binary of either byte order, properties in any order, spherical harmonics
/// of degree 0 to 3, or colours `red`, `green`, `blue`; two scales are those of flat splats (2D Gaussian Splatting).
/// They become one still object that carries the file's name, occupied and certain of its identity, in the axes of the
/// file, or as captured where we turned them; `rows` count the splats of the file. Splats far from the origin get one of
/// their own in double precision, which [`SceneGraph::frame`] records. The comment `SplatRenderMode` says whether they are
/// drawn antialiased, and `Vertical Axis` of other tools which axis points up. The smoothing filter of Mip-Splatting
/// (`filter_3D`) becomes a part of sizes and opacities; the prefix that CloudCompare gives names (`scalar_`) does not count.
///
/// # Errors
/// No PLY, cut off, or without what a splat needs; the message says what is missing.
pub fn read(path: &Path) -> Result<SceneGraph, PlyError> {
    let failed = |source| FileError::Read { path: path.to_owned(), source };
    let invalid = |what: String| PlyError::Invalid { path: path.to_owned(), what };
    let file = cif_input::open(path).map_err(failed)?;
    let size = file.metadata().map_err(failed)?.len();
    let mut reader = Reader::new(BufReader::with_capacity(1 << 16, file));
    let parser = Parser::<Ignored>::new();
    let damaged = |error: ParseError| {
        let text = error.to_string();
        invalid(format!("not a readable PLY file ({})", text.lines().next().unwrap_or_default()))
    };
    let header = parser.read_header(&mut reader).map_err(damaged)?;
    let frame = frame(&header.comments).map_err(invalid)?;
    for (name, element) in &header.elements {
        let ascii = header.encoding == Encoding::Ascii;
        let least = smallest_size(element, ascii);
        if element.count > 0 && (least == 0 || (element.count as u64).saturating_mul(least) > size) {
            return Err(invalid(format!(
                "its header claims {} elements `{name}`, more than its {size} bytes can hold: it is cut off or damaged; copy it again",
                element.count
            )));
        }
        if name != "vertex" {
            // Elements before the splats are read past.
            parser.read_payload_for_element(&mut reader, element, &header).map_err(damaged)?;
            continue;
        }
        let columns = Columns::of(element, header.encoding).map_err(invalid)?;
        let collected = columns
            .read(reader.get_mut(), element.count)
            .map_err(|what| invalid(format!("{what}; copy it again")))?;
        if collected.centres.is_empty() {
            return Err(invalid(format!("none of its {} splats can be drawn", element.count)));
        }
        let mut warnings = columns.notes();
        let antialiased = render_mode(&header.comments, &mut warnings);
        let scene = collected.scene(path, (frame, turned(&header.comments)), warnings);
        let up_axis = vertical_axis(&header.comments).unwrap_or(scene.up_axis);
        return assemble(Prims { antialiased, up_axis, ..scene }).map_err(|error| invalid(error.to_string()));
    }
    Err(invalid("it has no element `vertex`; splats are expected".to_owned()))
}

/// True where the file is one of ours.
fn is_ours(comments: &[String]) -> bool {
    comments.first().is_some_and(|comment| comment.trim_start().starts_with("cif "))
}

/// The axis that one of our files was turned to.
fn turned(comments: &[String]) -> Option<UpAxis> {
    let mut ours = comments.iter().filter(|_| is_ours(comments));
    ours.find_map(|comment| comment.trim().strip_prefix(TURNED)?.trim().parse().ok())
}

/// The axis that points up, where the comment of nerfstudio or Brush states it (`Vertical Axis: z`).
fn vertical_axis(comments: &[String]) -> Option<UpAxis> {
    let mut others = comments.iter().filter(|_| !is_ours(comments));
    others
        .find_map(|comment| comment.trim().to_lowercase().strip_prefix("vertical axis:")?.trim().parse().ok())
}

/// Where our comments place the scene in the world of its capture.
fn frame(comments: &[String]) -> Result<CaptureFrame, String> {
    let mut frame = CaptureFrame::default();
    if !is_ours(comments) {
        return Ok(frame);
    }
    let numbers = |comment: &str, name: &str| -> Option<Option<Vec<f64>>> {
        let words = comment.trim().strip_prefix(name)?.split_ascii_whitespace();
        Some(words.map(|word| word.parse().ok()).collect())
    };
    for comment in comments {
        let wrong = || format!("its comment '{}' is damaged and gives no place; remove it", comment.trim());
        if let Some(offset) = numbers(comment, WORLD_OFFSET) {
            frame.offset = offset.and_then(|offset| offset.try_into().ok()).ok_or_else(wrong)?;
        } else if let Some(scale) = numbers(comment, WORLD_SCALE) {
            let [scale] = scale.and_then(|scale| scale.try_into().ok()).ok_or_else(wrong)?;
            frame.scale = scale;
        } else {
            continue;
        }
        if !frame.is_valid() {
            return Err(wrong());
        }
    }
    Ok(frame)
}

/// True for splats that were trained antialiased, as the last comment of Brush (`SplatRenderMode: mip`) or Postshot
/// (`antialiased 1`) states; `None` where none does.
fn render_mode(comments: &[String], warnings: &mut Vec<String>) -> Option<bool> {
    let mut antialiased = None;
    for comment in comments {
        let lower = comment.trim().to_lowercase();
        if let Some(mode) = lower.strip_prefix(&RENDER_MODE.to_lowercase()) {
            match mode.trim() {
                RENDER_MODE_MIP => antialiased = Some(true),
                "default" | "2dgs" => antialiased = Some(false),
                other => warnings.push(format!(
                    "its render mode '{other}' is not known; its splats are drawn in the default mode"
                )),
            }
        } else if let Some(flag) = lower.strip_prefix("antialiased ") {
            antialiased = match flag.trim() {
                "0" => Some(false),
                "1" => Some(true),
                _ => antialiased,
            };
        }
    }
    antialiased
}

/// Where in an element the values of a splat stand.
struct Columns {
    encoding: Encoding,
    /// Type, byte offset in a binary row, and slot, per property.
    properties: Vec<(ScalarType, usize, Option<usize>)>,
    row_bytes: usize,
    degree: u8,
    /// Values of white of colours that stand in place of coefficients.
    colors: Option<White>,
    /// True for splats with two scales.
    flat: bool,
    /// True for splats with a smoothing filter of their own.
    filtered: bool,
}

/// The value that is full light in a colour.
#[derive(Clone, Copy)]
enum White {
    /// That of the type of the property.
    Known(f32),
    /// By the range of the values.
    ByRange,
}

impl Columns {
    fn of(element: &ElementDef, encoding: Encoding) -> Result<Self, String> {
        let names: Vec<&str> = element.properties.keys().map(|name| own_name(element, name)).collect();
        let has = |name: &str| names.contains(&name);
        if has("packed_position") {
            return Err(
                "its splats are packed (compressed PLY); unpack them, for example with: splat-transform in.compressed.ply out.ply"
                    .to_owned(),
            );
        }
        let required = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"];
        let numbered = ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
        let colors = white(element).filter(|_| !has("f_dc_0"));
        let replaced = |name: &str| name.starts_with("f_dc_") && colors.is_some();
        let missing = |name: &&str| !has(name) && !replaced(name);
        let missing: Vec<&str> = required.into_iter().chain(numbered).filter(missing).collect();
        let flat = missing == ["scale_2"];
        if has("x") && numbered.iter().chain(&["opacity"]).all(|name| missing.contains(name)) {
            return Err(
                "it is a point cloud without splats; scale_*, rot_*, opacity and f_dc_* are expected"
                    .to_owned(),
            );
        }
        if !missing.is_empty() && !flat {
            return Err(format!("its splats have no {}; export them whole", missing.join(", ")));
        }
        let rest = (0..).take_while(|k| has(&format!("f_rest_{k}"))).count();
        let all = names.iter().filter(|name| name.starts_with("f_rest_")).count();
        let degree = match rest {
            0 => 0,
            9 => 1,
            24 => 2,
            45 => 3,
            _ => 4,
        };
        if degree > 3 || all != rest {
            return Err(format!(
                "it has {all} properties f_rest_*; 0, 9, 24 or 45 without gaps are expected (degrees 0 to 3)"
            ));
        }
        let mut properties = Vec::new();
        let mut row_bytes = 0;
        for (name, (_, property)) in names.iter().copied().zip(&element.properties) {
            let PropertyType::Scalar(scalar) = &property.data_type else {
                return Err(format!("the property {name} of its splats is a list; remove it"));
            };
            let color = || COLORS.iter().position(|color| *color == name).map(|channel| COLOR + channel);
            let slot = slot(name, rest).or_else(|| colors.and_then(|_| color()));
            properties.push((scalar.clone(), row_bytes, slot));
            row_bytes += scalar_size(scalar);
        }
        Ok(Self { encoding, properties, row_bytes, degree, colors, flat, filtered: has("filter_3D") })
    }

    /// Sentences on what is not read as it stands.
    fn notes(&self) -> Vec<String> {
        let flat = self.flat.then(|| {
            "its splats have two scales, as those of 2D Gaussian Splatting: they are read as flat, without thickness \
             along their third axis"
                .to_owned()
        });
        let filtered = self.filtered.then(|| {
            "its splats have a smoothing filter, as those of Mip-Splatting (filter_3D): it was made a part of their sizes \
             and opacities"
                .to_owned()
        });
        flat.into_iter().chain(filtered).collect()
    }

    /// Splats, and how many could not be used.
    fn read(&self, input: &mut impl BufRead, count: usize) -> Result<Collected, String> {
        let mut collected = Collected::new(self, count.min(FIRST_ROWS));
        let mut slots = [0.0_f64; SLOTS];
        if self.flat {
            slots[SCALE + 2] = f64::NEG_INFINITY;
        }
        let mut bytes = vec![0_u8; self.row_bytes];
        let mut line = String::new();
        for number in 0..count {
            let cut = || format!("it ends after {number} of {count} splats, so it was cut off");
            if self.encoding == Encoding::Ascii {
                line.clear();
                // A line longer than any row of numbers is not read on and on.
                let read = input.by_ref().take(64 * self.properties.len() as u64 + 64).read_line(&mut line);
                if read.map_err(|error| format!("splat {number} is not text ({error})"))? == 0 {
                    return Err(cut());
                }
                self.parse(&line, &mut slots).map_err(|what| format!("splat {number}: {what}"))?;
            } else {
                input.read_exact(&mut bytes).map_err(|_| cut())?;
                self.decode(&bytes, &mut slots);
            }
            collected.push(number as u32, &slots);
        }
        Ok(collected)
    }

    fn parse(&self, line: &str, slots: &mut [f64; SLOTS]) -> Result<(), String> {
        let mut words = line.split_ascii_whitespace();
        for (_, _, slot) in &self.properties {
            let word =
                words.next().ok_or_else(|| format!("{} numbers are expected", self.properties.len()))?;
            if let Some(slot) = slot {
                slots[*slot] = word.parse().map_err(|_| format!("'{word}' is not a number"))?;
            }
        }
        if words.next().is_some() {
            return Err(format!("more than {} numbers in a line", self.properties.len()));
        }
        Ok(())
    }

    fn decode(&self, row: &[u8], slots: &mut [f64; SLOTS]) {
        let swapped = self.encoding == Encoding::BinaryBigEndian;
        for (scalar, offset, slot) in &self.properties {
            if let Some(slot) = slot {
                slots[*slot] = number(&row[*offset..], scalar, swapped);
            }
        }
    }
}

/// Names of colours in place of coefficients.
const COLORS: [&str; 3] = ["red", "green", "blue"];

/// White of the colours of an element, where it has some.
fn white(element: &ElementDef) -> Option<White> {
    let type_of = |name: &str| element.properties.get(name).map(|property| &property.data_type);
    COLORS.iter().all(|name| type_of(name).is_some()).then(|| match type_of(COLORS[0]) {
        Some(PropertyType::Scalar(ScalarType::UChar)) => White::Known(255.0),
        Some(PropertyType::Scalar(ScalarType::UShort)) => White::Known(65_535.0),
        _ => White::ByRange,
    })
}

/// Name of a property without the prefix that CloudCompare gives those that it does not know, unless both are there.
fn own_name<'a>(element: &ElementDef, name: &'a str) -> &'a str {
    let bare = name.strip_prefix("scalar_").or_else(|| name.strip_prefix("scal_"));
    bare.filter(|bare| !element.properties.contains_key(*bare)).unwrap_or(name)
}

/// Slot of a property; that of `f_rest_*` counts coefficients first and channels last, as ours do.
fn slot(name: &str, rest: usize) -> Option<usize> {
    let numbered = |prefix: &str| name.strip_prefix(prefix)?.parse::<usize>().ok();
    match name {
        "x" => return Some(POSITION),
        "y" => return Some(POSITION + 1),
        "z" => return Some(POSITION + 2),
        "opacity" => return Some(OPACITY),
        "filter_3D" => return Some(FILTER),
        _ => {}
    }
    if let Some(k) = numbered("scale_").filter(|k| *k < 3) {
        return Some(SCALE + k);
    }
    if let Some(k) = numbered("rot_").filter(|k| *k < 4) {
        return Some(ROTATION + k);
    }
    if let Some(k) = numbered("f_dc_").filter(|k| *k < 3) {
        return Some(COLOR + k);
    }
    let per_channel = rest / 3;
    numbered("f_rest_").filter(|k| *k < rest).map(|k| REST + 3 * (k % per_channel) + k / per_channel)
}

fn scalar_size(scalar: &ScalarType) -> usize {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

fn number(bytes: &[u8], scalar: &ScalarType, swapped: bool) -> f64 {
    fn take<const N: usize>(bytes: &[u8], swapped: bool) -> [u8; N] {
        let mut taken: [u8; N] = std::array::from_fn(|k| bytes[k]);
        if swapped {
            taken.reverse();
        }
        taken
    }
    match scalar {
        ScalarType::Char => f64::from(bytes[0] as i8),
        ScalarType::UChar => f64::from(bytes[0]),
        ScalarType::Short => f64::from(i16::from_le_bytes(take(bytes, swapped))),
        ScalarType::UShort => f64::from(u16::from_le_bytes(take(bytes, swapped))),
        ScalarType::Int => f64::from(i32::from_le_bytes(take(bytes, swapped))),
        ScalarType::UInt => f64::from(u32::from_le_bytes(take(bytes, swapped))),
        ScalarType::Float => f64::from(f32::from_le_bytes(take(bytes, swapped))),
        ScalarType::Double => f64::from_le_bytes(take(bytes, swapped)),
    }
}

/// Fewest bytes that one element can take.
fn smallest_size(element: &ElementDef, ascii: bool) -> u64 {
    let size = |data_type: &PropertyType| match data_type {
        // A digit and a separator.
        _ if ascii => 2,
        PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => scalar_size(scalar) as u64,
    };
    let bytes: u64 = element.properties.iter().map(|(_, property)| size(&property.data_type)).sum();
    // The last line of a text file may end without its separator.
    bytes.saturating_sub(u64::from(ascii))
}

/// Standard deviations under an isotropic filter, and the share of the opacity that keeps what the splat covers in sum. Source:
/// Mip-Splatting, section 4.1 (3D smoothing filter).
fn filtered(scale: [f32; 3], filter: f32) -> ([f32; 3], f32) {
    if filter == 0.0 {
        return (scale, 1.0);
    }
    let wide = scale.map(|scale| f64::from(scale).hypot(f64::from(filter)));
    let share: f64 = scale.iter().zip(wide).map(|(scale, wide)| f64::from(*scale) / wide).product();
    (wide.map(|scale| scale as f32), share as f32)
}

/// Splats as they are collected, in post-activation form.
struct Collected {
    /// Without centres.
    splats: Splats,
    centres: Vec<[f64; 3]>,
    colors: Option<White>,
    left_out: usize,
}

impl Collected {
    fn new(columns: &Columns, rows: usize) -> Self {
        let mut splats = Splats { sh_degree: columns.degree, ..Splats::default() };
        splats.orientations.reserve(rows);
        splats.scales.reserve(rows);
        splats.sh_coefficients.reserve(rows * 3 * coefficient_count(columns.degree));
        Self { splats, centres: Vec::with_capacity(rows), colors: columns.colors, left_out: 0 }
    }

    fn push(&mut self, row: u32, slots: &[f64; SLOTS]) {
        let splats = &mut self.splats;
        let single = slots.map(|value| value as f32);
        let three = |at: usize| [single[at], single[at + 1], single[at + 2]];
        // Of no thickness where the logarithm is that of 0.
        let scale = three(SCALE).map(f32::exp).map(|scale| if scale.is_subnormal() { 0.0 } else { scale });
        let rotation = std::array::from_fn(|k| single[ROTATION + k]);
        let harmonics = &single[COLOR..COLOR + 3 * coefficient_count(splats.sh_degree)];
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        let filter = single[FILTER];
        let usable = finite(&three(POSITION))
            && finite(&scale)
            && finite(harmonics)
            && !single[OPACITY].is_nan()
            && (0.0..f32::MAX).contains(&filter);
        let Some(rotation) = quaternion::try_normalize(rotation).filter(|_| usable) else {
            self.left_out += 1;
            return;
        };
        self.centres.push([slots[POSITION], slots[POSITION + 1], slots[POSITION + 2]]);
        splats.orientations.push(rotation);
        let (scale, share) = filtered(scale, filter);
        splats.scales.push(scale);
        splats.opacities.push(direct_sigmoid(single[OPACITY]) * share);
        splats.sh_coefficients.extend_from_slice(harmonics);
        splats.occupancies.push(1.0);
        splats.identity_probabilities.push(1.0);
        splats.rows.push(row);
    }

    /// A still scene of one object, labelled by the name of the file. A file of ours may have been turned so that an axis
    /// is up; far scenes of ours have a frame already.
    fn scene(
        self,
        path: &Path,
        (mut frame, turned): (CaptureFrame, Option<UpAxis>),
        mut warnings: Vec<String>,
    ) -> Prims {
        let Self { mut splats, centres, colors, left_out } = self;
        let label =
            path.file_stem().map_or_else(|| "splats".to_owned(), |stem| stem.to_string_lossy().into_owned());
        if left_out > 0 {
            warnings.push(format!(
                "{left_out} splats with values that are not finite, or without a rotation, were left out"
            ));
        }
        if frame.is_identity() && turned.is_none() {
            let bounds = Bounds::around(centres.iter().copied().map(DVec3::from_array));
            if let Some(origin) = origin_of(&bounds, 1.0, &mut warnings) {
                frame.offset = origin.to_array();
            }
            let offset = DVec3::from(frame.offset);
            let near =
                centres.iter().map(|centre| (DVec3::from_array(*centre) - offset).as_vec3().to_array());
            splats.means = near.collect();
        } else {
            splats.means = centres.iter().map(|centre| centre.map(|value| value as f32)).collect();
        }
        if let Some(white) = colors {
            let stride = 3 * coefficient_count(splats.sh_degree);
            let base = || splats.sh_coefficients.chunks_exact(stride).flat_map(|sh| &sh[..3]);
            let white = match white {
                White::Known(white) => white,
                White::ByRange => color_range(base().copied(), &path.display().to_string(), &mut warnings),
            };
            for sh in splats.sh_coefficients.chunks_exact_mut(stride) {
                sh[..3].iter_mut().for_each(|value| *value = (*value / white - 0.5) / BAND_0 as f32);
            }
        }
        match turned {
            Some(UpAxis::Y) => turn_up(&mut splats, UpAxis::Y, UpAxis::Z),
            Some(UpAxis::Z) => turn_up(&mut splats, UpAxis::Z, UpAxis::Y),
            None => {}
        }
        let prims = vec![Prim::still(path.display().to_string(), label, splats)];
        Prims { frame, prims, warnings, ..Prims::default() }
    }
}
