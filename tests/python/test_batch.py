"""`cif batch` from the wheel, and its jobs in the engines of farms.

OpenJD runs where CIF_TEST_OPENJD names the program `openjd`; Slurm where its daemons are installed and this is
root, on a node that the test starts and stops; HyperQueue where `hq` is: see tests/README.md.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cif
import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "tabletop-mini"
CIF = Path(sys.executable).with_name("cif")
OPENJD = os.environ.get("CIF_TEST_OPENJD")
SLURM = ["munged", "slurmctld", "slurmd", "sbatch", "squeue"]

PLAN = """
captures = ["captures/*"]
capture_options = "--downscale 4"

[train]
options = \"\"\"--iterations-coarse 5 --iterations-fine 5 --iterations-instance 5 --max-gaussians 500
    --set model.spatial_resolution=[8,8,8] --set motion.rigid=false --set motion.parts=false
    --set motion.rehearsal=5 --effects all,-motion\"\"\"

[eval]
pictures = false

[engines]
command = ["{cif}"]
"""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    """A plan over three captures, of which one has images that are none."""
    for name in ("a", "b", "broken"):
        shutil.copytree(EXAMPLE, tmp_path / "captures" / name)
    for image in (tmp_path / "captures" / "broken" / "rgb").rglob("*.png"):
        image.write_text("no picture")
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(cif=CIF))
    return path


def run(plan: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(words, cwd=plan.parent, capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    return done


def states(plan: Path) -> dict[str, str]:
    listed = json.loads(run(plan, str(CIF), "batch", plan.name, "--list", "--json").stdout)
    return {job["id"]: job["state"].split(":")[0] for job in listed["jobs"]}


# What every engine has to leave: the rest is done, and whoever waits hears of the failure.
DONE = {
    "train/a/run": "done",
    "train/b/run": "done",
    "train/broken/run": "failed",
    "eval/a/run": "done",
    "eval/b/run": "done",
    "eval/broken/run": "waits",
    "collect": "done",
}


def test_jobs_run_from_the_wheel(plan: Path) -> None:
    failed = run(plan, str(CIF), "batch", plan.name, code=1)
    assert "1 of 7 jobs failed" in failed.stderr, failed.stderr
    assert states(plan) == DONE
    shutil.rmtree(plan.parent / "captures" / "broken")
    # From within a program of Python, whose jobs are processes of the same Python.
    shutil.rmtree(plan.parent / "results")
    script = f"import cif, sys; sys.exit(cif.run(['batch', {plan.name!r}]))"
    run(plan, sys.executable, "-c", script)
    assert set(states(plan).values()) == {"done"}
    assert cif.Field.load(plan.parent / "results" / "scenes" / "a" / "run" / "scene.cif").times


@pytest.mark.skipif(not OPENJD, reason="CIF_TEST_OPENJD names no program openjd: see tests/README.md")
def test_openjd_checks_and_runs_the_jobs(plan: Path) -> None:
    run(plan, str(CIF), "batch", plan.name, "--for", "openjd", "-o", "job.json")
    run(plan, OPENJD, "check", "job.json")
    done = subprocess.run(
        [OPENJD, "run", "job.json", "--step", "collect", "--run-dependencies"],
        cwd=plan.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0, "the last job fails, because one has failed"
    assert "1 of 7 jobs failed" in done.stdout + done.stderr, done.stdout + done.stderr
    assert states(plan) == DONE
    shutil.rmtree(plan.parent / "captures" / "broken")
    run(plan, str(CIF), "batch", plan.name, "--for", "openjd", "-o", "job.json", "--force")
    run(plan, OPENJD, "run", "job.json", "--step", "collect", "--run-dependencies")
    assert set(states(plan).values()) == {"done"}


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@contextmanager
def slurm(folder: Path) -> Iterator[dict[str, str]]:
    """A Slurm of one node, on this machine alone; its environment."""
    folder.mkdir()
    folder.chmod(0o755)
    host = socket.gethostname().split(".")[0]
    key = folder / "munge.key"
    key.write_bytes(os.urandom(64))
    key.chmod(0o400)
    munge = folder / "munge.socket"
    (folder / "slurm.conf").write_text(f"""
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={munge}
CryptoType=crypto/munge
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SchedulerParameters=sched_interval=1,bf_interval=1
NodeName={host} NodeAddr=127.0.0.1 CPUs={os.cpu_count()} State=UNKNOWN
PartitionName=test Nodes={host} Default=YES MaxTime=INFINITE State=UP
""")
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    munged = [
        "munged", "--foreground", "--force", f"--socket={munge}", f"--key-file={key}",
        f"--pid-file={folder}/munge.pid", f"--log-file={folder}/munge.log", f"--seed-file={folder}/munge.seed",
    ]  # fmt: skip
    commands = [munged, ["slurmctld", "-D"], ["slurmd", "-D", "-N", host]]
    running = []
    try:
        for command in commands:
            with (folder / f"{command[0]}.out").open("w") as log:
                running.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
            time.sleep(1)
        yield environment
    finally:
        for daemon in reversed(running):
            daemon.terminate()
        for daemon in running:
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()


@pytest.mark.skipif(
    any(shutil.which(name) is None for name in SLURM) or os.geteuid() != 0,
    reason="Slurm is not installed, or this is not root: see tests/README.md",
)
def test_slurm_runs_the_jobs(plan: Path, tmp_path: Path) -> None:
    run(plan, str(CIF), "batch", plan.name, "--for", "slurm", "-o", "job.sh")
    with slurm(tmp_path / "slurm") as environment:
        submitted = subprocess.run(
            ["sh", "job.sh"], cwd=plan.parent, env=environment, capture_output=True, text=True
        )
        assert submitted.returncode == 0, submitted.stderr
        assert "submitted; the last is" in submitted.stdout
        begun = time.monotonic()
        while subprocess.run(["squeue", "-h"], env=environment, capture_output=True, text=True).stdout.strip():
            assert time.monotonic() < begun + 240, [
                log.read_text() for log in (tmp_path / "slurm").glob("*.log")
            ]
            time.sleep(0.5)
    assert states(plan) == DONE
    logs = [log.read_text() for log in (plan.parent / "results" / "jobs" / "slurm").glob("cif-collect-*.log")]
    assert len(logs) == 1 and "1 of 7 jobs failed" in logs[0], logs


@pytest.mark.skipif(shutil.which("hq") is None, reason="HyperQueue is not installed: see tests/README.md")
def test_hyperqueue_runs_the_jobs(plan: Path, tmp_path: Path) -> None:
    run(plan, str(CIF), "batch", plan.name, "--for", "hyperqueue", "-o", "job.toml")
    server = ["hq", "--server-dir", str(tmp_path / "hq")]
    with subprocess.Popen([*server, "server", "start"], stdout=subprocess.DEVNULL) as daemon:
        time.sleep(1)
        with subprocess.Popen([*server, "worker", "start"], stdout=subprocess.DEVNULL) as worker:
            subprocess.run([*server, "job", "submit-file", "job.toml"], cwd=plan.parent, check=True)
            subprocess.run([*server, "job", "wait", "all"], check=False)
            worker.terminate()
        daemon.terminate()
    assert states(plan) == DONE
