//! `cif batch`: the jobs of a plan on this machine, and for the engines of farms.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use cif_test::command::{Background, Run, SMALL_MODEL, json, run_line};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");

/// Steps of trainings whose quality does not matter.
const TINY: &str = "--iterations-coarse 6 --iterations-fine 8 --iterations-instance 6 --set stages.batch=1 \
                    --set densify.max_gaussians=600";

fn cif(folder: &Path, line: &str) -> Run {
    run_line(CIF, folder, line)
}

/// A folder with captures of these names, and a plan.
fn with_plan(captures: &[&str], plan: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in captures {
        let capture = folder.path().join("captures").join(name);
        fs::create_dir_all(&capture).unwrap();
        cif_test::capture::write(&capture, 4);
    }
    fs::write(folder.path().join("plan.toml"), plan).unwrap();
    folder
}

fn plan(rest: &str) -> String {
    format!("captures = [\"captures/*\"]\n[train]\noptions = \"{SMALL_MODEL} {TINY}\"\n{rest}")
}

/// States of the jobs by their ids.
fn states(folder: &Path) -> BTreeMap<String, String> {
    let listed = json(&cif(folder, "batch plan.toml --list --json").succeeds().stdout);
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    listed["jobs"].as_array().unwrap().iter().map(|job| (text(&job["id"]), text(&job["state"]))).collect()
}

fn record(folder: &Path, id: &str) -> Value {
    json(&fs::read_to_string(folder.join(format!("results/jobs/{id}.json"))).unwrap())
}

#[test]
fn a_plan_is_run_once_and_what_changes_is_made_again() {
    let seeds = "seed = [0, 1]\n[export]\nfiles = [\"scene.glb\"]\n[[step]]\nname = \"facts\"\neach = \"batch\"\n\
                 needs = [\"export\"]\ncommand = \"info captures/a --json={output}/facts.json --force\"\n\
                 makes = [\"{output}/facts.json\"]\n";
    let folder = with_plan(&["a", "b"], &plan(seeds));
    let path = folder.path();
    assert!(
        states(path)
            .iter()
            .all(|(id, state)| state == "to do" || (state == "waits" && !id.starts_with("train")))
    );
    let first = cif(path, "batch plan.toml").succeeds();
    assert!(first.stderr.contains("14 jobs in"), "{}", first.stderr);
    assert!(first.stderr.contains("14 done, 0 kept, 0 failed"), "{}", first.stderr);
    assert!(states(path).values().all(|state| state == "done"));
    let scene = path.join("results/scenes/a/seed1");
    for file in ["scene.cif", "scene.glb", "scores.json", "train.json", "pictures"] {
        assert!(scene.join(file).exists(), "{file}");
    }
    assert!(path.join("results/facts.json").is_file());
    let spent = record(path, "train/a/seed0")["spent"].clone();
    if cfg!(target_os = "linux") {
        assert!(
            spent["cpu_s"].as_f64() > Some(0.0) && spent["peak_bytes"].as_u64() > Some(10_000_000),
            "{spent}"
        );
        assert!(spent["written_bytes"].as_u64() > Some(100_000), "{spent}");
    }
    let page = fs::read_to_string(path.join("results/index.html")).unwrap();
    assert!(page.contains("4 scenes by 14 jobs: 0 failed, 0 not run"));
    assert!(page.contains("src=\"./scenes/a/seed0/pictures/"), "the page shows pictures");
    let scores = fs::read_to_string(path.join("results/scores.csv")).unwrap();
    assert_eq!(scores.lines().count(), 5);

    // The seed counts, and nothing else: alone and by another number of threads it is the same scene.
    let alone = format!("train captures/a -o alone.cif {SMALL_MODEL} {TINY} --seed 1 --threads 1 -q");
    cif(path, &alone).succeeds();
    let [ours, theirs] = [scene.join("scene.cif"), path.join("alone.cif")]
        .map(|file| cif_field::Checkpoint::load(file).unwrap().field.gaussians);
    assert!(ours == theirs);

    // In another order, one by one: the same scores, byte by byte.
    fs::rename(path.join("results"), path.join("first")).unwrap();
    for job in ["train:3", "train:0-2", "eval/b/seed1", "eval", "export", "facts", "collect"] {
        cif(path, &format!("batch plan.toml --job {job}")).succeeds();
    }
    assert_eq!(fs::read_to_string(path.join("results/scores.csv")).unwrap(), scores);

    let kept = cif(path, "batch plan.toml").succeeds();
    assert!(kept.stderr.contains("0 done, 14 kept"), "{}", kept.stderr);
    // An image of b, which two scenes are made from.
    let image = fs::read_dir(path.join("captures/b/rgb/1x")).unwrap().next().unwrap().unwrap().path();
    let other = fs::read_dir(path.join("captures/b/rgb/1x")).unwrap().last().unwrap().unwrap().path();
    fs::copy(other, image).unwrap();
    let again = cif(path, "batch plan.toml").succeeds();
    assert!(again.stderr.contains("8 done, 6 kept"), "{}", again.stderr);
    let forecast = cif(path, "batch plan.toml --forecast 100").succeeds().stdout;
    assert!(forecast.contains("workers") && forecast.lines().count() >= 4, "{forecast}");
}

