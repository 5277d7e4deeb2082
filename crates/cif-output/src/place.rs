//! Where an output goes once links are followed.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Links that may be followed one after the other, as the kernel of Linux has it.
const MAX_LINKS: u32 = 40;

/// Where the bytes of an output go.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A regular file, or one that does not exist yet. It is replaced by a new file of that name.
    File(PathBuf),
    /// A terminal, a pipe, `/dev/null`, or an open file of the process such as `/dev/stdout`. It is written to, and
    /// never replaced.
    Stream(PathBuf),
}

/// Folder of a file; `.` for a bare name.
#[must_use]
pub fn folder_of(path: &Path) -> PathBuf {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
        _ => PathBuf::from("."),
    }
}

/// Follows links, also to files that do not exist yet: a link that is written to stays a link.
///
/// # Errors
/// When a folder, a disk or another thing that is no file is there, or links lead in a circle.
pub fn place(path: &Path) -> io::Result<Place> {
    let mut path = path.to_owned();
    for _ in 0..MAX_LINKS {
        match fs::symlink_metadata(&path) {
            Ok(found) if found.is_symlink() => {
                if is_descriptor(&path) {
                    return Ok(Place::Stream(path));
                }
                path = folder_of(&path).join(fs::read_link(&path)?);
            }
            Ok(found) if found.is_file() => return Ok(Place::File(path)),
            Ok(found) if found.is_dir() => {
                return Err(io::Error::new(io::ErrorKind::IsADirectory, "it is a folder"));
            }
            Ok(found) if is_stream(&found) => return Ok(Place::Stream(path)),
            Ok(_) => return Err(not_regular()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Place::File(path)),
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::new(io::ErrorKind::InvalidInput, "its links lead in a circle"))
}

/// The file that an output is written to; a link is followed and stays.
///
/// # Errors
/// As [`place`], and for streams.
pub fn target(path: &Path) -> io::Result<PathBuf> {
    match place(path)? {
        Place::File(target) => Ok(target),
        Place::Stream(_) => Err(not_regular()),
    }
}

fn not_regular() -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file")
}

/// True where a link stands for an open file of a process: what it points to may be anything, and has readers.
fn is_descriptor(link: &Path) -> bool {
    fs::canonicalize(folder_of(link)).is_ok_and(|folder| {
        folder == Path::new("/dev/fd") || (folder.starts_with("/proc") && folder.ends_with("fd"))
    })
}

#[cfg(unix)]
fn is_stream(found: &fs::Metadata) -> bool {
    use std::os::unix::fs::FileTypeExt;
    found.file_type().is_char_device() || found.file_type().is_fifo()
}

#[cfg(not(unix))]
fn is_stream(_: &fs::Metadata) -> bool {
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bare_names_lie_here() {
        assert_eq!(folder_of(Path::new("a.glb")), Path::new("."));
        assert_eq!(folder_of(Path::new("b/a.glb")), Path::new("b"));
        assert!(place(Path::new(".")).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_to_their_end() {
        use std::os::unix::fs::symlink;

        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        symlink("second", at("first")).unwrap();
        symlink(at("file"), at("second")).unwrap();
        symlink("round", at("round")).unwrap();
        // Nothing is there yet, as with a redirection of a shell.
        assert_eq!(place(&at("first")).unwrap(), Place::File(at("file")));
        fs::write(at("file"), "x").unwrap();
        assert_eq!(place(&at("first")).unwrap(), Place::File(at("file")));
        assert!(place(&at("round")).unwrap_err().to_string().contains("circle"));
        symlink(folder.path(), at("up")).unwrap();
        assert_eq!(place(&at("up")).unwrap_err().kind(), io::ErrorKind::IsADirectory);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn devices_and_descriptors_are_streams() {
        assert_eq!(place(Path::new("/dev/null")).unwrap(), Place::Stream("/dev/null".into()));
        assert!(matches!(place(Path::new("/dev/stdout")).unwrap(), Place::Stream(_)));
        assert!(matches!(place(Path::new("/proc/self/fd/1")).unwrap(), Place::Stream(_)));
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("socket");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        assert!(place(&socket).unwrap_err().to_string().contains("not a regular file"));
    }
}
