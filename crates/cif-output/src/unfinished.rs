//! Temporary files next to the outputs that they become.

use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::place::{Place, folder_of, place, target};

/// Beginning of the names of temporary files; a random part, `@` and the name of this machine follow, without dots. Files that
/// belong to one of them have its name, a dot and any suffix.
const PREFIX: &str = ".cif-tmp-";

/// Age at which a file that another machine has left is removed: its locks may not be seen here, and clocks differ. Nobody
/// takes that long to write a file; chosen.
const LEFT_ELSEWHERE: Duration = Duration::from_secs(24 * 3600);

/// End of the names of temporary files of this machine; elsewhere than on Unix the same on all.
fn of_this_machine() -> String {
    #[cfg(unix)]
    let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
    #[cfg(not(unix))]
    let name = String::new();
    format!("@{}", name.replace(|letter: char| !letter.is_ascii_alphanumeric(), "-"))
}

/// Temporary files of this process, and the folders that were rid of those of dead ones. Whoever creates, renames or
/// removes one holds the lock, so that [`abandon`] meets none in between.
static LIVE: Mutex<Live> =
    Mutex::new(Live { files: BTreeSet::new(), others: BTreeSet::new(), swept: BTreeSet::new() });

struct Live {
    files: BTreeSet<PathBuf>,
    /// Files and folders by other names that go with the process: [`Removed`].
    others: BTreeSet<PathBuf>,
    swept: BTreeSet<PathBuf>,
}

fn live() -> MutexGuard<'static, Live> {
    LIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes everything that this process has not finished writing. Whoever writes on waits for ever: the process is to
/// end next.
pub fn abandon() {
    let mut live = live();
    for path in std::mem::take(&mut live.files) {
        remove(&path);
    }
    for path in std::mem::take(&mut live.others) {
        remove_other(&path);
    }
    // Never unlocked again.
    std::mem::forget(live);
}

/// A file or folder of this process that is removed when this is dropped, and by [`abandon`].
#[derive(Debug)]
pub struct Removed(PathBuf);

impl Removed {
    /// From here on a path goes with the process.
    #[must_use]
    pub fn new(path: PathBuf) -> Self {
        live().others.insert(path.clone());
        Self(path)
    }

    /// The path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Removed {
    fn drop(&mut self) {
        let mut live = live();
        if live.others.remove(&self.0) {
            remove_other(&self.0);
        }
    }
}

/// Removes a file or folder, as far as the system lets it be.
fn remove_other(path: &Path) {
    let is_folder = fs::symlink_metadata(path).is_ok_and(|found| found.is_dir());
    let _ = if is_folder { fs::remove_dir_all(path) } else { fs::remove_file(path) };
}

/// Bytes that are written to see that a disk is not full: a block, for an empty file may need none.
const BLOCK: [u8; 4096] = [0; 4096];

/// Checks that files can be created and written in `folder`.
///
/// # Errors
/// Error of the system.
pub fn probe(folder: &Path) -> io::Result<()> {
    Unfinished::create(folder)?.file.write_all(&BLOCK)
}

/// Writes a whole file. An existing file is replaced once the new one is on the disk, behind links that stay; streams
/// are written to, and one whose reader has left is none's loss.
///
/// # Errors
/// When the file system refuses; what was there stays.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match place(path)? {
        Place::File(target) => {
            let new = NewFile::at(target)?;
            new.file().write_all(bytes)?;
            new.finish()
        }
        // Behind what is there: an open file may be a regular one that the shell writes to.
        Place::Stream(stream) => match OpenOptions::new().append(true).open(stream)?.write_all(bytes) {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
            done => done,
        },
    }
}

/// A locked file with a random name, removed when dropped.
struct Unfinished {
    path: PathBuf,
    file: File,
}

impl Unfinished {
    fn create(folder: &Path) -> io::Result<Self> {
        let mut live = live();
        if live.swept.insert(folder.to_owned()) {
            sweep(folder);
        }
        let mut builder = tempfile::Builder::new();
        let machine = of_this_machine();
        builder.prefix(PREFIX).suffix(&machine).rand_bytes(12);
        // Temporary files are private by default; the result should have ordinary permissions. Errors are those of the
        // system, for the temporary name says nothing to anybody.
        let create = |path: &Path| OpenOptions::new().read(true).write(true).create_new(true).open(path);
        loop {
            let (file, path) = builder.make_in(folder, create)?.keep().map_err(|error| error.error)?;
            // Another process may have taken it for a dead one's before it was locked, and removes it. Where the file
            // system has no locks nobody can, and nobody does.
            let taken = matches!(file.try_lock(), Err(fs::TryLockError::WouldBlock));
            if !taken && path.exists() {
                live.files.insert(path.clone());
                return Ok(Self { path, file });
            }
        }
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        let mut live = live();
        if live.files.remove(&self.path) {
            remove(&self.path);
        }
    }
}

