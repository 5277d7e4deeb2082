//! The part of `cif export` that writes PLY.

use std::path::PathBuf;

use cif_scene::SceneGraph;
use clap::Args;

use super::query::code_at;
use crate::error::Error;
use crate::output::{self, Outputs};

#[derive(Debug, Args)]
pub(super) struct Ply {
    /// Splats to write in the layout that splat viewers and editors read: the whole scene as it stands at
    /// one moment. With --ply-split or --ply-sequence a folder
    #[arg(long, value_name = "OUT.ply|FOLDER")]
    pub(super) ply: Option<PathBuf>,
    /// Moment of --ply, from 0 (first time) to 1 (last) [default: the first]
    #[arg(long, value_name = "TIME", requires = "ply", conflicts_with = "ply_sequence")]
    ply_time: Option<f64>,
    /// A file per object: FOLDER/red_mug_001.ply
    #[arg(long, requires = "ply")]
    ply_split: bool,
    /// A file per sampled frame: FOLDER/0000.ply; with --ply-split FOLDER/red_mug_001/0000.ply
    #[arg(long, requires = "ply")]
    ply_sequence: bool,
}

impl Ply {
    fn options(&self, force: bool) -> cif_ply::ExportOptions {
        cif_ply::ExportOptions { force, time_code: None, split: self.ply_split, sequence: self.ply_sequence }
    }

    /// Checks the target before the work starts.
    pub(super) fn check(&self, force: bool, outputs: &mut Outputs) -> Result<(), Error> {
        let Some(path) = &self.ply else { return Ok(()) };
        if let Some(time) = self.ply_time
            && !(0.0..=1.0).contains(&time)
        {
            return Err(Error::usage(
                format!("--ply-time {time}: times are normalised"),
                "give a number from 0 (first captured time) to 1 (last)",
            ));
        }
        let folder = self.ply_split || self.ply_sequence;
        let is_ply = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("ply"));
        if folder && is_ply {
            return Err(Error::usage(
                format!("--ply {}: several files go into a folder", path.display()),
                "name a folder, for example --ply splats",
            ));
        }
        if !folder && !is_ply {
            return Err(Error::usage(
                format!("--ply {}: the name does not end in .ply", path.display()),
                "end it in .ply, or write into a folder with --ply-split or --ply-sequence",
            ));
        }
        cif_ply::check_target(path, self.options(force)).map_err(Error::plain)?;
        if folder { output::check_folder(path, force) } else { outputs.file(path) }
    }

    /// Writes the files.
    pub(super) fn write(&self, graph: &SceneGraph, force: bool) -> Result<(), Error> {
        let Some(path) = &self.ply else { return Ok(()) };
        let codes = &graph.time_codes;
        let time_code = self.ply_time.map(|time| code_at(&codes.times, &codes.samples, time));
        let options = cif_ply::ExportOptions { time_code, ..self.options(force) };
        let written = cif_ply::export(graph, path, options).map_err(Error::plain)?;
        let files = written.files.len();
        eprintln!(
            "wrote {}: {}{} splats, {:.1} MB",
            path.display(),
            if files == 1 { String::new() } else { format!("{files} files, ") },
            written.splats,
            written.bytes as f64 / 1e6
        );
        Ok(())
    }
}
