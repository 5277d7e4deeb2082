//! Facts of its build that the command holds: the commit that it was built from, and the example that `cif demo` puts into a
//! folder, a capture and a scene that was trained on it. None has to be there: a source archive has no commit, and may
//! have no example.

use std::error::Error;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::{env, fs, io};

/// Root of the repository or of a source archive, from the folder of this crate.
const ROOT: &str = "../..";

/// The example capture, from the root.
const CAPTURE: &str = "examples/tabletop-mini";

/// A scene that was trained on it, from the root.
const SCENE: &str = "examples/tabletop-mini.cif";

/// Folder of the crates, from the root.
const CRATES: &str = "crates";

/// The one crate above the command, which is not built into it.
const ABOVE: &str = "cif-python";

/// Other files that the command is built from, from the root.
const OTHERS: [&str; 5] = ["Cargo.toml", "Cargo.lock", "plugin/web", CAPTURE, SCENE];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    if let Some(commit) = commit(Path::new(ROOT)) {
        println!("cargo::rustc-env=CIF_COMMIT={commit}");
    }
    let folder = PathBuf::from(env::var_os("OUT_DIR").ok_or("cargo names no folder for what is built")?);
    fs::write(folder.join("capture.rs"), capture(&Path::new(ROOT).join(CAPTURE))?)?;
    fs::write(folder.join("scene.rs"), scene(&Path::new(ROOT).join(SCENE)))?;
    Ok(())
}

/// Makes cargo run this script again when a file, or one below a folder, has changed. The path has to be there: else it
/// would run at every build.
fn watch(path: &Path) {
    println!("cargo::rerun-if-changed={}", path.display());
}

/// Short hash of the commit that is built, with `-dirty` where files that the command is built from were changed since.
/// `None` without git and in a source archive, also in one that lies inside of another repository.
fn commit(root: &Path) -> Option<String> {
    let top = PathBuf::from(git(root, &["rev-parse", "--show-toplevel"])?);
    if top.canonicalize().ok()? != root.canonicalize().ok()? {
        return None;
    }
    let head = git(root, &["rev-parse", "--short=10", "HEAD"])?;
    watch_head(root);
    let sources = sources(root).ok()?;
    sources.iter().for_each(|source| watch(&root.join(source)));
    let mut words = vec!["--no-optional-locks", "status", "--porcelain", "--untracked-files=no", "--"];
    words.extend(sources.iter().map(String::as_str));
    let changed = git(root, &words)?;
    Some(if changed.is_empty() { head } else { format!("{head}-dirty") })
}

/// Makes cargo run this script again when another commit is checked out or made.
fn watch_head(root: &Path) {
    let place = |name: &str| git(root, &["rev-parse", "--git-path", name]).map(|path| root.join(path));
    let mut places: Vec<PathBuf> = place("HEAD").into_iter().collect();
    let branch = git(root, &["symbolic-ref", "--quiet", "HEAD"]).and_then(|branch| place(&branch));
    // A branch without a file of its own is packed; its next commit makes the file, in the nearest folder that is there.
    places.extend(
        branch.iter().filter_map(|branch| branch.ancestors().find(|path| path.exists())).map(Path::to_owned),
    );
    places.iter().filter(|path| path.exists()).for_each(|path| watch(path));
}

/// Files and folders that the command is built from, from the root.
fn sources(root: &Path) -> io::Result<Vec<String>> {
    let mut found: Vec<String> = OTHERS.map(str::to_owned).to_vec();
    for entry in fs::read_dir(root.join(CRATES))? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if name != ABOVE {
            found.extend(["src", "Cargo.toml", "build.rs"].map(|part| format!("{CRATES}/{name}/{part}")));
        }
    }
    found.retain(|path| root.join(path).exists());
    found.sort();
    Ok(found)
}

/// Output of git; `None` where there is no git, or it fails.
fn git(root: &Path, words: &[&str]) -> Option<String> {
    let output = Command::new("git").args(words).current_dir(root).stderr(Stdio::null()).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim_end().to_owned())
}

/// Source of a list of the files of the capture: names below its folder, in their order, and contents. Without the
/// capture it is empty.
fn capture(folder: &Path) -> Result<String, Box<dyn Error>> {
    let mut names = Vec::new();
    if folder.is_dir() {
        watch(folder);
        collect(folder, "", &mut names)?;
    }
    names.sort();
    let mut source = "&[\n".to_owned();
    for name in names {
        writeln!(source, "    ({name:?}, {}),", contents(&format!("{CAPTURE}/{name}")))?;
    }
    source.push_str("]\n");
    Ok(source)
}

/// Source of the contents of the scene, where it is there.
fn scene(path: &Path) -> String {
    if !path.is_file() {
        return "None\n".to_owned();
    }
    watch(path);
    format!("Some({})\n", contents(SCENE))
}

/// Source of the contents of a file, whose name is seen from the root.
fn contents(name: &str) -> String {
    let path = format!("/{ROOT}/{name}");
    format!("include_bytes!(concat!(env!(\"CARGO_MANIFEST_DIR\"), {path:?}))")
}

/// Adds the names of the files below a folder, whose own name ends in `/` or is empty. Hidden files are left out: they
/// are of file managers.
fn collect(folder: &Path, prefix: &str, names: &mut Vec<String>) -> Result<(), Box<dyn Error>> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name =
            name.to_str().ok_or_else(|| format!("{}: the name is not UTF-8", entry.path().display()))?;
        if name.starts_with('.') {
            continue;
        }
        if entry.file_type()?.is_dir() {
            collect(&entry.path(), &format!("{prefix}{name}/"), names)?;
        } else {
            names.push(format!("{prefix}{name}"));
        }
    }
    Ok(())
}