/// Removes what dead processes left in a folder.
fn sweep(folder: &Path) {
    let machine = of_this_machine();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let random = name.to_str().and_then(|name| name.strip_prefix(PREFIX));
        let is_ours = random.is_some_and(|random| !random.contains('.'));
        if !is_ours || !entry.file_type().is_ok_and(|kind| kind.is_file()) {
            continue;
        }
        let is_from_elsewhere =
            random.is_some_and(|random| random.contains('@') && !random.ends_with(&machine));
        let age = || entry.metadata().ok()?.modified().ok()?.elapsed().ok();
        if is_from_elsewhere && age().is_none_or(|age| age < LEFT_ELSEWHERE) {
            continue;
        }
        let Ok(file) = OpenOptions::new().read(true).write(true).open(entry.path()) else { continue };
        if file.try_lock().is_ok() {
            remove(&entry.path());
        }
    }
}

/// Removes a temporary file after what belongs to it, as far as the system lets it be.
fn remove(path: &Path) {
    let Some(name) = path.file_name().and_then(|name| name.to_str()) else { return };
    let folder = folder_of(path);
    for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
        let other = entry.file_name();
        let rest = other.to_str().and_then(|other| other.strip_prefix(name));
        if rest.is_some_and(|rest| rest.starts_with('.')) {
            let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            // Whatever cannot be removed now is tried again at the next run.
            let _ = if is_folder { fs::remove_dir_all(entry.path()) } else { fs::remove_file(entry.path()) };
        }
    }
    let _ = fs::remove_file(path);
}

/// A file being written next to the one that it becomes or replaces.
pub struct NewFile {
    unfinished: Unfinished,
    target: PathBuf,
}

impl NewFile {
    /// Starts a file for `path`; a link is followed and stays. The folder must exist.
    ///
    /// # Errors
    /// When the folder refuses files, or `path` is there and no regular file.
    pub fn create(path: &Path) -> io::Result<Self> {
        Self::at(target(path)?)
    }

    fn at(target: PathBuf) -> io::Result<Self> {
        Ok(Self { unfinished: Unfinished::create(&folder_of(&target))?, target })
    }

    /// The file to write.
    #[must_use]
    pub fn file(&self) -> &File {
        &self.unfinished.file
    }

    /// Puts the file on the disk and gives it its name.
    ///
    /// # Errors
    /// When the file system refuses; what had the name keeps it.
    pub fn finish(self) -> io::Result<()> {
        finish_all([self])
    }
}

impl NewFile {
    /// As [`Self::finish`], unless something has the name by now: `false` then, and it keeps the name.
    ///
    /// # Errors
    /// When the file system refuses.
    pub fn finish_new(self) -> io::Result<bool> {
        self.file().sync_all()?;
        match fs::hard_link(&self.unfinished.path, &self.target) {
            // The temporary name goes when this is dropped.
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
            // Not every file system has links; what appears in this moment is lost there.
            Err(_) if self.target.exists() => Ok(false),
            Err(_) => self.finish().map(|()| true),
        }
    }
}

/// Finishes files that belong together: all are on the disk before the first is renamed, in their order.
///
/// # Errors
/// As [`NewFile::finish`].
pub fn finish_all(files: impl IntoIterator<Item = NewFile>) -> io::Result<()> {
    let files: Vec<NewFile> = files.into_iter().collect();
    for new in &files {
        new.file().sync_all()?;
    }
    let mut live = live();
    for new in &files {
        fs::rename(&new.unfinished.path, &new.target)?;
        live.files.remove(&new.unfinished.path);
    }
    drop(live);
    sync_folders(files.iter().map(|new| new.target.as_path()));
    Ok(())
}

/// Paths for a writer that opens its files itself, next to the output that they become.
pub struct Scratch(Unfinished);

impl Scratch {
    /// Makes room in a folder.
    ///
    /// # Errors
    /// When the folder refuses files.
    pub fn inside(folder: &Path) -> io::Result<Self> {
        Unfinished::create(folder).map(Self)
    }

