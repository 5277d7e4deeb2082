//! Damaged files for every reader: each gives what it can read, or an error that names the file. No reader panics,
//! runs long, or takes memory far beyond its input. See "Damaged files" in `tests/README.md`.
#![allow(clippy::unwrap_used)] // Helpers of tests.

#[path = "../../../crates/cif-dataset/tests/support/mod.rs"]
mod captures;
mod mask_files;
mod mutate;
mod poses;
mod readers;

use std::collections::BTreeSet;
use std::fs;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use cif_system::environment::{FUZZ_MINUTES, FUZZ_READER, FUZZ_SEED, Variable};
use peak_alloc::PeakAlloc;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use self::mutate::Form;
use self::readers::Reader;

/// Counts the memory that is in use.
#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Held by the test that runs: memory and panics are those of the process.
static ALONE: Mutex<()> = Mutex::new(());

/// Damaged files per reader where time is short.
const CASES: u64 = 100;

/// Memory that reading may take, whatever the input: bytes.
const MEMORY_LIMIT: usize = 256 << 20;

/// Time that reading may take. Inputs of this size take milliseconds; machines of CI are slow and shared.
const TIME_LIMIT: Duration = Duration::from_secs(10);

/// Time after which a reader is taken to hang; the process then ends, because nothing else ends a reader.
const HANG: Duration = Duration::from_secs(60);

/// Inputs that a reader once failed on, `<reader>/<what was wrong>`.
const CORPUS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz_corpus");

/// Where damaged files are written.
fn workplace() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz")
}

/// What is being read, for the watch and for the message of a panic.
#[derive(Default)]
struct Watched {
    case: Option<(String, Instant)>,
    panic: Option<String>,
}

/// One reader with its valid input.
struct Bench {
    reader: Reader,
    folder: PathBuf,
    original: Vec<u8>,
    watched: Arc<Mutex<Watched>>,
}

impl Bench {
    /// # Panics
    /// When the reader refuses the valid input.
    fn new(reader: Reader, watched: &Arc<Mutex<Watched>>) -> Self {
        let folder = workplace().join(reader.name);
        if folder.exists() {
            fs::remove_dir_all(&folder).unwrap();
        }
        fs::create_dir_all(&folder).unwrap();
        (reader.write)(&folder);
        let original = fs::read(folder.join(reader.file)).unwrap();
        if let Err(error) = (reader.read)(&folder) {
            panic!("{}: the valid input is refused: {error}", reader.name);
        }
        Self { reader, folder, original, watched: Arc::clone(watched) }
    }

    /// True where an error names a file of the folder, or the one outside that damage had the reader open.
    fn is_named(&self, error: &str) -> bool {
        error.contains(&*self.folder.to_string_lossy()) || error.starts_with(mutate::OUTSIDE)
    }

    fn clear(&self) {
        fs::remove_dir_all(&self.folder).unwrap();
    }

    fn damaged(&self, seed: u64) -> Vec<u8> {
        mutate::damaged(&self.original, self.reader.form, &mut Pcg64::seed_from_u64(seed))
    }

    /// What is wrong with how the reader takes an input.
    fn problem(&self, input: &[u8], case: &str) -> Option<String> {
        fs::write(self.folder.join(self.reader.file), input).unwrap();
        let start = Instant::now();
        *self.watched.lock().unwrap() = Watched { case: Some((case.to_owned(), start)), panic: None };
        MEMORY.reset_peak_usage();
        let before = MEMORY.current_usage();
        let result = panic::catch_unwind(AssertUnwindSafe(|| (self.reader.read)(&self.folder)));
        let taken = MEMORY.peak_usage().saturating_sub(before);
        let spent = start.elapsed();
        let watched = std::mem::take(&mut *self.watched.lock().unwrap());
        match result {
            Err(_) => Some(format!("it panics: {}", watched.panic.unwrap_or_default())),
            Ok(Err(error)) if !self.is_named(&error) => {
                Some(format!("its error does not name the file: {error}"))
            }
            Ok(_) if taken > MEMORY_LIMIT => Some(format!("it takes {} MiB", taken >> 20)),
            Ok(_) if spent > TIME_LIMIT => Some(format!("it takes {:.0} s", spent.as_secs_f64())),
            Ok(_) => None,
        }
    }
}

/// A failure of a reader.
struct Failure {
    reader: &'static str,
    problem: String,
    /// What makes the input again, or the file it is in.
    case: String,
}

impl Failure {
    /// Equal for failures of one cause.
    fn cause(&self) -> String {
        let words: String = self.problem.chars().filter(|c| !c.is_ascii_digit()).take(150).collect();
        format!("{} {words}", self.reader)
    }
}

/// Ends the process when a reader hangs, and keeps the message of a panic.
fn watch() -> Arc<Mutex<Watched>> {
    let watched = Arc::new(Mutex::new(Watched::default()));
    let seen = Arc::clone(&watched);
    panic::set_hook(Box::new(move |info| {
        if let Ok(mut seen) = seen.lock() {
            if seen.case.is_none() {
                eprintln!("{info}");
            }
            seen.panic.get_or_insert_with(|| info.to_string().replace('\n', " "));
        }
    }));
    let seen = Arc::clone(&watched);
    std::thread::spawn(move || {
        loop {
            std::thread::sleep(Duration::from_secs(1));
            if let Ok(seen) = seen.lock()
                && let Some((case, start)) = &seen.case
                && start.elapsed() > HANG
            {
                eprintln!("{case} hangs; its input lies in {}", workplace().display());
                std::process::exit(101);
            }
        }
    });
    watched
}

