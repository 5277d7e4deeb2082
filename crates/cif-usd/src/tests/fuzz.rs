//! Stages of ours with damaged bytes: read, or refused by name.

use std::fs;
use std::panic::catch_unwind;

use cif_system::environment::FUZZ_STAGES;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::scenes::Maker;
use super::session;
use crate::{ExportOptions, Payloads, export, read_scene};

/// Damaged stages; `CIF_FUZZ_STAGES` asks for more.
const CASES: u64 = 120;

/// Numbers and words that readers stumble over.
const HOSTILE: [&str; 10] = ["-1", "0", "nan", "inf", "1e39", "4294967296", "None", "[]", "\"\"", "(1, 2)"];

/// A copy with some bytes changed, a run left out, or a value replaced.
fn damaged(text: &str, chance: &mut Pcg64) -> Vec<u8> {
    let mut bytes = text.as_bytes().to_vec();
    for _ in 0..chance.random_range(1..4) {
        let at = chance.random_range(0..bytes.len());
        match chance.random_range(0..4) {
            0 => bytes[at] = chance.random_range(32..127),
            1 => drop(bytes.drain(at..bytes.len().min(at + chance.random_range(1..80)))),
            2 => bytes.truncate(at.max(1)),
            _ => {
                // The value that follows the next equals sign, to the end of its line.
                let sign = bytes[at..].iter().position(|byte| *byte == b'=').map(|place| at + place + 1);
                let Some(start) = sign else { continue };
                let length = bytes[start..].iter().position(|byte| *byte == b'\n').unwrap_or(0);
                let value = HOSTILE[chance.random_range(0..HOSTILE.len())];
                bytes.splice(start..start + length, format!(" {value}").into_bytes());
            }
        }
    }
    bytes
}

#[test]
fn damaged_stages_are_read_or_refused_by_name() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stage.usda");
    let options =
        ExportOptions { payloads: Payloads::SingleFile, levels_of_detail: false, ..Default::default() };
    export(&Maker::new(5).scene(), &path, options).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    let cases = FUZZ_STAGES.text().and_then(|cases| cases.parse().ok()).unwrap_or(CASES);
    for seed in 0..cases {
        let mut chance = Pcg64::seed_from_u64(seed);
        // USD keeps layers by their names.
        let path = folder.path().join(format!("damaged_{seed}.usda"));
        fs::write(&path, damaged(&text, &mut chance)).unwrap();
        let read = catch_unwind(|| read_scene(&path)).unwrap_or_else(|_| panic!("seed {seed} panics"));
        if let Err(error) = read {
            let message = error.to_string();
            assert!(message.contains(&format!("damaged_{seed}.usda")), "seed {seed}: {message}");
        }
        fs::remove_file(&path).unwrap();
    }
}
