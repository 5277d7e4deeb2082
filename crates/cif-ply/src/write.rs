//! The layout of the 3D Gaussian splatting reference implementation, binary little endian.
//!
//! Per splat 17 + 3 K floats, K = (degree + 1)^2 - 1: x y z, nx ny nz (0), `f_dc_0..2`, `f_rest_*` channel by
//! channel (all of red first), opacity as logit, logarithms of the scales, `rot_0..3` as (w, x, y, z).

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use cif_geometry::spherical_harmonics::coefficient_count;
use cif_output::{NewFile, inside};
use cif_scene::files::{FileError, begins_with, existing_folder, folder_of, target_of};
use cif_scene::{Node, SceneGraph, Splats, UpAxis};

use crate::pose::{turn_up, world_splats};
use crate::{ExportOptions, ExportSummary, PlyError};

/// First comment of our files; marks what may be replaced.
const MARK: &str = concat!("comment cif ", env!("CARGO_PKG_VERSION"));
/// Comments of files whose scene lies elsewhere in the world of its capture: `world = file / scale + offset`. Splats
/// are kept in the scene's own frame, as far from the world's origin single precision would not hold them.
pub(crate) const WORLD_OFFSET: &str = "world offset";
/// See [`WORLD_OFFSET`].
pub(crate) const WORLD_SCALE: &str = "world scale";
/// Comment by which Brush and others record how splats are drawn.
pub(crate) const RENDER_MODE: &str = "SplatRenderMode:";
/// Of [`RENDER_MODE`]: footprints are widened and their opacity lowered in turn (Mip-Splatting).
pub(crate) const RENDER_MODE_MIP: &str = "mip";
/// Comment of files that were turned about the origin of the file so that y is up, from z, or the other way round.
pub(crate) const TURNED: &str = "turned up";
const MARK_PREFIX: &[u8] = b"ply\nformat binary_little_endian 1.0\ncomment cif ";

fn is_ply(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("ply"))
}

/// Checks everything about an output that can be checked before the work starts.
///
/// # Errors
/// As [`export`].
pub fn check_target(path: &Path, options: ExportOptions) -> Result<(), PlyError> {
    let several = options.split || options.sequence;
    if !several {
        return if is_ply(path) { check_file(path, options.force) } else { Err(extension(path)) };
    }
    if is_ply(path) {
        return Err(extension(path));
    }
    if path.exists() && !path.is_dir() {
        return Err(PlyError::InTheWay { path: path.to_owned(), found: "a file", wanted: "a folder" });
    }
    existing_folder(path)?;
    Ok(())
}

fn extension(path: &Path) -> PlyError {
    PlyError::Extension { path: path.to_owned() }
}

fn check_file(path: &Path, force: bool) -> Result<(), PlyError> {
    if path.is_dir() {
        return Err(PlyError::InTheWay { path: path.to_owned(), found: "a folder", wanted: "a file" });
    }
    existing_folder(path)?;
    target_of(path, false)?;
    if path.exists() && !force && !begins_with(path, MARK_PREFIX) {
        return Err(FileError::Foreign { path: path.to_owned() }.into());
    }
    Ok(())
}

/// A file to write.
struct Job<'a> {
    path: PathBuf,
    time_code: f64,
    graph: &'a SceneGraph,
    /// The axis that is up as captured, and in the file.
    up: (UpAxis, UpAxis),
    nodes: Vec<&'a Node>,
}

/// Writes a scene: to the file `path` (`.ply`), or with [`ExportOptions::split`] or [`ExportOptions::sequence`]
/// into the folder `path`, which is created. Each file is written next to its place and renamed.
///
/// # Errors
/// A name that does not fit, a missing folder, files that are not ours (without [`ExportOptions::force`]), nothing
/// visible at that time, disk full.
pub fn export(graph: &SceneGraph, path: &Path, options: ExportOptions) -> Result<ExportSummary, PlyError> {
    check_target(path, options)?;
    let jobs =
        jobs(graph, path, &options).map_err(|source| FileError::Write { path: path.to_owned(), source })?;
    for job in &jobs {
        // Folders that do not exist yet hold nothing.
        if folder_of(&job.path).is_dir() {
            check_file(&job.path, options.force)?;
        }
    }
    let mut summary = ExportSummary {
        path: path.to_owned(),
        nodes: graph.nodes.len(),
        samples: if options.sequence { graph.time_codes.samples.len() } else { 1 },
        ..ExportSummary::default()
    };
    for job in jobs {
        if job.nodes.is_empty() {
            if options.split || options.sequence {
                continue;
            }
            return Err(PlyError::NothingVisible { path: job.path, time_code: job.time_code });
        }
        let failed = |source| FileError::Write { path: job.path.clone(), source };
        fs::create_dir_all(folder_of(&job.path)).map_err(failed)?;
        summary.bytes += write(&job).map_err(failed)?;
        summary.splats += job.nodes.iter().map(|node| node.splats.len()).sum::<usize>();
        summary.files.push(job.path);
    }
    if summary.files.is_empty() {
        let time_code = options.time_code.unwrap_or_else(|| graph.time_codes.start());
        return Err(PlyError::NothingVisible { path: path.to_owned(), time_code });
    }
    Ok(summary)
}