    /// Creates a folder to write into; the same at every call.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn folder(&self) -> io::Result<PathBuf> {
        let path = self.file("d");
        fs::create_dir_all(&path)?;
        Ok(path)
    }

    /// Path of a file that nobody else writes, with an extension.
    #[must_use]
    pub fn file(&self, extension: &str) -> PathBuf {
        let mut path = self.0.path.clone().into_os_string();
        path.push(".");
        path.push(extension);
        path.into()
    }

    /// Moves files and folders of this scratch, `(from, to)`, to their places, one after the other, the one that
    /// names the others last; [`abandon`] waits for it. Existing files and folders at these places are removed, and
    /// so are those that are `unneeded`. When something fails, everything is as it was.
    ///
    /// # Errors
    /// When the file system refuses a rename.
    pub fn replace(self, moves: &[(PathBuf, PathBuf)], unneeded: &[PathBuf]) -> io::Result<()> {
        let live = live();
        // What was renamed, in order: from, to.
        let mut done: Vec<(PathBuf, PathBuf)> = Vec::new();
        let mut rename = |from: &Path, to: &Path| -> io::Result<()> {
            fs::rename(from, to)?;
            done.push((from.to_owned(), to.to_owned()));
            Ok(())
        };
        let mut all = || -> io::Result<()> {
            for (number, (from, to)) in moves.iter().enumerate() {
                // The last rename replaces a file without a moment in which it is missing.
                let last = number + 1 == moves.len();
                if to.is_dir() || (!last && to.exists()) {
                    rename(to, &self.file(&format!("replaced-{number}")))?;
                }
                rename(from, to)?;
            }
            let mut unneeded = unneeded.iter().enumerate();
            unneeded.try_for_each(|(number, path)| rename(path, &self.file(&format!("unneeded-{number}"))))
        };
        let result = all();
        if result.is_err() {
            for (from, to) in done.iter().rev() {
                fs::rename(to, from)?;
            }
        }
        drop(live);
        sync_folders(moves.iter().map(|(_, to)| to.as_path()));
        result
    }
}

