"""Training in process: callbacks, Ctrl-C, going on."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cif
import numpy as np
import pytest

CAPTURE = Path(__file__).parents[2] / "examples" / "tabletop-mini"
SMALL = {
    "stages": {"coarse": 6, "fine": 6, "instance": 6},
    "model": {"max_initial_points": 300, "spatial_resolution": [8, 8, 8], "channels": 4, "width": 16},
    "motion.rehearsal": 3,
    "motion.rigid": False,
    "report.step_every": 1,
    "report.curve_frames": 1,
}
ENDLESS = {
    **SMALL,
    "stages.coarse": 10_000_000,
    "report.step_every": 10_000_000,
    "report.checkpoint_seconds": 1,
}


@pytest.fixture(scope="module")
def dataset() -> cif.Dataset:
    return cif.open_dataset(CAPTURE)


@pytest.fixture(autouse=True)
def interrupts() -> Iterator[None]:
    """Let Ctrl-C raise, which programs that are started in the background ignore."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@contextmanager
def ctrl_c(saved: Path) -> Iterator[None]:
    """Press Ctrl-C once a run has saved a state, which it does after a second."""

    def press() -> None:
        while not saved.exists() and not done.is_set():
            time.sleep(0.02)
        if not done.wait(0.1):
            os.kill(os.getpid(), signal.SIGINT)

    done = threading.Event()
    thread = threading.Thread(target=press)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_a_field_is_trained_and_the_callback_told(dataset: cif.Dataset, tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    threads = set()

    def callback(event: dict[str, Any]) -> None:
        threads.add(threading.current_thread())
        events.append(event)

    field = cif.train(dataset, settings=SMALL, seed=3, callback=callback)
    assert threads == {threading.current_thread()}
    steps = [event for event in events if event["event"] == "step"]
    assert {"stage", "iteration", "loss", "psnr", "gaussians"} <= steps[0].keys()
    assert {event["stage"] for event in steps} == {"coarse", "fine", "instance"}
    assert events[-1]["event"] == "finished"
    assert field.identities is not None and len(field) == steps[-1]["gaussians"]
    # By its folder and into a file it is the same.
    again = cif.train(CAPTURE, tmp_path / "a.cif", settings=SMALL, seed=3)
    assert np.array_equal(again.means, field.means)
    assert np.array_equal(cif.Field.load(tmp_path / "a.cif").identities, field.identities)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.cif", "a.train.toml"]
    with pytest.raises(cif.CifError, match=r"a\.cif exists"):
        cif.train(dataset, tmp_path / "a.cif", settings=SMALL)


def test_false_stops_and_resume_goes_on(dataset: cif.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "a.cif"
    steps = []

    def until_eight(event: dict[str, Any]) -> bool:
        steps.extend([event] if event["event"] == "step" else [])
        return len(steps) < 8

    stopped = cif.train(dataset, path, settings=SMALL, callback=until_eight)
    assert len(steps) == 8 and stopped.identities is None
    with pytest.raises(cif.CifError, match="interrupted"):
        cif.train(dataset, path, settings=SMALL)
    with pytest.raises(ValueError, match="come from the output"):
        cif.train(dataset, path, seed=3, resume=True)
    resumed = cif.train(dataset, path, resume=True)
    whole = cif.train(dataset, settings=SMALL)
    assert np.array_equal(resumed.means, whole.means)
    assert np.array_equal(resumed.identities, whole.identities)


def test_exceptions_and_ctrl_c_stop_save_and_are_raised(dataset: cif.Dataset, tmp_path: Path) -> None:
    def fails(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        cif.train(dataset, tmp_path / "a.cif", settings=SMALL, callback=fails)
    assert len(cif.train(dataset, tmp_path / "a.cif", resume=True)) > 0
    path = tmp_path / "b.cif"
    with pytest.raises(KeyboardInterrupt), ctrl_c(path):
        cif.train(dataset, path, settings=ENDLESS)
    seen: list[str] = []

    def until_a_stage(event: dict[str, Any]) -> bool:
        seen.append(event["event"])
        return event["event"] != "stage_started"

    assert len(cif.train(dataset, path, resume=True, callback=until_a_stage)) > 0
    assert seen[0] == "phase_started" and "finished" not in seen
    with pytest.raises(cif.CifError, match="before the first step"):
        cif.train(dataset, path, resume=True, callback=lambda event: False)


def test_wrong_arguments_are_named(dataset: cif.Dataset, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="draft, standard, best or paper"):
        cif.train(dataset, preset="quick")
    with pytest.raises(ValueError, match="auto, cpu or wgpu"):
        cif.train(dataset, backend="abacus")
    with pytest.raises(cif.CifError, match=r"iteratons.*did you mean"):
        cif.train(dataset, settings={"stages.iteratons": 3})
    for settings in ({"rates.opacity": float("nan")}, {"rates": {"opacity": float("inf")}}):
        with pytest.raises(ValueError, match=r"rates.*opacity is (nan|inf)"):
            cif.train(dataset, settings=settings)
    with pytest.raises(ValueError, match="opened"):
        cif.train(dataset, settings={"downscale": 2})
    with pytest.raises(ValueError, match="output"):
        cif.train(dataset, resume=True)
    with pytest.raises(cif.CifError, match="nowhere"):
        cif.train(tmp_path / "nowhere")
    assert "callback" in cif.train.__doc__


def test_the_command_leaves_signals_to_the_program(tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    path = tmp_path / "a.cif"
    settings = ["--set=model.spatial_resolution=[8,8,8]"]
    # --stop-after counts the steps that are told of.
    told = {**ENDLESS, "report.step_every": 1}
    plain = {key: value for key, value in told.items() if not isinstance(value, dict)}
    settings += [f"--set={key}={json.dumps(value)}" for key, value in plain.items()]
    with pytest.raises(KeyboardInterrupt), ctrl_c(path):
        cif.run(["train", CAPTURE, "-o", path, "--quiet", *settings])
    assert cif.run(["train", CAPTURE, "-o", path, "--quiet", "--resume", "--stop-after", "1"]) == 0
    assert signal.getsignal(signal.SIGINT) is handler
    # Neither swallowed nor the end of the interpreter.
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
