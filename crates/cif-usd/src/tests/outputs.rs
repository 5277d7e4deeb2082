//! Where stages go: links stay what they are, and nothing unfinished stays next to them.
#![cfg(unix)]

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use super::{scenes::Maker, session};
use crate::{ExportOptions, export, read_scene, relabel};

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn links_stay_and_their_targets_are_written() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("disk")).unwrap();
    let scene = Maker::new(3).scene();
    let options = ExportOptions::default();

    // Payloads lie next to the target, which is also next to the link.
    symlink("v2.usda", at("scene.usda")).unwrap();
    for _ in 0..2 {
        export(&scene, &at("scene.usda"), options).unwrap();
    }
    assert!(at("scene.usda").is_symlink());
    assert_eq!(names(folder.path()), ["disk", "scene.usda", "v2.payloads", "v2.usda"]);
    let read = read_scene(&at("scene.usda")).unwrap();
    assert_eq!(read.nodes.len(), scene.nodes.len());
    let label = &scene.nodes[0].name;
    relabel(&at("scene.usda"), &at("scene.usda"), label, "other", None).unwrap();
    assert!(at("scene.usda").is_symlink());
    assert_eq!(names(folder.path()), ["disk", "scene.usda", "v2.payloads", "v2.usda"]);

    // Through a link from elsewhere they would not be found; a file that holds everything may lie anywhere.
    symlink("disk/far.usda", at("far.usda")).unwrap();
    let error = export(&scene, &at("far.usda"), options).unwrap_err().to_string();
    assert!(error.contains("is a link to"), "{error}");
    symlink("disk/far.usdc", at("far.usdc")).unwrap();
    export(&scene, &at("far.usdc"), options).unwrap();
    assert!(at("far.usdc").is_symlink());
    assert_eq!(names(&at("disk")), ["far.usdc"]);
}

#[test]
fn files_of_others_in_the_folder_of_payloads_stay() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = Maker::new(3).scene();
    let options = ExportOptions { force: true, ..ExportOptions::default() };
    export(&scene, &at("scene.usda"), options).unwrap();
    let ours = names(&at("scene.payloads"));
    fs::write(at("scene.payloads/notes.txt"), "mine").unwrap();
    fs::create_dir(at("scene.payloads/textures")).unwrap();
    fs::write(at("scene.payloads/textures/wood.png"), "mine").unwrap();
    let summary = export(&scene, &at("scene.usda"), options).unwrap();
    assert_eq!(summary.kept, ["notes.txt", "textures"].map(|name| at("scene.payloads").join(name)));
    assert_eq!(fs::read_to_string(at("scene.payloads/notes.txt")).unwrap(), "mine");
    assert_eq!(fs::read_to_string(at("scene.payloads/textures/wood.png")).unwrap(), "mine");
    assert_eq!(names(&at("scene.payloads")).len(), ours.len() + 2);
    assert_eq!(names(folder.path()), ["scene.payloads", "scene.usda"]);
    // A file where the folder is to be.
    fs::write(at("other.payloads"), "mine").unwrap();
    assert!(export(&scene, &at("other.usda"), options).is_err());
    assert_eq!(fs::read_to_string(at("other.payloads")).unwrap(), "mine");
}

#[test]
fn payloads_behind_a_link_are_not_replaced() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("theirs")).unwrap();
    symlink("theirs", at("scene.payloads")).unwrap();
    let options = ExportOptions { force: true, ..ExportOptions::default() };
    let error = export(&Maker::new(3).scene(), &at("scene.usda"), options).unwrap_err().to_string();
    assert!(error.contains("scene.payloads is a link"), "{error}");
    assert_eq!(names(folder.path()), ["scene.payloads", "theirs"]);
}