/// Puts renames on the disk: they survive a power cut only once the folder is synced; not every file system can.
fn sync_folders<'a>(paths: impl Iterator<Item = &'a Path>) {
    #[cfg(unix)]
    for folder in paths.map(folder_of).collect::<BTreeSet<_>>() {
        let _ = File::open(folder).and_then(|folder| folder.sync_all());
    }
    #[cfg(not(unix))]
    drop(paths);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn files_appear_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cif");
        write(&path, b"one").unwrap();
        let new = NewFile::create(&path).unwrap();
        new.file().write_all(b"half of tw").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"one");
        drop(new);
        assert_eq!(names(folder.path()), ["a.cif"]);
        write(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(names(folder.path()), ["a.cif"]);
        assert!(write(folder.path(), b"x").unwrap_err().to_string().contains("folder"));
    }

    #[test]
    fn a_scratch_goes_with_all_that_belongs_to_it() {
        let folder = tempfile::tempdir().unwrap();
        let fill = |scratch: &Scratch| {
            fs::write(scratch.folder().unwrap().join("scene.usdc"), "x").unwrap();
            fs::write(scratch.file("usda"), "x").unwrap();
        };
        let scratch = Scratch::inside(folder.path()).unwrap();
        fill(&scratch);
        drop(scratch);
        assert!(names(folder.path()).is_empty());
        let scratch = Scratch::inside(folder.path()).unwrap();
        fill(&scratch);
        let from = scratch.file("usda");
        scratch.replace(&[(from, folder.path().join("out.usda"))], &[]).unwrap();
        assert_eq!(names(folder.path()), ["out.usda"]);
    }

    #[test]
    fn files_that_belong_together_are_replaced_together() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let read = |name: &str| fs::read_to_string(at(name)).unwrap_or_default();
        let write = |text: &str| {
            let scratch = Scratch::inside(folder.path()).unwrap();
            let (arrays, root) = (scratch.folder().unwrap(), scratch.file("usda"));
            fs::write(arrays.join("a.usdc"), text).unwrap();
            fs::write(&root, text).unwrap();
            (scratch, arrays, root)
        };
        for text in ["one", "two"] {
            let (scratch, arrays, root) = write(text);
            scratch.replace(&[(arrays, at("payloads")), (root, at("out.usda"))], &[]).unwrap();
            assert_eq!((read("payloads/a.usdc").as_str(), read("out.usda").as_str()), (text, text));
        }
        // The second move fails, so the first is undone.
        let (scratch, arrays, _) = write("three");
        let missing = at("missing");
        assert!(scratch.replace(&[(arrays, at("payloads")), (missing, at("out.usda"))], &[]).is_err());
        assert_eq!((read("payloads/a.usdc").as_str(), read("out.usda").as_str()), ("two", "two"));
        // A file alone makes the folder next to it unneeded.
        let (scratch, _, root) = write("four");
        scratch.replace(&[(root, at("out.usda"))], &[at("payloads")]).unwrap();
        assert_eq!((names(folder.path()), read("out.usda").as_str()), (vec!["out.usda".to_owned()], "four"));
    }

    #[test]
    fn leftovers_of_dead_processes_go_and_those_of_living_ones_stay() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in
            [".cif-tmp-dead", ".cif-tmp-dead.usda", ".cif-tmp-alive", ".cif-tmp-alive.usda", ".cif-mine"]
        {
            fs::write(at(name), "x").unwrap();
        }
        fs::create_dir(at(".cif-tmp-dead.d")).unwrap();
        fs::write(at(".cif-tmp-dead.d/scene.usdc"), "x").unwrap();
        // The lock of another process: locks belong to the open file, not to the process.
        let alive = File::open(at(".cif-tmp-alive")).unwrap();
        alive.lock().unwrap();
        write(&at("new"), b"x").unwrap();
        assert_eq!(names(folder.path()), [".cif-mine", ".cif-tmp-alive", ".cif-tmp-alive.usda", "new"]);
    }

    #[test]
    fn what_another_machine_writes_stays_for_a_day() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let here = format!(".cif-tmp-here{}", of_this_machine());
        for name in
            [&here, ".cif-tmp-young@elsewhere", ".cif-tmp-old@elsewhere", ".cif-tmp-old@elsewhere.usda"]
        {
            fs::write(at(name), "x").unwrap();
        }
        let old = std::time::SystemTime::now() - 2 * LEFT_ELSEWHERE;
        File::options().write(true).open(at(".cif-tmp-old@elsewhere")).unwrap().set_modified(old).unwrap();
        write(&at("new"), b"x").unwrap();
        assert_eq!(names(folder.path()), [".cif-tmp-young@elsewhere", "new"]);
    }

    #[cfg(unix)]
    #[test]
    fn links_stay_and_their_targets_are_written() {
        let folder = tempfile::tempdir().unwrap();
        let (link, target) = (folder.path().join("link"), folder.path().join("target"));
        std::os::unix::fs::symlink("target", &link).unwrap();
        for text in ["one", "two"] {
            write(&link, text.as_bytes()).unwrap();
            assert!(link.is_symlink());
            assert_eq!(fs::read_to_string(&target).unwrap(), text);
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn streams_are_written_to_and_stay() {
        let (mut reader, writer) = io::pipe().unwrap();
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&writer));
        write(Path::new(&path), b"through a pipe").unwrap();
        drop(writer);
        assert_eq!(io::read_to_string(&mut reader).unwrap(), "through a pipe");
        let refused = NewFile::create(Path::new("/dev/null")).err().unwrap();
        assert!(refused.to_string().contains("not a regular file"), "{refused}");
    }

    /// A process of its own, which begins to write and then does as it is told: `abandon` or be killed.
    #[cfg(unix)]
    #[test]
    fn processes_that_end_early_leave_nothing_for_long() {
        use std::io::{BufRead, BufReader};
        use std::process::{Command, Stdio};

        const FOLDER: &str = "CIF_OUTPUT_TEST_FOLDER";
        if let Some(folder) = std::env::var_os(FOLDER) {
            let folder = PathBuf::from(folder);
            let _new = NewFile::create(&folder.join("a.cif")).unwrap();
            let scratch = Scratch::inside(&folder).unwrap();
            fs::write(scratch.folder().unwrap().join("scene.usdc"), "x").unwrap();
            println!("begun");
            let mut word = String::new();
            io::stdin().read_line(&mut word).unwrap();
            abandon();
            std::process::exit(130);
        }
        let folder = tempfile::tempdir().unwrap();
        let begin = || {
            let mut child = Command::new(std::env::current_exe().unwrap())
                .args([
                    "--exact",
                    "unfinished::tests::processes_that_end_early_leave_nothing_for_long",
                    "--nocapture",
                ])
                .env(FOLDER, folder.path())
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
                .unwrap();
            let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
            assert!(lines.any(|line| line.unwrap().contains("begun")));
            child
        };
        let mut abandoning = begin();
        assert_eq!(names(folder.path()).len(), 3);
        abandoning.stdin.take().unwrap().write_all(b"abandon\n").unwrap();
        assert_eq!(abandoning.wait().unwrap().code(), Some(130));
        assert!(names(folder.path()).is_empty());

        let mut killed = begin();
        let mut alive = begin();
        killed.kill().unwrap();
        killed.wait().unwrap();
        assert_eq!(names(folder.path()).len(), 6);
        write(&folder.path().join("b.cif"), b"x").unwrap();
        assert_eq!(names(folder.path()).len(), 4, "those of the process that still writes, and the new file");
        drop(alive.stdin.take());
        alive.wait().unwrap();
    }
}
