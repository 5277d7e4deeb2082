//! Runs of ffmpeg over the frames of a video, as versions 4.2 to 9 take them.

use std::ffi::OsStr;
use std::io::{self, Read};
use std::process::Command;

use crate::child;
use crate::source::Source;
use crate::{Error, Hooks};

/// Lines of errors that are shown.
const SHOWN: usize = 3;

/// Longer lines are cut, bytes.
const LONGEST: usize = 240;

/// A pass of ffmpeg over all frames of a video in order, none doubled and none dropped.
pub(super) struct Pass<'a> {
    pub(super) program: &'a OsStr,
    pub(super) source: &'a Source,
    pub(super) filter: &'a str,
    /// Format of what goes into the pipe.
    pub(super) output: &'a [&'a str],
}

/// Runs a pass, and gives what ffmpeg writes to `read`. Its lines, each with its level (`[info]`, `[error]`), go to `line`.
/// Where `read` has `enough`, ffmpeg ends early.
///
/// # Errors
/// When there is no ffmpeg, it fails before `read` has enough, or the caller stops.
pub(super) fn run<T: Send>(
    pass: &Pass<'_>,
    hooks: &Hooks<'_>,
    mut line: impl FnMut(&str) + Send,
    mut read: impl FnMut(&mut dyn Read) -> io::Result<T> + Send,
    enough: impl Fn(&T) -> bool,
) -> Result<T, Error> {
    let Pass { program, source, filter, output } = *pass;
    let shown = source.path.display();
    let name = cif_input::for_ffmpeg(&source.path).map_err(Error::io("read", &source.path))?;
    // `-fps_mode` is known from 5.1 on, `-vsync` until 7.
    for mode in ["-fps_mode", "-vsync"] {
        let mut command = Command::new(program);
        // Levels of lines separate errors from the rest; colours of terminals would be in the way.
        command.env("AV_LOG_FORCE_NOCOLOR", "1").env_remove("AV_LOG_FORCE_COLOR");
        command.args(["-nostdin", "-hide_banner", "-nostats", "-loglevel", "level+info", "-i"]);
        command.arg(&name).args(["-an", "-sn", "-dn", "-vf", filter, mode, "passthrough"]);
        command.args(output).arg("-");
        let mut errors = Vec::new();
        let lines = |text: &str| {
            line(text);
            errors.extend(error_of(text).filter(|_| errors.len() < 100));
        };
        let answer =
            child::run_reading(&mut command, b"", hooks.should_stop, lines, &mut read)?.ok_or_else(|| {
                Error::refused(
                    format!("{shown}: videos are read by ffmpeg, which is not installed or not on the PATH"),
                    "install it (apt install ffmpeg, brew install ffmpeg, winget install ffmpeg), or give a folder \
                     of extracted frames",
                )
            })?;
        if answer.succeeded() || enough(&answer.output) {
            return Ok(answer.output);
        }
        if mode == "-fps_mode" && errors.iter().any(|error| error.contains("fps_mode")) {
            continue;
        }
        if errors.is_empty() {
            errors.push(child::ending(answer.status));
            errors.extend(answer.last_words.lines().last().map(str::to_owned));
        }
        return Err(failed(source, &errors));
    }
    Err(failed(source, &["it knows neither -fps_mode nor -vsync".to_owned()]))
}

/// The text of a line of an error, without the part of ffmpeg and its address.
fn error_of(line: &str) -> Option<String> {
    let (_, text) = line.split_once("[error] ").or_else(|| line.split_once("[fatal] "))?;
    let text = text.trim();
    let end = (0..=LONGEST.min(text.len())).rev().find(|end| text.is_char_boundary(*end))?;
    let cut = if end < text.len() { " ..." } else { "" };
    (!text.is_empty()).then(|| format!("{}{cut}", &text[..end]))
}

/// The failure of ffmpeg by its errors, in their order: the first is the cause, what follows its consequences.
fn failed(source: &Source, errors: &[String]) -> Error {
    let shown = source.path.display();
    let mut causes: Vec<&str> = Vec::new();
    for error in errors.iter().map(String::as_str) {
        if !causes.contains(&error) && causes.len() < SHOWN {
            causes.push(error);
        }
    }
    let words = causes.join("; ");
    let holds_none = ["does not contain any stream", "matches no streams", "Invalid data found"];
    if holds_none.iter().any(|sign| words.contains(sign)) {
        Error::refused(
            format!("{shown}: ffmpeg finds no pictures in it: {words}"),
            "give a video file, or a folder of photographs",
        )
    } else {
        Error::refused(
            format!("{shown}: ffmpeg fails: {words}"),
            "check the video, as with ffmpeg -i VIDEO -f null -, or extract its frames by hand",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_the_lines_of_that_level_without_addresses() {
        let line = "[h264 @ 0x55aa01450f40] [error] no frame!";
        assert_eq!(error_of(line).as_deref(), Some("no frame!"));
        assert_eq!(error_of("[fatal] Error splitting the argument list").as_deref().map(str::len), Some(33));
        assert_eq!(error_of("[info] Conversion failed!"), None);
        let long = error_of(&format!("[error] {}", "é".repeat(300))).unwrap();
        assert!(long.ends_with(" ...") && long.len() < 260, "{long}");
    }

    #[test]
    fn the_first_causes_are_shown() {
        let source = Source { camera: "a".into(), path: "walk.mp4".into(), photographs: None };
        let errors = ["moov atom not found", "moov atom not found", "b", "c", "d"].map(str::to_owned);
        let message = failed(&source, &errors).to_string();
        assert!(message.ends_with("ffmpeg fails: moov atom not found; b; c"), "{message}");
    }
}
