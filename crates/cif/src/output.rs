//! Output files and folders: checked before the work starts, written whole or not at all.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use cif_output::{Place, folder_of};

use crate::error::Error;

/// Files that a command reads and files that it is about to write: none may be both, and none may be written twice.
#[derive(Debug)]
pub struct Outputs {
    overwrite: bool,
    read: BTreeMap<PathBuf, PathBuf>,
    written: BTreeMap<PathBuf, PathBuf>,
}

impl Outputs {
    /// Nothing yet. With `overwrite` existing files may be replaced; inputs never.
    #[must_use]
    pub fn new(overwrite: bool) -> Self {
        Self { overwrite, read: BTreeMap::new(), written: BTreeMap::new() }
    }

    /// Adds an input.
    ///
    /// # Errors
    /// When it is an output already.
    pub fn reads(&mut self, path: &Path) -> Result<(), Error> {
        let real = real(path);
        if let Some(output) = self.written.get(&real) {
            return Err(is_input(output));
        }
        self.read.insert(real, path.to_owned());
        Ok(())
    }

    /// Adds the files of a capture as inputs.
    ///
    /// # Errors
    /// When one is an output already.
    pub fn reads_capture(&mut self, dataset: &cif_dataset::Dataset) -> Result<(), Error> {
        dataset.files().try_for_each(|path| self.reads(path))
    }

    /// Adds a file to write, and checks that it can be written.
    ///
    /// # Errors
    /// When it is an input or another output, and as [`check_file`].
    pub fn file(&mut self, path: &Path) -> Result<(), Error> {
        self.add(path)?;
        check_file(path, self.overwrite)
    }

    /// Adds a text to write, which may also go to a terminal, a pipe or a device such as `/dev/null`.
    ///
    /// # Errors
    /// As [`Outputs::file`].
    pub fn text(&mut self, path: &Path) -> Result<(), Error> {
        if matches!(cif_output::place(path), Ok(Place::Stream(_))) { Ok(()) } else { self.file(path) }
    }

    /// Adds the picture of a frame or view, `folder/name.extension`, whose folders need not exist yet.
    ///
    /// # Errors
    /// When the name leads out of the folder, or the file is an input or another output.
    pub fn picture(&mut self, folder: &Path, name: &str, extension: &str) -> Result<(), Error> {
        let path = inside(folder, name, extension)?;
        self.add(&path)
    }

    /// Adds a file to write that is checked elsewhere.
    ///
    /// # Errors
    /// When it is an input or another output.
    pub fn add(&mut self, path: &Path) -> Result<(), Error> {
        let real = real(path);
        if self.read.contains_key(&real) {
            return Err(is_input(path));
        }
        match self.written.insert(real, path.to_owned()) {
            None => Ok(()),
            Some(other) if other == path => Err(Error::failed(
                format!("{} would be written twice", path.display()),
                "give the outputs, or the views, names of their own",
            )),
            Some(other) => Err(Error::failed(
                format!(
                    "{} and {} are one file, which would be written twice",
                    other.display(),
                    path.display()
                ),
                "give the outputs names of their own",
            )),
        }
    }
}

fn is_input(path: &Path) -> Error {
    Error::usage(
        format!("{} is read by this command, so it is not written", path.display()),
        "name another file; inputs are kept, also with --force",
    )
}

/// The file that a path leads to: links followed, as far as there is anything.
fn real(path: &Path) -> PathBuf {
    let target = match cif_output::place(path) {
        Ok(Place::File(target) | Place::Stream(target)) => target,
        Err(_) => path.to_owned(),
    };
    let absolute = std::path::absolute(&target).unwrap_or(target);
    let known = absolute.ancestors().find_map(|ancestor| Some((ancestor, ancestor.canonicalize().ok()?)));
    match known {
        Some((ancestor, real)) => match absolute.strip_prefix(ancestor) {
            Ok(rest) if !rest.as_os_str().is_empty() => real.join(rest),
            _ => real,
        },
        None => absolute,
    }
}

/// True where an output goes to the standard output, where nothing else is printed then.
#[must_use]
pub fn is_stdout(path: &Path) -> bool {
    ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"].iter().any(|name| path == Path::new(name))
}