fn jobs<'a>(graph: &'a SceneGraph, path: &Path, options: &ExportOptions) -> io::Result<Vec<Job<'a>>> {
    let at = options.time_code.unwrap_or_else(|| graph.time_codes.start());
    let codes = if options.sequence { graph.time_codes.samples.clone() } else { vec![at] };
    let up = (graph.up_axis, options.turn_up.unwrap_or(graph.up_axis));
    let visible = |code: f64| move |node: &&Node| node.is_visible(code) && !node.splats.is_empty();
    let mut jobs = Vec::new();
    for code in codes {
        let number = format!("{:04}", code.round());
        if options.split {
            for node in graph.nodes.iter().filter(visible(code)) {
                let name =
                    if options.sequence { format!("{}/{number}", node.name) } else { node.name.clone() };
                let path = inside(path, &name, "ply")?;
                jobs.push(Job { path, time_code: code, graph, up, nodes: vec![node] });
            }
        } else {
            let path = if options.sequence { inside(path, &number, "ply")? } else { path.to_owned() };
            let nodes = graph.nodes.iter().filter(visible(code)).collect();
            jobs.push(Job { path, time_code: code, graph, up, nodes });
        }
    }
    Ok(jobs)
}

/// Writes a file through a temporary one in the same folder; its size.
fn write(job: &Job<'_>) -> io::Result<u64> {
    let new = NewFile::create(&job.path)?;
    let mut out = BufWriter::with_capacity(1 << 16, new.file());
    let degree = job.nodes.iter().map(|node| node.splats.sh_degree).max().unwrap_or(0);
    let count = job.nodes.iter().map(|node| node.splats.len()).sum();
    out.write_all(header(count, degree, job).as_bytes())?;
    for node in &job.nodes {
        let mut splats = world_splats(node, job.time_code);
        if job.up.0 != job.up.1 {
            turn_up(&mut splats, job.up.0, job.up.1);
        }
        rows(&mut out, &splats, degree)?;
    }
    out.flush()?;
    drop(out);
    let bytes = new.file().metadata()?.len();
    new.finish()?;
    Ok(bytes)
}

fn header(count: usize, degree: u8, job: &Job<'_>) -> String {
    let Job { time_code, graph, .. } = job;
    let frame = &graph.frame;
    let mut header = format!("ply\nformat binary_little_endian 1.0\n{MARK}\ncomment time code {time_code}\n");
    if graph.antialiased == Some(true) {
        header.push_str(&format!("comment {RENDER_MODE} {RENDER_MODE_MIP}\n"));
    }
    if !frame.is_identity() {
        // The shortest texts that are read back as the same numbers.
        let [x, y, z] = frame.offset;
        header.push_str(&format!(
            "comment {WORLD_OFFSET} {x} {y} {z}\ncomment {WORLD_SCALE} {}\n",
            frame.scale
        ));
    }
    match job.up {
        (UpAxis::Z, UpAxis::Y) => header.push_str(&format!("comment {TURNED} y\n")),
        (UpAxis::Y, UpAxis::Z) => header.push_str(&format!("comment {TURNED} z\n")),
        (UpAxis::Y, UpAxis::Y) | (UpAxis::Z, UpAxis::Z) => {}
    }
    header.push_str(&format!("element vertex {count}\n"));
    let rest = 3 * (coefficient_count(degree) - 1);
    let names = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned).into_iter();
    let numbered = |name: &'static str, count: usize| (0..count).map(move |k| format!("{name}_{k}"));
    let names = names
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", rest))
        .chain(["opacity".to_owned()])
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4));
    for name in names {
        header.push_str("property float ");
        header.push_str(&name);
        header.push('\n');
    }
    header + "end_header\n"
}

fn rows(out: &mut impl Write, splats: &Splats, degree: u8) -> io::Result<()> {
    let held = coefficient_count(splats.sh_degree);
    let written = coefficient_count(degree);
    let mut row: Vec<u8> = Vec::with_capacity(4 * (17 + 3 * (written - 1)));
    for (k, coefficients) in splats.sh_coefficients.chunks_exact(3 * held).enumerate() {
        row.clear();
        let mut put = |value: f32| row.extend_from_slice(&value.to_le_bytes());
        splats.means[k].into_iter().for_each(&mut put);
        [0.0; 3].into_iter().for_each(&mut put);
        coefficients[..3].iter().copied().for_each(&mut put);
        for channel in 0..3 {
            for index in 1..written {
                put(if index < held { coefficients[3 * index + channel] } else { 0.0 });
            }
        }
        put(logit(splats.opacities[k]));
        splats.scales[k].into_iter().map(f32::ln).for_each(&mut put);
        splats.orientations[k].into_iter().for_each(&mut put);
        out.write_all(&row)?;
    }
    Ok(())
}

/// Finite also for 0 and 1.
fn logit(opacity: f32) -> f32 {
    let opacity = f64::from(opacity).clamp(1e-7, 1.0 - 1e-7);
    (opacity / (1.0 - opacity)).ln() as f32
}
