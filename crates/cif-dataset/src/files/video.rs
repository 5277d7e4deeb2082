//! Frames of videos, extracted once by `ffmpeg` into a cache folder.

use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use cif_output::Scratch;

use super::listing;
use crate::Error;

/// Folder inside a capture that holds extracted frames.
const CACHE: &str = ".cif_frames";

/// Frames that are requested of a video.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Extraction {
    /// Most frames, from the start on.
    pub(crate) most: u32,
    /// Width and height that larger frames are reduced to by area averages, pixels; `None` leaves them as they are.
    pub(crate) size: Option<[u32; 2]>,
}

impl Extraction {
    /// Folder of such frames of a video.
    fn folder(self, video: &str) -> String {
        match self.size {
            Some([width, height]) => format!("{video}-{}-{width}x{height}", self.most),
            None => format!("{video}-{}", self.most),
        }
    }
}

/// Frames of a video as PNG files in order (`0000.png`, ...), extracted unless an earlier call did so.
///
/// They lie in `.cif_frames/<stem>-<most>[-<width>x<height>]` inside `root`, or in the system's temporary folder where
/// `root` cannot be written, or somebody else has made that folder. `images` is where a person would put extracted
/// frames (for the message).
///
/// # Errors
/// When ffmpeg is missing or fails.
pub(crate) fn frames(
    root: &Path,
    video: &Path,
    images: &Path,
    extraction: Extraction,
) -> Result<Vec<PathBuf>, Error> {
    frames_with(OsStr::new("ffmpeg"), root, video, images, extraction)
}

fn frames_with(
    ffmpeg: &OsStr,
    root: &Path,
    video: &Path,
    images: &Path,
    extraction: Extraction,
) -> Result<Vec<PathBuf>, Error> {
    cif_input::check(video).map_err(Error::read(video))?;
    let name = extraction.folder(&listing::stem(video));
    let caches =
        [root.join(CACHE), std::env::temp_dir().join(format!("cif_frames_{:016x}", fingerprint(root)))];
    let changed = |path: &Path| std::fs::metadata(path).and_then(|data| data.modified()).ok();
    // Others may have made them, with frames of theirs.
    let trust = [cif_output::check_of_owner(&caches[0], root), cif_output::check_private(&caches[1])];
    for (cache, _) in caches.iter().zip(&trust).filter(|(_, trust)| trust.is_ok()) {
        let folder = cache.join(&name);
        if folder.is_dir() && changed(&folder) >= changed(video) {
            let found = numbered(&folder)?;
            if !found.is_empty() {
                return Ok(found);
            }
        }
    }
    let here = match &trust[0] {
        Err(error) if error.kind() != io::ErrorKind::NotFound => None,
        _ => begun(&caches[0]).ok(),
    };
    let (cache, (scratch, partial)) = match here {
        Some(begun) => (&caches[0], begun),
        None => {
            cif_output::private_folder(&caches[1]).map_err(Error::write(&caches[1]))?;
            (&caches[1], begun(&caches[1]).map_err(Error::write(&caches[1]))?)
        }
    };
    let output = Command::new(ffmpeg)
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(cif_input::for_ffmpeg(video).map_err(Error::read(video))?)
        .args(["-frames:v", &extraction.most.to_string()])
        .args(extraction.size.iter().flat_map(|[width, height]| {
            ["-vf".to_owned(), format!("scale='min(iw,{width})':'min(ih,{height})':flags=area")]
        }))
        .args(["-start_number", "0"])
        // Numbers are put wherever the name has a `%`, the folders included: these are left out of it.
        .arg("%04d.png")
        .current_dir(&partial)
        .output();
    let output = match output {
        Ok(output) => output,
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            return Err(Error::FfmpegMissing { video: video.to_owned(), images: images.to_owned() });
        }
        Err(error) => return Err(Error::Ffmpeg { video: video.to_owned(), problem: error.to_string() }),
    };
    let words = String::from_utf8_lossy(&output.stderr);
    let failed =
        |problem: &str| Error::Ffmpeg { video: video.to_owned(), problem: problem.trim().to_owned() };
    if !output.status.success() {
        // The first lines are the cause, what follows its consequences.
        let causes: Vec<&str> = words.lines().filter(|line| !line.trim().is_empty()).take(3).collect();
        let ended = format!("it gave no reason ({})", output.status);
        return Err(failed(&if causes.is_empty() { ended } else { causes.join("; ") }));
    }
    if listing::images(&partial)?.is_empty() {
        return Err(failed("it holds no frame"));
    }
    let folder = cache.join(&name);
    scratch.replace(&[(partial, folder.clone())], &[]).map_err(Error::write(&folder))?;
    numbered(&folder)
}

/// Extracted frames in order: numbers beyond 9999 have more digits, and so come last.
fn numbered(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = listing::images(folder)?;
    found.sort_by_key(|path| path.as_os_str().len());
    Ok(found)
}