/// The path of the picture of a frame or view in a folder.
///
/// # Errors
/// When the name leads out of the folder.
pub fn inside(folder: &Path, name: &str, extension: &str) -> Result<PathBuf, Error> {
    cif_output::inside(folder, name, extension).map_err(|error| {
        Error::failed(
            format!("{error}, so no file in {} can have it", folder.display()),
            "name frames and views by paths inside their folder",
        )
    })
}

/// Checks that `path` can be written and that nothing there would be lost. A link leads to the file that is written.
///
/// # Errors
/// When the folder is missing or refuses files, when `path` is a folder or no regular file, or exists without
/// `overwrite`.
pub fn check_file(path: &Path, overwrite: bool) -> Result<(), Error> {
    if path.is_dir() {
        return Err(Error::failed(
            format!("{} is a folder; a file is to be written there", path.display()),
            format!("name a file, for example {}", path.join("scene.cif").display()),
        ));
    }
    let target = match cif_output::target(path) {
        Ok(target) => target,
        // Files can be no folders; refused below.
        Err(error) if error.kind() == io::ErrorKind::NotADirectory => path.to_owned(),
        Err(error) => {
            return Err(Error::failed(
                format!("{} cannot be written: {error}", path.display()),
                "choose another name",
            ));
        }
    };
    if target.exists() && !overwrite {
        return Err(Error::failed(
            format!("{} exists and is not overwritten", path.display()),
            "give --force to replace it, or choose another name",
        ));
    }
    let folder = folder_of(&target);
    if !folder.is_dir() {
        return Err(Error::failed(
            format!("the folder {} for {} does not exist", folder.display(), path.display()),
            format!("create it first: mkdir -p {}", folder.display()),
        ));
    }
    probe(&folder)
}

/// Creates `path` as a folder to write into; one that holds files already needs `overwrite`.
///
/// # Errors
/// When it cannot be created or written, or holds files and `overwrite` is off.
pub fn check_folder(path: &Path, overwrite: bool) -> Result<(), Error> {
    if path.exists() && !path.is_dir() {
        return Err(Error::failed(
            format!("{} is a file; a folder is to be written there", path.display()),
            "choose another name with -o",
        ));
    }
    if !path.exists() {
        // A folder that nothing can be written into is not made either.
        check_new_folder(path)?;
        fs::create_dir_all(path).map_err(Error::io("create the folder", path))?;
    }
    let mut entries = fs::read_dir(path).map_err(Error::io("read the folder", path))?;
    if entries.next().is_some() && !overwrite {
        return Err(Error::failed(
            format!("the folder {} is not empty; files in it could be overwritten", path.display()),
            "give --force to write into it all the same, or choose another folder",
        ));
    }
    probe(path)
}

/// Checks that a new folder can be made at `path`, which stays as it is: what its parent lacks is made when it is written.
///
/// # Errors
/// When the nearest folder that is there refuses files.
pub fn check_new_folder(path: &Path) -> Result<(), Error> {
    let path = std::path::absolute(path).map_err(Error::io("find", path))?;
    let parent = path.ancestors().skip(1).find(|ancestor| ancestor.exists());
    parent.map_or(Ok(()), probe)
}

/// Writes a whole file; a failure leaves the old one, a link stays one, and streams are written to.
///
/// # Errors
/// When the file system refuses, for example because the disk is full.
pub fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    cif_output::write(path, bytes).map_err(Error::io("write", path))
}

/// Saves what its own place refuses in the folder for temporary files. Others may write into that folder: the name is
/// random, and nothing that is there is followed or replaced. A failure leaves nothing there.
///
/// # Errors
/// When that folder refuses it, too.
pub fn rescue<E: From<Error>>(path: &Path, save: impl FnOnce(&Path) -> Result<(), E>) -> Result<PathBuf, E> {
    let folder = std::env::temp_dir();
    let refused = Error::io("write to", &folder);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let file = tempfile::Builder::new().prefix("rescued-").suffix(&format!("-{name}")).tempfile();
    let file = match file {
        Ok(file) => file.into_temp_path(),
        Err(error) => return Err(refused(error).into()),
    };
    save(&file)?;
    file.keep().map_err(|error| refused(error.error).into())
}

/// A file that is written piece by piece, to a temporary one in the same folder, which is removed when this is
/// dropped.
pub(crate) struct NewFile {
    path: PathBuf,
    new: cif_output::NewFile,
}

impl NewFile {
    /// # Errors
    /// When the file system refuses.
    pub(crate) fn create(path: &Path) -> Result<Self, Error> {
        let new = cif_output::NewFile::create(path).map_err(Error::io("write to the folder of", path))?;
        Ok(Self { path: path.to_owned(), new })
    }

