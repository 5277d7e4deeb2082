//! Films of rendered views, made by ffmpeg.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use cif_output::{Scratch, folder_of, target};

use crate::endings;
use crate::error::Error;

/// Colours and quality of a film, by its ending: what ffmpeg takes unasked is either too coarse or plays nowhere.
fn coding(ending: &str) -> &'static [&'static str] {
    const EVEN: &str = "crop=trunc(iw/2)*2:trunc(ih/2)*2";
    match ending {
        "gif" => &["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse", "-loop", "0"],
        "webm" => &["-vf", EVEN, "-pix_fmt", "yuv420p", "-c:v", "libvpx-vp9", "-b:v", "0", "-crf", "24"],
        "avi" => &["-vf", EVEN, "-c:v", "mpeg4", "-q:v", "3"],
        _ => {
            &["-vf", EVEN, "-pix_fmt", "yuv420p", "-c:v", "libx264", "-crf", "16", "-movflags", "+faststart"]
        }
    }
}

/// A film that takes one PNG after the other; nothing is at its place before it is whole.
pub(super) struct FilmFile {
    child: Child,
    input: Option<ChildStdin>,
    scratch: Scratch,
    written: PathBuf,
    target: PathBuf,
}

impl FilmFile {
    /// Starts ffmpeg.
    ///
    /// # Errors
    /// When there is none, or no file can be made at `path`.
    pub(super) fn create(path: &Path, per_second: f64) -> Result<Self, Error> {
        let target = target(path).map_err(Error::io("write", path))?;
        let scratch = Scratch::inside(&folder_of(&target)).map_err(Error::io("write", path))?;
        let ending = endings::ending(path);
        let written = scratch.file(&ending);
        let mut command = Command::new("ffmpeg");
        command
            .args([
                "-hide_banner",
                "-loglevel",
                "error",
                "-y",
                "-f",
                "image2pipe",
                "-c:v",
                "png",
                "-framerate",
            ])
            .arg(per_second.to_string())
            .args(["-i", "-"])
            .args(coding(&ending))
            .arg(&written)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|error| {
            Error::failed(
                format!("films are made by ffmpeg, which cannot be started: {error}"),
                "install it (apt install ffmpeg, brew install ffmpeg, winget install ffmpeg), or name a folder of \
                 pictures: -o views",
            )
        })?;
        let input = child.stdin.take();
        Ok(Self { child, input, scratch, written, target })
    }

    /// The next picture.
    ///
    /// # Errors
    /// When ffmpeg has failed.
    pub(super) fn add(&mut self, png: &[u8]) -> Result<(), Error> {
        let written = self.input.as_mut().map(|input| input.write_all(png));
        match written {
            Some(Ok(())) => Ok(()),
            _ => Err(self.failure()),
        }
    }

    /// Puts the film in its place.
    ///
    /// # Errors
    /// When ffmpeg fails.
    pub(super) fn finish(mut self) -> Result<(), Error> {
        drop(self.input.take());
        match self.child.wait() {
            Ok(status) if status.success() => {
                let Self { scratch, written, target, .. } = self;
                scratch.replace(&[(written, target.clone())], &[]).map_err(Error::io("write", &target))
            }
            _ => Err(self.failure()),
        }
    }

    fn failure(&mut self) -> Error {
        drop(self.input.take());
        let mut words = String::new();
        if let Some(mut errors) = self.child.stderr.take() {
            drop(std::io::Read::read_to_string(&mut errors, &mut words));
        }
        drop(self.child.wait());
        let words = words.lines().next().unwrap_or("it ended early").to_owned();
        Error::failed(
            format!("{}: ffmpeg fails: {words}", self.target.display()),
            "name a folder of pictures instead: -o views",
        )
    }
}
