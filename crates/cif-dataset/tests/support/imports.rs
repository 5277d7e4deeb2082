//! Masks of other tools, imported and read back.

use std::path::Path;

use cif_dataset::masks::{Import, MaskWriter, SourceKind};
use cif_dataset::{Dataset, OpenOptions};

use super::open;

/// The mask of the tests: object 1 left of column 8, object 2 right of column 24, nothing between.
pub fn object_at(x: u32) -> u32 {
    match x {
        0..8 => 1,
        24.. => 2,
        _ => 0,
    }
}

/// Imports, writes and reads back; labels and the ids in columns 3, 12 and 30 of row 5 of each frame.
pub fn imported(
    folder: &tempfile::TempDir,
    source: &Path,
) -> (SourceKind, Vec<String>, Vec<Option<[u16; 3]>>) {
    let dataset = open(folder);
    let import = Import::open(source, None, None, &dataset).unwrap();
    let out = folder.path().join("imported");
    let writer = MaskWriter::create(&out).unwrap();
    for (index, frame) in dataset.frames.iter().enumerate() {
        if let Some(drawn) = import.draw(&dataset, index).unwrap() {
            writer.add(&frame.name, &drawn.ids, None).unwrap();
        }
    }
    writer.finish(&import.instances).unwrap();
    let options = OpenOptions { masks: Some("imported".into()), ..OpenOptions::default() };
    let dataset = Dataset::open(folder.path(), &options).unwrap();
    let columns = |index| {
        let mask = dataset.load_mask(index).unwrap();
        mask.map(|mask| [3, 12, 30].map(|x| *mask.at(x, 5)))
    };
    let frames = (0..dataset.frames.len()).map(columns).collect();
    (import.kind, dataset.instances.iter().map(|instance| instance.label.clone()).collect(), frames)
}

pub fn failure_of(folder: &tempfile::TempDir, source: &Path) -> String {
    let dataset = open(folder);
    match Import::open(source, None, None, &dataset) {
        Err(error) => error.to_string(),
        Ok(import) => {
            let drawn = (0..dataset.frames.len()).map(|index| import.draw(&dataset, index));
            drawn.filter_map(Result::err).next().expect("an error").to_string()
        }
    }
}

pub const BOTH: Option<[u16; 3]> = Some([1, 0, 2]);