#[test]
fn a_failure_stops_what_needs_it_and_nothing_else() {
    let folder = with_plan(&["a", "b", "c"], &plan("[export]\nfiles = [\"scene.glb\"]\n"));
    let path = folder.path();
    let image = path.join("captures/b/rgb/1x");
    for entry in fs::read_dir(&image).unwrap() {
        fs::write(entry.unwrap().path(), "no picture").unwrap();
    }
    cif(path, "batch plan.toml --forecast 10").fails(1, &["a job of each step"]);
    let run = cif(path, "batch plan.toml");
    assert!(run.stderr.contains("7 done, 0 kept, 1 failed, 2 left out"), "{}", run.stderr);
    run.fails(1, &["eval/b/run: left out, because train/b/run failed", "results/jobs/train/b/run.log"]);
    let page = fs::read_to_string(path.join("results/index.html")).unwrap();
    assert!(page.contains("1 failed, 2 not run") && page.contains("jobs/train/b/run.log"));
    let states = states(path);
    assert!(states["train/b/run"].starts_with("failed: "), "{states:?}");
    assert_eq!((states["eval/a/run"].as_str(), states["eval/b/run"].as_str()), ("done", "waits"));
    // As an engine runs them: a failure is recorded and ends well, the last job ends badly.
    cif(path, "batch plan.toml --job train/b/run --keep-going").succeeds();
    cif(path, "batch plan.toml --job eval/b/run --keep-going").succeeds();
    cif(path, "batch plan.toml --job train/b/run").fails(1, &["failed: train/b/run"]);
    cif(path, "batch plan.toml --job collect:0 --keep-going").fails(1, &["1 of 10 jobs failed"]);
    // Mended, the rest is done.
    fs::remove_dir_all(path.join("captures/b")).unwrap();
    fs::create_dir(path.join("captures/b")).unwrap();
    cif_test::capture::write(&path.join("captures/b"), 4);
    let mended = cif(path, "batch plan.toml").succeeds();
    assert!(mended.stderr.contains("4 done, 6 kept"), "{}", mended.stderr);
}

/// Settings of a training that does not end by itself, and saves every second.
const ENDLESS: &str = "--iterations-coarse 10000000 --checkpoint-seconds 1";