    /// The temporary file.
    pub(crate) fn file(&self) -> &File {
        self.new.file()
    }

    /// Puts the file in its place, where it replaces an older one.
    ///
    /// # Errors
    /// When the file system refuses.
    pub(crate) fn finish(self) -> Result<(), Error> {
        self.new.finish().map_err(Error::io("write", &self.path))
    }
}

fn probe(folder: &Path) -> Result<(), Error> {
    cif_output::probe(folder).map_err(|source| {
        Error::failed(
            format!("cannot write to the folder {}: {source}", folder.display()),
            "check its permissions and the free space, or choose another folder",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn existing_files_need_force() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        check_file(&path, false).unwrap();
        write_file(&path, b"one").unwrap();
        assert!(check_file(&path, false).unwrap_err().to_string().contains("a.cif exists"));
        check_file(&path, true).unwrap();
        write_file(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    }

    #[test]
    fn missing_folders_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let error = check_file(&folder.path().join("no/where.cif"), true).unwrap_err();
        assert!(error.to_string().contains("does not exist"), "{error}");
    }

    #[test]
    fn folders_with_files_need_force() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("pictures");
        check_folder(&target, false).unwrap();
        fs::write(target.join("x"), "x").unwrap();
        assert!(check_folder(&target, false).is_err());
        check_folder(&target, true).unwrap();
        assert!(check_folder(&target.join("x"), true).unwrap_err().to_string().contains("is a file"));
    }

    #[test]
    fn inputs_are_no_outputs() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("t.cif");
        fs::write(&scene, "precious").unwrap();
        let mut outputs = Outputs::new(true);
        outputs.reads(&scene).unwrap();
        let error = outputs.file(&folder.path().join("./t.cif")).unwrap_err();
        assert!(error.to_string().contains("t.cif is read by this command"), "{error}");
        #[cfg(unix)]
        {
            let link = folder.path().join("link.cif");
            std::os::unix::fs::symlink("t.cif", &link).unwrap();
            assert!(outputs.file(&link).is_err());
        }
        // The reverse: the inputs are known later.
        let late = folder.path().join("late.json");
        outputs.file(&late).unwrap();
        assert!(outputs.reads(&late).is_err());
    }

    #[test]
    fn nothing_is_written_twice() {
        let folder = tempfile::tempdir().unwrap();
        let mut outputs = Outputs::new(true);
        outputs.picture(&folder.path().join("rgb"), "0001", "png").unwrap();
        outputs.picture(&folder.path().join("depth"), "0001", "png").unwrap();
        let error = outputs.picture(&folder.path().join("rgb"), "0001", "png").unwrap_err();
        assert!(error.to_string().contains("twice"), "{error}");
        let error = outputs.picture(folder.path(), "../0001", "png").unwrap_err();
        assert!(error.to_string().contains("../0001"), "{error}");
    }

    #[cfg(unix)]
    #[test]
    fn only_texts_go_to_devices() {
        let null = Path::new("/dev/null");
        let mut outputs = Outputs::new(false);
        outputs.text(null).unwrap();
        outputs.text(null).unwrap();
        assert!(check_file(null, true).unwrap_err().to_string().contains("not a regular file"));
    }

    #[test]
    fn rescued_files_have_names_that_nobody_guesses() {
        let write = |path: &Path| fs::write(path, "a scene").map_err(Error::io("write", path));
        let [first, second] = [0, 1].map(|_| rescue(Path::new("far/table.cif"), write).unwrap());
        let name = first.file_name().unwrap().to_string_lossy().into_owned();
        assert!(name.starts_with("rescued-") && name.ends_with("-table.cif"), "{name}");
        assert_ne!(first, second);
        for path in [first, second] {
            assert_eq!(fs::read(&path).unwrap(), b"a scene");
            fs::remove_file(path).unwrap();
        }
    }

    #[test]
    fn a_rescue_that_fails_leaves_nothing() {
        let mut tried = PathBuf::new();
        let full = rescue(Path::new("far/table.cif"), |path| {
            assert!(path.is_file());
            tried = path.to_owned();
            Err(Error::plain("the disk is full"))
        });
        assert_eq!(full.unwrap_err().to_string(), "the disk is full");
        assert!(!tried.as_os_str().is_empty() && !tried.exists());
    }
}
