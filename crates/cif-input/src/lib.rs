//! Opens the files that people give. Readers take regular files only: opening a named pipe blocks until somebody
//! writes to it, and a device such as `/dev/zero` may never end. Links are followed.
//!
//! Errors do not name the file, as those of [`std::fs`] do not: the readers that call this name it.

use std::ffi::OsString;
use std::fs::{self, File, FileType};
use std::io;
use std::path::Path;

/// Checks that a path names a regular file, and gives its length in bytes. For libraries that open paths themselves.
///
/// # Errors
/// When nothing is there, it may not be looked at, or it is no regular file.
pub fn check(path: impl AsRef<Path>) -> io::Result<u64> {
    let metadata = fs::metadata(path)?;
    if metadata.is_file() {
        return Ok(metadata.len());
    }
    let kind = kind(metadata.file_type());
    Err(io::Error::new(io::ErrorKind::InvalidInput, format!("it is {kind}; a regular file is needed here")))
}

/// Opens a regular file for reading.
///
/// # Errors
/// As [`check`], and when it may not be read.
pub fn open(path: impl AsRef<Path>) -> io::Result<File> {
    check(&path)?;
    File::open(path)
}

/// All bytes of a regular file.
///
/// # Errors
/// As [`open`], and when reading fails.
pub fn read(path: impl AsRef<Path>) -> io::Result<Vec<u8>> {
    check(&path)?;
    fs::read(path)
}

/// The mark of byte order that editors of Windows begin text in UTF-8 with; it is no part of the text.
const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();

/// All bytes of a regular file of text, without a mark of byte order, for parsers that check the encoding themselves.
///
/// # Errors
/// As [`read`].
pub fn read_text(path: impl AsRef<Path>) -> io::Result<Vec<u8>> {
    let mut bytes = read(path)?;
    if bytes.starts_with(BYTE_ORDER_MARK) {
        bytes.drain(..BYTE_ORDER_MARK.len());
    }
    Ok(bytes)
}

/// The text of a regular file, without a mark of byte order.
///
/// # Errors
/// As [`read`], and when it is not UTF-8.
pub fn read_to_string(path: impl AsRef<Path>) -> io::Result<String> {
    String::from_utf8(read_text(path)?)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is no text in UTF-8; save it as that"))
}

/// The name of a file as an argument of ffmpeg: a local file, whatever its name. Bare names are options where they begin
/// with `-`, and protocols where they hold a colon (`clip:1.mp4`).
///
/// # Errors
/// When a relative path has no place, because the working folder is gone.
pub fn for_ffmpeg(path: impl AsRef<Path>) -> io::Result<OsString> {
    let mut name = OsString::from("file:");
    name.push(std::path::absolute(path)?);
    Ok(name)
}

/// Name of a file type other than a regular file, for error messages.
fn kind(found: FileType) -> &'static str {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        if found.is_fifo() {
            return "a named pipe";
        }
        if found.is_socket() {
            return "a socket";
        }
        if found.is_char_device() || found.is_block_device() {
            return "a device";
        }
    }
    if found.is_dir() { "a folder" } else { "something else" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_files_are_read_and_folders_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, "text").unwrap();
        assert_eq!(check(&path).unwrap(), 4);
        assert_eq!(read_to_string(&path).unwrap(), "text");
        assert_eq!(read(&path).unwrap(), b"text");
        assert!(check(folder.path()).unwrap_err().to_string().contains("it is a folder"));
        assert_eq!(open(folder.path().join("none")).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_mark_of_byte_order_is_no_text() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, "\u{feff}{}").unwrap();
        assert_eq!(read_to_string(&path).unwrap(), "{}");
        assert_eq!(read_text(&path).unwrap(), b"{}");
        assert_eq!(read(&path).unwrap().len(), 5, "of other files every byte counts");
        fs::write(&path, b"\xff\xfe{\0}\0").unwrap();
        assert!(read_to_string(&path).unwrap_err().to_string().contains("UTF-8"));
    }

    #[test]
    fn names_for_ffmpeg_are_those_of_files() {
        for name in ["-i.mp4", "clip:1.mp4", "a%03d.mp4"] {
            let given = for_ffmpeg(name).unwrap().into_string().unwrap();
            let path = given.strip_prefix("file:").unwrap();
            assert!(Path::new(path).is_absolute() && path.ends_with(name), "{given}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn what_blocks_or_never_ends_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(&pipe, &link).unwrap();
        for path in [&pipe, &link] {
            assert!(open(path).unwrap_err().to_string().contains("a named pipe"));
        }
        assert!(read("/dev/zero").unwrap_err().to_string().contains("a device"));
    }
}
