//! Fills the last column of the table in `tests/README.md` from what the tests of hard cases print (on stdin).

use std::collections::BTreeMap;
use std::io::BufRead;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Row: largest error, its limit.
    let mut worst: BTreeMap<u32, (f64, f64)> = BTreeMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        // Tests print side by side with others, so that a line may begin with something else.
        let Some((_, told)) = line.split_once("hard case ") else { continue };
        let cells: Vec<&str> = told.split(" | ").collect();
        let [row, _, error, limit] = cells[..] else { continue };
        let (Ok(row), Ok(error), Ok(limit)) =
            (row.parse(), error.parse::<f64>(), limit.trim().parse::<f64>())
        else {
            continue;
        };
        let seen = worst.entry(row).or_insert((0.0, limit));
        // Several limits in one row: the one that is nearest to being reached.
        if error / limit >= seen.0 / seen.1 {
            *seen = (error, limit);
        }
    }
    if worst.is_empty() {
        return Err("stdin holds no line of a hard case: run the tests with --nocapture".into());
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    let mut text = String::new();
    for line in std::fs::read_to_string(&path)?.lines() {
        let number = line.split('|').nth(1).and_then(|cell| cell.trim().parse::<u32>().ok());
        match number.and_then(|number| worst.get(&number)) {
            Some((error, limit)) if line.starts_with("| ") => {
                let kept =
                    line.trim_end().trim_end_matches('|').rsplit_once('|').map_or(line, |(kept, _)| kept);
                text += &format!("{kept}| {error:.1e} of {limit:.0e} |\n");
            }
            _ => text += &format!("{line}\n"),
        }
    }
    std::fs::write(&path, text)?;
    println!("{} rows of {} are new", worst.len(), path.display());
    Ok(())
}
