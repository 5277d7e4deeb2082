//! A 2D detector of the user's own: a command that reads frames and writes masks.
//!
//! The command is split into words as a shell splits them, without a shell. In every word `{prompt}`, `{frames}`
//! and `{masks}` are replaced; a command without any of them gets the folder of frames, the folder for masks and the
//! prompt as its last three arguments. The folder of frames holds PNG files named as the frames of the capture
//! (`cam03_0007.png` for `cam03/0007`), at the size and without the lens distortion that the scene was trained with.
//! The command writes masks named alike, one or several per frame (`NAME.png`, `NAME_1.png`, ...), in which black
//! is "not found"; a frame without a mask counts as one where nothing was found. Both folders are temporary.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use cif_dataset::masks::{flat_name, found_masks};

use super::asked::{Asked, Detected, temporary};
use crate::error::Error;
use crate::interrupt;
use crate::mask_query::FoundMasks;
use crate::output::{self, Outputs};
use crate::pictures::save_rgb;

/// Most bytes and lines of a failing command's last words.
const TAIL: (u64, usize) = (4096, 12);

/// Time between two looks whether the command has ended.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Runs a detector on pictures of frames.
///
/// # Errors
/// When the command cannot be split or started, fails (with the end of what it said), or writes no mask of any
/// frame. Nothing is left behind.
pub(super) fn detect(asked: &Asked<'_>, command: &str, prompt: &str) -> Result<Detected, Error> {
    let dataset = asked.dataset;
    let folder = temporary()?;
    let (images, masks) = (folder.path().join("frames"), folder.path().join("masks"));
    for inside in [&images, &masks] {
        std::fs::create_dir(inside).map_err(Error::io("create the folder", inside))?;
    }
    let words = words(command, &images, &masks, prompt)?;
    // Frames of several folders may have one flat name.
    let mut outputs = Outputs::new(false);
    for index in asked.frames {
        let name = flat_name(&dataset.frames[*index].name);
        outputs.picture(&images, &name, "png")?;
        save_rgb(&output::inside(&images, &name, "png")?, &(asked.picture)(*index)?)?;
    }
    run(&words, &folder.path().join("stderr"))?;
    let files = found_masks(dataset, &masks).map_err(|_| {
        Error::failed(
            format!("the detector {} ended well, but wrote no mask of any frame", words[0]),
            "it has to write PNG files named as the frames into the folder {masks}; see cif query --help",
        )
    })?;
    let masks = FoundMasks { files, loaded: true };
    Ok(Detected { masks, boxes: BTreeMap::new(), _folder: Some(folder) })
}

/// The words of a command with its placeholders filled in.
fn words(command: &str, frames: &Path, masks: &Path, prompt: &str) -> Result<Vec<String>, Error> {
    let mut words = shlex::split(command).filter(|words| !words.is_empty()).ok_or_else(|| {
        Error::usage(
            format!("--detector {command}: this is no command"),
            "close the quotes, for example --detector 'python detect.py {prompt} {frames} {masks}'",
        )
    })?;
    let (frames, masks) = (frames.display().to_string(), masks.display().to_string());
    let values = [("{prompt}", prompt), ("{frames}", frames.as_str()), ("{masks}", masks.as_str())];
    if values.iter().any(|(name, _)| command.contains(name)) {
        for word in &mut words {
            *word = fill(word, &values);
        }
    } else {
        words.extend([frames, masks, prompt.to_owned()]);
    }
    Ok(words)
}

/// Replaces placeholders in one pass, so that a prompt that looks like one stays as it is.
fn fill(word: &str, values: &[(&str, &str)]) -> String {
    let (mut filled, mut rest) = (String::new(), word);
    while let Some(at) = rest.find('{') {
        filled.push_str(&rest[..at]);
        rest = &rest[at..];
        match values.iter().find(|(name, _)| rest.starts_with(name)) {
            Some((name, value)) => {
                filled.push_str(value);
                rest = &rest[name.len()..];
            }
            None => {
                filled.push('{');
                rest = &rest[1..];
            }
        }
    }
    filled + rest
}

fn run(words: &[String], said: &Path) -> Result<(), Error> {
    let file = File::create(said).map_err(Error::io("write", said))?;
    let mut child = Command::new(&words[0])
        .args(&words[1..])
        .stdin(Stdio::null())
        // What the command prints must not mix with what cif prints.
        .stdout(Stdio::null())
        .stderr(file)
        .spawn()
        .map_err(|error| {
            Error::failed(
                format!("the detector {} cannot be started: {error}", words[0]),
                "give a program on the PATH, or its full path",
            )
        })?;
    let failed = |error| Error::plain(format!("the detector {} was lost: {error}", words[0]));
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        if interrupt::requested() {
            child.kill().and_then(|()| child.wait()).map_err(failed)?;
            return Err(Error::Interrupted { message: "interrupted".to_owned(), help: None });
        }
        std::thread::sleep(LOOK_EVERY);
    };
    if status.success() {
        return Ok(());
    }
    let end = status.code().map_or("was killed".to_owned(), |code| format!("failed with exit code {code}"));
    let tail = tail(said);
    let message = format!("the detector {} {end}; no masks were read", words[0]);
    Err(if tail.is_empty() {
        Error::failed(message, "it said nothing on stderr; run it by hand on a few frames")
    } else {
        Error::failed(message, format!("it said:\n{tail}"))
    })
}

/// The last lines of a file.
fn tail(path: &Path) -> String {
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL.0)))?;
        let mut bytes = Vec::new();
        file.take(TAIL.0).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    // Last words that cannot be read are no reason to hide the failure itself.
    let text = String::from_utf8_lossy(&read().unwrap_or_default()).into_owned();
    let lines: Vec<&str> = text.trim_end().lines().collect();
    lines[lines.len().saturating_sub(TAIL.1)..].join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(command: &str, prompt: &str) -> Vec<String> {
        words(command, Path::new("/f"), Path::new("/m"), prompt).unwrap()
    }

    #[test]
    fn placeholders_are_filled_without_a_shell() {
        assert_eq!(of("run --in={frames} '{prompt}' {masks}/x", "a; b"), ["run", "--in=/f", "a; b", "/m/x"]);
        assert_eq!(of("run 'my script.py'", "steel jug"), ["run", "my script.py", "/f", "/m", "steel jug"]);
        assert_eq!(of("run {prompt} {other}", "{masks} {"), ["run", "{masks} {", "{other}"]);
        assert!(words("run 'open", Path::new("f"), Path::new("m"), "x").is_err());
        assert!(words("", Path::new("f"), Path::new("m"), "x").is_err());
    }

    #[test]
    fn last_words_are_few() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("said");
        std::fs::write(&path, (0..2000).map(|k| format!("line {k}\n")).collect::<String>()).unwrap();
        let tail = tail(&path);
        assert!(tail.starts_with("line 1988") && tail.ends_with("line 1999"), "{tail}");
    }
}