/// What to run, from the environment.
struct Plan {
    /// Runs on for so long, with random seeds.
    time: Option<Duration>,
    /// Only readers whose name holds this.
    only: String,
    /// One case alone.
    seed: Option<u64>,
}

impl Plan {
    fn read() -> Self {
        let given = |variable: &Variable| variable.text().filter(|text| !text.is_empty());
        Self {
            time: given(&FUZZ_MINUTES).map(|text| {
                Duration::from_secs_f64(60.0 * text.parse::<f64>().expect("CIF_FUZZ_MINUTES is a number"))
            }),
            only: given(&FUZZ_READER).unwrap_or_default(),
            seed: given(&FUZZ_SEED).map(|text| text.parse().expect("CIF_FUZZ_SEED is a number")),
        }
    }
}

#[test]
fn readers_take_damaged_files_or_name_them() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let plan = Plan::read();
    let watched = watch();
    let benches: Vec<Bench> = readers::all()
        .into_iter()
        .filter(|reader| reader.name.contains(&plan.only))
        .map(|reader| Bench::new(reader, &watched))
        .collect();
    assert!(!benches.is_empty(), "no reader is called {}", plan.only);
    let (mut failures, mut causes) = (Vec::new(), BTreeSet::new());
    let mut count = 0_u64;
    let mut examine = |bench: &Bench, input: &[u8], case: String| {
        count += 1;
        let case = format!("{}: {case}", bench.reader.name);
        if let Some(problem) = bench.problem(input, &case) {
            let failure = Failure { reader: bench.reader.name, problem, case };
            if causes.insert(failure.cause()) {
                let kept = keep(bench, input, causes.len());
                eprintln!("{}\n  {}\n  kept as {}", failure.case, failure.problem, kept.display());
                failures.push(failure);
            }
        }
    };
    for bench in &benches {
        for path in kept_inputs(bench.reader.name) {
            examine(bench, &fs::read(&path).unwrap(), path.display().to_string());
        }
    }
    let seeded = |seed: u64| format!("CIF_FUZZ_SEED={seed}");
    match (plan.seed, plan.time) {
        (Some(seed), _) => {
            benches.iter().for_each(|bench| examine(bench, &bench.damaged(seed), seeded(seed)))
        }
        (None, None) => {
            for bench in &benches {
                (0..CASES).for_each(|seed| examine(bench, &bench.damaged(seed), seeded(seed)));
            }
        }
        (None, Some(time)) => {
            let (start, mut seeds) = (Instant::now(), rand::rng());
            while start.elapsed() < time {
                for bench in &benches {
                    let seed = seeds.random();
                    examine(bench, &bench.damaged(seed), seeded(seed));
                }
            }
        }
    }
    benches.iter().for_each(Bench::clear);
    println!("{count} damaged files for {} readers", benches.len());
    let reported: Vec<String> =
        failures.iter().map(|failure| format!("{}: {}", failure.case, failure.problem)).collect();
    assert!(reported.is_empty(), "{} kinds of failures:\n{}", reported.len(), reported.join("\n"));
}

/// Inputs that a reader once failed on.
fn kept_inputs(reader: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(Path::new(CORPUS).join(reader)).into_iter().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// Keeps a failing input, to become part of the corpus once it is mended.
fn keep(bench: &Bench, input: &[u8], number: usize) -> PathBuf {
    let folder = workplace().with_file_name("fuzz-failures").join(bench.reader.name);
    fs::create_dir_all(&folder).unwrap();
    let path = folder.join(format!("{number}"));
    fs::write(&path, input).unwrap();
    path
}

#[test]
fn a_reader_that_fails_is_found() {
    fn refuse(text: &str) -> Result<(), String> {
        if text.starts_with("valid") { Ok(()) } else { Err("somewhere: wrong".to_owned()) }
    }
    fn take(folder: &Path) -> Result<(), String> {
        let text = fs::read_to_string(folder.join("file")).unwrap_or_default();
        match text.as_str() {
            "panic" => panic!("at the file"),
            "memory" => {
                drop(std::hint::black_box(Vec::<u8>::with_capacity(MEMORY_LIMIT + 1)));
                Ok(())
            }
            "named" => Err(format!("{}: wrong", folder.join("file").display())),
            text => refuse(text),
        }
    }
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let reader = Reader {
        name: "a-reader-that-fails",
        file: "file",
        form: Form::Text,
        write: |folder| fs::write(folder.join("file"), "valid 1").unwrap(),
        read: take,
    };
    let bench = Bench::new(reader, &Arc::default());
    let problem = |input: &str| bench.problem(input.as_bytes(), "a test");
    assert_eq!(problem("valid 2"), None);
    assert_eq!(problem("named"), None);
    assert!(problem("panic").unwrap().starts_with("it panics"));
    assert!(problem("memory").unwrap().contains("it takes 256 MiB"));
    assert!(problem("else").unwrap().contains("does not name the file: somewhere"));
    assert!((0..50).any(|seed| bench.damaged(seed) != bench.damaged(seed + 1)), "seeds give other damage");
    assert_eq!(bench.damaged(7), bench.damaged(7), "a seed gives the same damage again");
    bench.clear();
}
