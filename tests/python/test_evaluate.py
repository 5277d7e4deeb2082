"""Scores in process are those of the command."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path

import cif
import pytest
from test_train import CAPTURE, SMALL


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scored") / "scene.cif"
    cif.train(CAPTURE, path, settings=SMALL, seed=3)
    return path


def test_scores_are_those_of_the_command(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "scores.json"
    assert cif.run(["eval", scene, CAPTURE, "--json", out]) == 0
    told = json.loads(out.read_text())
    scores = cif.evaluate(scene, CAPTURE)
    assert scores["seconds"] > 0 and isinstance(scores["warnings"], list)
    # What the clock decides differs from run to run.
    for key in ["render_ms_per_frame", "seconds", "warnings"]:
        told.pop(key, None)
        scores.pop(key)
    for report in [told, scores]:
        (report["motion"] or {}).pop("seconds", None)
        for frame in report["per_frame"]:
            frame.pop("render_ms")
    assert scores == told and scores["psnr"] > 0 and scores["instances"]
    again = cif.evaluate(cif.Field.load(scene), cif.open_dataset(CAPTURE))
    for key in ["psnr", "ssim", "miou", "macc_pix"]:
        assert again[key] == scores[key], key
    training = cif.evaluate(scene, CAPTURE, split="train", downscale=2)
    assert training["frames"] != scores["frames"] and training["psnr"] != scores["psnr"]


def test_what_cannot_be_scored_is_named(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="val or train"):
        cif.evaluate(scene, CAPTURE, split="test")
    with pytest.raises(ValueError, match="where the capture is opened"):
        cif.evaluate(scene, cif.open_dataset(CAPTURE), downscale=2)
    with pytest.raises(cif.CifError, match="nowhere"):
        cif.evaluate(tmp_path / "nowhere.cif", CAPTURE)
    with pytest.raises(cif.CifError, match="nowhere"):
        cif.evaluate(scene, tmp_path / "nowhere")


def test_ctrl_c_ends_it(scene: Path) -> None:
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
    try:
        with pytest.raises(KeyboardInterrupt):
            timer.start()
            while True:
                cif.evaluate(scene, CAPTURE)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, handler)
