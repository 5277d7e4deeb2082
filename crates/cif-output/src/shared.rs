//! Places that others may write into too, such as the folder for temporary files: what lies there under a name of ours may
//! have been put there by anybody.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::Path;

/// Opens a file of our own name to be read and written, and creates it when missing. Its content stays.
///
/// # Errors
/// When a link or another thing that is no plain file has the name, a second name leads to it, or the system refuses.
pub fn open_own(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.create(true).read(true).write(true).truncate(false);
    #[cfg(unix)]
    {
        use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
        options.custom_flags((rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits() as i32);
        let file =
            options.open(path).map_err(|error| if path.is_symlink() { planted("a link") } else { error })?;
        let found = file.metadata()?;
        if !found.is_file() {
            return Err(planted("no plain file"));
        }
        if found.nlink() > 1 {
            return Err(planted("a second name of another file"));
        }
        Ok(file)
    }
    #[cfg(not(unix))]
    {
        if path.is_symlink() {
            return Err(planted("a link"));
        }
        options.open(path)
    }
}

fn planted(kind: &str) -> io::Error {
    io::Error::new(
        io::ErrorKind::InvalidInput,
        format!("it is {kind}, which was put there by something else; remove it"),
    )
}

/// Makes a folder that nobody else reads or writes, with those above it. One that is there must be this user's.
///
/// # Errors
/// When it belongs to somebody else, others may write into it, it is a link, or the system refuses.
pub fn private_folder(path: &Path) -> io::Result<()> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent)?;
    }
    let mut builder = fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    match builder.create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => check_private(path),
        created => created,
    }
}

/// Checks that a folder is this user's alone to write into.
///
/// # Errors
/// As [`private_folder`], and when it is missing.
pub fn check_private(path: &Path) -> io::Result<()> {
    check(path, 0o022, |_| false)
}

/// Checks that a folder inside another one was made by this user or by whoever owns the other one, and that not everybody
/// may write into it.
///
/// # Errors
/// When that is not so, it is a link or missing, or the system refuses.
pub fn check_of_owner(path: &Path, outer: &Path) -> io::Result<()> {
    let outer = fs::metadata(outer)?;
    check(path, 0o002, |found| is_same_owner(found, &outer))
}

/// Checks that a folder is this user's, or is let by, and that nobody else may write into it, by the bits of its mode.
fn check(path: &Path, others: u32, is_let_by: impl FnOnce(&fs::Metadata) -> bool) -> io::Result<()> {
    let found = fs::symlink_metadata(path)?;
    if !found.is_dir() {
        return Err(planted(if found.is_symlink() { "a link" } else { "no folder" }));
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let refused = |problem: &str| io::Error::new(io::ErrorKind::PermissionDenied, problem.to_owned());
        if found.uid() != rustix::process::geteuid().as_raw() && !is_let_by(&found) {
            return Err(refused("it belongs to another user, so what is in it is not taken"));
        }
        if found.mode() & others != 0 {
            return Err(refused("other users may write into it, so what is in it is not taken; remove it"));
        }
    }
    #[cfg(not(unix))]
    let _ = (others, is_let_by);
    Ok(())
}

#[cfg(unix)]
fn is_same_owner(a: &fs::Metadata, b: &fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    a.uid() == b.uid()
}

#[cfg(not(unix))]
fn is_same_owner(_: &fs::Metadata, _: &fs::Metadata) -> bool {
    true
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};

    use super::*;

    #[test]
    fn planted_files_are_not_opened() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("precious"), "precious").unwrap();
        symlink("precious", at("link")).unwrap();
        symlink("missing", at("dangling")).unwrap();
        fs::hard_link(at("precious"), at("second")).unwrap();
        for name in ["link", "dangling", "second"] {
            let error = open_own(&at(name)).unwrap_err().to_string();
            assert!(error.contains("put there by something else"), "{name}: {error}");
        }
        assert_eq!(fs::read_to_string(at("precious")).unwrap(), "precious");
        assert!(!at("missing").exists());
        assert!(open_own(&at("new")).is_ok() && open_own(&at("new")).is_ok());
    }

    #[test]
    fn private_folders_are_this_users_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/cache");
        private_folder(&path).unwrap();
        private_folder(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o700);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(private_folder(&path).unwrap_err().to_string().contains("other users may write"));
        symlink(folder.path(), folder.path().join("link")).unwrap();
        assert!(private_folder(&folder.path().join("link")).is_err());
    }

    #[test]
    fn folders_inside_others_are_this_users_or_those_of_the_owner() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cache");
        fs::create_dir(&path).unwrap();
        let check = || check_of_owner(&path, folder.path()).map_err(|error| error.to_string());
        fs::set_permissions(&path, fs::Permissions::from_mode(0o775)).unwrap();
        assert_eq!(check(), Ok(()));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(check().unwrap_err().contains("other users may write"));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        // Only the administrator can give folders away.
        if rustix::process::geteuid().is_root() {
            std::os::unix::fs::chown(&path, Some(12345), None).unwrap();
            assert!(check().unwrap_err().contains("belongs to another user"));
            assert!(check_private(&path).is_err());
            std::os::unix::fs::chown(folder.path(), Some(12345), None).unwrap();
            assert_eq!(check(), Ok(()), "whoever owns the capture");
            assert!(check_private(&path).is_err());
        }
        let link = folder.path().join("link");
        symlink("cache", &link).unwrap();
        assert!(check_of_owner(&link, folder.path()).unwrap_err().to_string().contains("it is a link"));
    }
}