#[cfg(unix)]
#[test]
fn a_job_of_a_killed_worker_goes_on_elsewhere_from_what_was_saved() {
    let plan = format!(
        "captures = [\"captures/*\"]\neval = false\n[train]\noptions = \"{SMALL_MODEL} {ENDLESS}\"\n"
    );
    let folder = with_plan(&["a"], &plan);
    let path = folder.path();
    let scene = path.join("results/scenes/a/run/scene.cif");
    let steps = || {
        cif_field::Checkpoint::load(&scene).unwrap().training.unwrap().json["progress"]["total_steps"]
            .as_u64()
    };
    let mut worker = Background::start(CIF, path, "batch plan.toml --job train");
    worker.until(|| scene.exists());
    // As when a machine goes down: the worker and its training at once.
    let threads = fs::read_dir(format!("/proc/{}/task", worker.id())).unwrap();
    let of_thread = |thread: std::io::Result<fs::DirEntry>| {
        fs::read_to_string(thread.unwrap().path().join("children")).unwrap_or_default()
    };
    let children: String = threads.map(of_thread).collect();
    assert!(!children.is_empty(), "the training is a child of the worker");
    drop(worker);
    for child in children.split_whitespace() {
        let _ = std::process::Command::new("kill").args(["-KILL", child]).status();
    }
    let saved = steps();
    assert!(saved > Some(0));
    let begun = record(path, "train/a/run");
    assert_eq!(begun["state"], "begun");
    let mut other = Background::start(CIF, path, "batch plan.toml");
    other.until(|| record(path, "train/a/run")["attempts"] == 2);
    // A third leaves the job to it.
    let third = Background::start(CIF, path, "batch plan.toml --job train");
    other.until(|| steps() > saved);
    assert_eq!(record(path, "train/a/run")["attempts"], 2);
    drop(third);
    std::process::Command::new("kill").args(["-TERM", &other.id().to_string()]).status().unwrap();
    assert_eq!(other.ends(), Some(130));
    let after = record(path, "train/a/run");
    assert_eq!((&after["state"], &after["mark"]), (&Value::from("begun"), &begun["mark"]));
    assert!(!path.join("results/jobs/train/a/.run.json.lock").exists());
}

#[test]
fn two_processes_share_a_plan() {
    let folder = with_plan(&["a", "b", "c", "d"], &plan("seed = [0, 1]\n"));
    let path = folder.path();
    let mut other = Background::start(CIF, path, "batch plan.toml --jobs 1");
    cif(path, "batch plan.toml --jobs 1").succeeds();
    assert_eq!(other.ends(), Some(0));
    for name in ["a", "b", "c", "d"] {
        for seed in 0..2 {
            let record = record(path, &format!("train/{name}/seed{seed}"));
            assert_eq!((&record["state"], &record["attempts"]), (&Value::from("done"), &Value::from(1)));
        }
    }
}

#[test]
fn benches_are_jobs_with_the_same_tables() {
    let bench = format!(
        "[[bench]]\nname = \"heads\"\ncommand = \"compare captures/a -o {{output}}/compare --heads cif,gaussian-grouping --seeds 1 \
         --iterations 8 --set stages.coarse=6 --set stages.fine=8 --set densify.max_gaussians=600 {SMALL_MODEL}\"\n\
         [[bench]]\nname = \"ladder\"\ncommand = \"accuracy captures/a -o {{output}}/accuracy --ladders render --set stages.coarse=6 \
         --set stages.fine=8 --set stages.instance=4 --set densify.max_gaussians=600 {SMALL_MODEL}\"\n"
    );
    let folder = with_plan(&["a"], &bench);
    let path = folder.path();
    let whole = bench.split('"').nth(3).unwrap().replace("{output}", "whole");
    cif(path, &format!("bench {whole} -q")).succeeds();
    let run = cif(path, "batch plan.toml").succeeds();
    assert!(
        run.stderr.contains("heads/a.seed0.base: done") && run.stderr.contains("ladder/base: done"),
        "{}",
        run.stderr
    );
    let table = |folder: &str| {
        let text = fs::read_to_string(path.join(folder).join("compare/panoptic.csv")).unwrap();
        // The last columns are times.
        text.lines().map(|line| line.split(',').take(8).collect::<Vec<_>>().join(",")).collect::<Vec<_>>()
    };
    assert_eq!(table("results"), table("whole"));
    assert!(path.join("results/accuracy/report.html").is_file());
    let page = fs::read_to_string(path.join("results/index.html")).unwrap();
    assert!(page.contains("compare/compare.html") && page.contains("accuracy/report.html"));
    // What is made from another image is made again, and the tables with it.
    let images = path.join("captures/a/rgb/1x");
    let mut names: Vec<_> = fs::read_dir(images).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    fs::copy(&names[1], &names[0]).unwrap();
    let again = cif(path, "batch plan.toml --list").succeeds().stdout;
    let stale = |id: &str| {
        again
            .lines()
            .any(|line| line.trim_start().starts_with(id) && line.contains("its capture has changed"))
    };
    assert!(stale("heads/a.seed0.base ") && stale("heads/a.seed0.cif ") && stale("ladder/base "), "{again}");
    cif(path, "bench compare captures/a -o x --heads cif --only a.seed0.sa4d")
        .fails(2, &["a.seed0.base, a.seed0.cif"]);
    cif(path, "bench accuracy captures/a -o x --ladders render --only nothing").fails(2, &["the rungs are"]);
}

