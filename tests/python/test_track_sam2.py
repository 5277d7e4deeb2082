"""The example that tracks painted keyframes with SAM 2: a tiny random model tests the way, not the masks.

Runs in an environment with torch, torchvision and transformers; the example says which.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed here: see examples/track_sam2.py")

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
import track_sam2  # noqa: E402

pytestmark = pytest.mark.filterwarnings("default")

SIDE = 128
"""Side of the pictures of the model, pixels."""


def frames(folder: Path, count: int) -> None:
    folder.mkdir()
    for place in range(count):
        picture = np.full((48, 64, 3), 90, np.uint8)
        picture[10:30, 5 + 4 * place : 25 + 4 * place] = (220, 40, 30)
        Image.fromarray(picture).save(folder / f"{place:06d}.png")


def painted(folder: Path, name: str, large: int = 300) -> np.ndarray:
    folder.mkdir(exist_ok=True)
    ids = np.zeros((48, 64), np.uint16)
    ids[10:30, 5:25] = 7
    ids[35:45, 40:60] = large
    Image.fromarray(ids).save(folder / f"{name}.png")
    return ids


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, model: Path) -> int:
    words = [folder / "images", folder / "painted", "-o", folder / "masks", "--model", model]
    monkeypatch.setattr(sys, "argv", ["track_sam2.py", *map(str, words)])
    return track_sam2.main()


def test_keyframes_are_checked(tmp_path: Path, monkeypatch, capsys) -> None:
    frames(tmp_path / "images", 2)
    painted(tmp_path / "painted", "000007")
    assert run(monkeypatch, tmp_path, tmp_path) == 1
    assert "000007.png: no image has this name" in capsys.readouterr().err
    (tmp_path / "painted" / "000007.png").unlink()
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "painted" / "000001.png")
    assert run(monkeypatch, tmp_path, tmp_path) == 1
    assert "no keyframe shows an object" in capsys.readouterr().err
    assert run(monkeypatch, tmp_path, tmp_path / "nothing") == 1
    assert "no such folder" in capsys.readouterr().err
    assert not (tmp_path / "masks").exists()


def test_masks_hold_large_ids_and_their_labels(tmp_path: Path) -> None:
    ids = painted(tmp_path / "painted", "000000")
    track_sam2.write_masks(tmp_path / "masks", ["a", "b"], [ids, np.minimum(ids, 7)], None)
    assert (np.array(Image.open(tmp_path / "masks" / "a.png")) == ids).all()
    with Image.open(tmp_path / "masks" / "b.png") as narrow:
        assert narrow.mode == "L"
    assert [one["id"] for one in json.loads((tmp_path / "masks" / "instances.json").read_text())] == [7, 300]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["masks", "painted"]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    reason = "torch and transformers are not installed here: see examples/track_sam2.py"
    torch = pytest.importorskip("torch", reason=reason)
    pytest.importorskip("torchvision", reason=reason)
    transformers = pytest.importorskip("transformers", reason=reason)
    torch.manual_seed(0)
    # Sizes that the model accepts: hidden ones a multiple of 64, memory of 64, no global attention at an end of
    # a stage.
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=12,
        num_attention_heads=1,
        blocks_per_stage=[1, 2, 1, 1],
        embed_dim_per_stage=[12, 24, 48, 96],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        image_size=[SIDE, SIDE],
        global_attention_blocks=[2],
        window_positional_embedding_background_size=[7, 7],
        window_size_per_stage=[4, 4, 4, 4],
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[96, 48, 24, 12],
        backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
        fpn_hidden_size=128,
    )
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={
            "hidden_size": 128,
            "image_size": SIDE,
            "patch_size": 16,
            "mask_input_channels": 8,
        },
        mask_decoder_config={
            "hidden_size": 128,
            "mlp_dim": 64,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 32,
        },
        image_size=SIDE,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=64,
        memory_attention_rope_feat_sizes=[SIDE // 16] * 2,
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=64,
        memory_fuser_num_layers=1,
    )
    folder = tmp_path_factory.mktemp("sam2")
    transformers.Sam2VideoModel(config).eval().save_pretrained(folder)
    images = getattr(transformers, "Sam2ImageProcessor", None) or transformers.Sam2ImageProcessorFast
    side, small = {"height": SIDE, "width": SIDE}, {"height": SIDE // 4, "width": SIDE // 4}
    processor = transformers.Sam2VideoProcessor(
        image_processor=images(size=side, mask_size=small),
        video_processor=transformers.Sam2VideoVideoProcessor(size=side),
        target_size=SIDE,
    )
    processor.save_pretrained(folder)
    return folder


def test_every_image_gets_a_mask_and_keyframes_stay(tmp_path: Path, monkeypatch, model: Path) -> None:
    frames(tmp_path / "images", 4)
    ids = painted(tmp_path / "painted", "000001")
    table = [{"id": 7, "label": "box", "taxonomies": {"coco": "book"}}, {"id": 300, "label": "shadow"}]
    (tmp_path / "painted" / "instances.json").write_text(json.dumps(table))
    assert run(monkeypatch, tmp_path, model) == 0
    masks = [np.array(Image.open(tmp_path / "masks" / f"{place:06d}.png")) for place in range(4)]
    assert (masks[1] == ids).all()
    assert all(mask.shape == (48, 64) and set(np.unique(mask)) <= {0, 7, 300} for mask in masks)
    assert json.loads((tmp_path / "masks" / "instances.json").read_text()) == table
    assert run(monkeypatch, tmp_path, model) == 1, "nothing is overwritten"