/// An empty folder next to the final one, removed again unless it takes its place.
fn begun(cache: &Path) -> io::Result<(Scratch, PathBuf)> {
    std::fs::create_dir_all(cache)?;
    let scratch = Scratch::inside(cache)?;
    let folder = scratch.folder()?;
    Ok((scratch, folder))
}

/// FNV-1a of the path, so that captures do not share a cache.
fn fingerprint(root: &Path) -> u64 {
    let root = root.canonicalize().unwrap_or_else(|_| root.to_owned());
    root.as_os_str()
        .as_encoded_bytes()
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_ffmpeg_is_named_with_the_way_out() {
        let root = tempfile::tempdir().unwrap();
        let video = root.path().join("cam00.mp4");
        std::fs::write(&video, b"no video").unwrap();
        let error = frames_with(
            OsStr::new("no-such-program-on-any-path"),
            root.path(),
            &video,
            &root.path().join("cam00/images"),
            Extraction { most: 300, size: None },
        )
        .unwrap_err()
        .to_string();
        assert!(error.contains("cam00.mp4") && error.contains("install ffmpeg"), "{error}");
        assert!(error.contains("cam00/images") || error.contains("cam00\\images"), "{error}");
    }

    #[cfg(unix)]
    #[test]
    fn the_cause_of_a_failure_is_shown() {
        use std::os::unix::fs::PermissionsExt;

        let root = tempfile::tempdir().unwrap();
        let video = root.path().join("cam00.mp4");
        std::fs::write(&video, b"no video").unwrap();
        let program = root.path().join("stand-in");
        let script = "#!/bin/sh\necho 'moov atom not found' >&2\necho 'Invalid data' >&2\nexit 1\n";
        std::fs::write(&program, script).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let extraction = Extraction { most: 300, size: None };
        let error =
            frames_with(program.as_os_str(), root.path(), &video, root.path(), extraction).unwrap_err();
        assert!(error.to_string().ends_with("moov atom not found; Invalid data"), "{error}");
    }

    #[cfg(unix)]
    #[test]
    fn names_of_videos_and_folders_have_no_meaning_of_their_own() {
        use std::os::unix::fs::PermissionsExt;

        let outer = tempfile::tempdir().unwrap();
        let program = outer.path().join("stand-in");
        let script = "#!/bin/sh\nfor last; do :; done\necho \"$@\" > 0000.png\necho \"$last\" > 0001.png\n";
        std::fs::write(&program, script).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let root = outer.path().join("50%d");
        std::fs::create_dir(&root).unwrap();
        let extraction = Extraction { most: 3, size: None };
        for name in ["-cam.mp4", "cam:0.mp4", "100%03d.mp4"] {
            let video = root.join(name);
            std::fs::write(&video, b"no video").unwrap();
            let found = frames_with(program.as_os_str(), &root, &video, &root, extraction).unwrap();
            let text = |path: &Path| std::fs::read_to_string(path).unwrap();
            assert!(text(&found[0]).contains(&format!("-i file:{}", video.display())), "{}", text(&found[0]));
            assert_eq!(text(&found[1]).trim(), "%04d.png", "no folder is part of the pattern");
        }
    }

    #[cfg(unix)]
    #[test]
    fn frames_are_extracted_once() {
        use std::os::unix::fs::PermissionsExt;

        let root = tempfile::tempdir().unwrap();
        let video = root.path().join("cam00.mp4");
        std::fs::write(&video, b"no video").unwrap();
        // A stand-in that writes two frames where the last argument points.
        let program = root.path().join("stand-in");
        std::fs::write(
            &program,
            "#!/bin/sh\nfor last; do :; done\nfolder=$(dirname \"$last\")\necho a > \"$folder/0000.png\"\n\
             echo b > \"$folder/0001.png\"\n",
        )
        .unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let images = root.path().join("cam00/images");
        let extraction = Extraction { most: 300, size: Some([9, 5]) };
        let first = frames_with(program.as_os_str(), root.path(), &video, &images, extraction).unwrap();
        assert_eq!(first.len(), 2);
        assert!(first[0].ends_with(".cif_frames/cam00-300-9x5/0000.png"));
        // The second call needs no program.
        let second =
            frames_with(OsStr::new("no-such-program"), root.path(), &video, &images, extraction).unwrap();
        assert_eq!(first, second);
        // Other frames are others.
        let fewer = Extraction { most: 1, ..extraction };
        assert!(frames_with(OsStr::new("no-such-program"), root.path(), &video, &images, fewer).is_err());
        // Anybody may have put other frames there.
        let cache = root.path().join(CACHE);
        std::fs::set_permissions(&cache, std::fs::Permissions::from_mode(0o777)).unwrap();
        assert!(
            frames_with(OsStr::new("no-such-program"), root.path(), &video, &images, extraction).is_err()
        );
    }
}
