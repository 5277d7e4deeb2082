//! Fills the last columns of the table in `tests/README.md` from what the tests of hard cases print (on stdin).

use std::collections::BTreeMap;
use std::io::BufRead;
use std::path::Path;

/// Columns of the table that are filled, by what was measured.
const PATHS: [&str; 4] = ["f64", "f32", "fast", "gpu"];

/// Largest errors of a cell: of a number on its own, forward, backward.
type Cell = [Option<f64>; 3];

fn shown(cell: &Cell) -> String {
    let number = |error: f64| if error == 0.0 { "0".to_owned() } else { format!("{error:.1e}") };
    let half = |error: Option<f64>| error.map_or("–".to_owned(), number);
    match cell {
        [None, None, None] => "–".to_owned(),
        [Some(alone), None, None] => number(*alone),
        [_, forward, backward] => format!("{} / {}", half(*forward), half(*backward)),
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut worst: BTreeMap<u32, [Cell; PATHS.len()]> = BTreeMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        // Tests print along with others, so that a line may begin with something else.
        let Some((_, case)) = line.split_once("hard case ") else { continue };
        let cells: Vec<&str> = case.split(" | ").collect();
        let [row, path, direction, _, error, _] = cells[..] else { continue };
        let path = PATHS.iter().position(|known| *known == path);
        let direction = ["alone", "forward", "backward"].iter().position(|known| *known == direction);
        let (Ok(row), Some(path), Some(direction), Ok(error)) =
            (row.parse(), path, direction, error.parse::<f64>())
        else {
            continue;
        };
        let seen = &mut worst.entry(row).or_default()[path][direction];
        *seen = Some(seen.map_or(error, |seen| seen.max(error)));
    }
    if worst.is_empty() {
        return Err("stdin holds no line of a hard case: run the tests with --nocapture".into());
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    let mut text = String::new();
    for line in std::fs::read_to_string(&path)?.lines() {
        let number = line.split('|').nth(1).and_then(|cell| cell.trim().parse::<u32>().ok());
        match number.and_then(|number| worst.get(&number)) {
            Some(cells) if line.starts_with("| ") => {
                let kept: Vec<&str> = line.split('|').skip(1).take(4).map(str::trim).collect();
                let filled = cells.each_ref().map(shown);
                text += &format!("| {} | {} |\n", kept.join(" | "), filled.join(" | "));
            }
            _ => text += &format!("{line}\n"),
        }
    }
    std::fs::write(&path, text)?;
    println!("{} rows of {} are new", worst.len(), path.display());
    Ok(())
}