#[test]
fn engines_get_a_task_for_every_job() {
    let folder = with_plan(&["a", "b"], &plan("[resources]\nthreads = 2\nmemory_gib = 1.5\ntime = \"2h\"\n"));
    let path = folder.path();
    // A task has the threads that the plan gives it, whatever its machine has.
    cif(path, "batch plan.toml --job train:0").succeeds();
    let log = fs::read_to_string(path.join("results/jobs/train/a/run.log")).unwrap();
    assert!(log.starts_with("$ cif train captures/a ") && log.contains(" --threads 2\n"), "{log}");
    for (engine, file) in [("openjd", "job.json"), ("slurm", "job.sh"), ("hyperqueue", "job.toml")] {
        let line = format!("batch plan.toml --for {engine} -o {file}");
        cif(path, &line).succeeds();
        cif(path, &line).fails(1, &[file, "--force"]);
    }
    let template = json(&fs::read_to_string(path.join("job.json")).unwrap());
    assert_eq!(template["specificationVersion"], "jobtemplate-2023-09");
    let eval = &template["steps"][1];
    assert_eq!(
        (&eval["name"], &eval["dependencies"][0]["dependsOn"]),
        (&Value::from("eval"), &Value::from("train"))
    );
    assert_eq!(eval["parameterSpace"]["taskParameterDefinitions"][0]["range"], "0-1");
    assert_eq!(eval["script"]["actions"]["onRun"]["timeout"], 7_200);
    let script = fs::read_to_string(path.join("job.sh")).unwrap();
    for part in
        ["--array=0-1", "--cpus-per-task=2", "--mem=1536M", "--time=120", "--dependency=\"afterany:$STEP_0\""]
    {
        assert!(script.contains(part), "{part} in {script}");
    }
    let tasks: toml::Table = toml::from_str(&fs::read_to_string(path.join("job.toml")).unwrap()).unwrap();
    let tasks = tasks["task"].as_array().unwrap();
    assert_eq!(tasks.len(), 5);
    assert_eq!(tasks[2]["deps"].as_array().unwrap()[0].as_integer(), Some(0));
    assert_eq!(tasks[4]["deps"].as_array().unwrap().len(), 4);
}

#[test]
fn plans_that_cannot_be_run_are_refused() {
    let folder = with_plan(&["a"], "captures = [\"captures/*\"]\npreset = [\"draft\"]\n");
    let path = folder.path();
    cif(path, "batch plan.toml").fails(1, &["plan.toml", "unknown field `preset`", "cif batch --help"]);
    cif(path, "batch nothing.toml").fails(1, &["nothing.toml"]);
    fs::write(
        path.join("plan.toml"),
        "captures = [\"captures/*\"]\n[[bench]]\nname = \"x\"\ncommand = \"step a\"\n",
    )
    .unwrap();
    cif(path, "batch plan.toml").fails(1, &["cif bench step has no parts"]);
    fs::write(path.join("plan.toml"), plan("")).unwrap();
    cif(path, "batch plan.toml --job nothing").fails(1, &["has no job `nothing`", "train (1)"]);
    cif(path, "batch plan.toml --keep-going").fails(2, &["--job"]);
    cif(path, "batch plan.toml --list --collect").fails(2, &["--list"]);
    assert!(!path.join("results").exists());
}
