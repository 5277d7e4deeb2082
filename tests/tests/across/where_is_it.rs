//! The files that `CONTRIBUTING.md` and `crates/README.md` name are there.

use std::path::Path;

fn repository() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Words in backticks that are paths from the root of the repository.
fn paths(text: &str) -> Vec<&str> {
    let quoted = text.split('`').skip(1).step_by(2);
    let is_path =
        |word: &&str| word.starts_with("crates/") || word.starts_with("docs/") || word.starts_with("tests/");
    quoted.filter(is_path).collect()
}

#[test]
fn questions_of_newcomers_lead_to_files() {
    let text = std::fs::read_to_string(repository().join("CONTRIBUTING.md")).unwrap();
    let (_, section) = text.split_once("## Where is it?").expect("the section");
    let (section, _) = section.split_once("\n## ").expect("the next section");
    let questions: Vec<&str> =
        section.lines().filter(|line| line.starts_with("| ") && line.contains("? |")).collect();
    assert!(questions.len() >= 6, "{questions:?}");
    for question in questions {
        assert!(!paths(question).is_empty(), "{question}: no path");
    }
}

#[test]
fn paths_of_the_pages_for_developers_exist() {
    for page in ["CONTRIBUTING.md", "crates/README.md"] {
        let text = std::fs::read_to_string(repository().join(page)).unwrap();
        let found = paths(&text);
        assert!(page != "CONTRIBUTING.md" || found.len() > 6, "{page}: {found:?}");
        let missing: Vec<&str> = found.into_iter().filter(|path| !repository().join(path).exists()).collect();
        assert!(missing.is_empty(), "{page} names what is not there: {missing:?}");
    }
}
