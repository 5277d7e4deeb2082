"""Track painted objects through the frames of a camera with SAM 2, and write masks that `cif train` reads.

In an environment of its own, because torch is large:

    pip install torch torchvision transformers pillow numpy
    python examples/track_sam2.py captures/table/rgb/1x painted -o table-masks --model sam2-hiera-small
    cif train captures/table --masks table-masks -o table.cif

The model is a folder on this machine, as `Sam2VideoModel.save_pretrained` and the same of its processor
write it; nothing is downloaded. Keyframes are PNG files of ids, 0 for unlabelled, named as the images that
they show, as `cif masks propagate` takes them. Every object is prompted with its painted mask in every
keyframe that shows it, and followed from the first keyframe to the last image, and back to the first one. A
pixel has the object whose mask is surest there; keyframes stay as they were painted. Images of several
cameras are tracked camera by camera, or as one sequence that `cif masks zigzag` writes and `cif masks split`
takes apart.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

ENDINGS = (".png", ".jpg", ".jpeg")


def main() -> int:
    """Read, track, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "images", type=Path, help="folder with the images of one camera, in the order of their names"
    )
    parser.add_argument("keyframes", type=Path, help="folder with painted masks, named as the images")
    parser.add_argument("-o", "--output", type=Path, required=True, help="new folder for the masks")
    parser.add_argument(
        "--model", type=Path, required=True, help="folder with a SAM 2 video model and its processor"
    )
    parser.add_argument("--device", default="cpu", help="device of torch: cpu, cuda, mps")
    arguments = parser.parse_args()
    if arguments.output.exists():
        return refuse(f"{arguments.output}: something is there already; give a new folder")
    if not arguments.model.is_dir():
        return refuse(f"{arguments.model}: there is no such folder; give one with a SAM 2 video model")
    try:
        images = image_files(arguments.images)
        keyframes = read_keyframes(arguments.keyframes, images)
    except ValueError as problem:
        return refuse(str(problem))
    masks = track(arguments.model, images, keyframes, arguments.device)
    labels = arguments.keyframes / "instances.json"
    write_masks(arguments.output, [path.stem for path in images], masks, labels if labels.is_file() else None)
    ids = sorted({int(one) for mask in masks for one in np.unique(mask)} - {0})
    print(f"{len(masks)} masks of {len(ids)} objects in {arguments.output}")
    return 0


def refuse(problem: str) -> int:
    """Tell a problem and fail."""
    print(f"error: {problem}", file=sys.stderr)
    return 1


def image_files(folder: Path) -> list[Path]:
    """Images of a folder in the order of their names."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder of images")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    if not found:
        raise ValueError(f"{folder}: no PNG or JPEG file in it")
    if len({path.stem for path in found}) < len(found):
        raise ValueError(f"{folder}: two images have the same name; keep one of them")
    return found


def read_keyframes(folder: Path, images: list[Path]) -> dict[int, np.ndarray]:
    """Painted ids by the place of the image, each `[height, width]`."""
    places = {path.stem: place for place, path in enumerate(images)}
    keyframes = {}
    for path in sorted(folder.glob("*.png")):
        if path.stem not in places:
            raise ValueError(f"{path}: no image has this name; name keyframes as the images")
        picture = Image.open(path)
        if picture.mode not in ("L", "P", "I;16", "I", "1"):
            raise ValueError(f"{path}: a picture in colours ({picture.mode}); save ids as grey or palette PNG")
        ids = np.array(picture).astype(np.uint16)
        with Image.open(images[places[path.stem]]) as image:
            if ids.shape != (image.height, image.width):
                found, expected = f"{ids.shape[1]} x {ids.shape[0]}", f"{image.width} x {image.height}"
                raise ValueError(f"{path}: {found} pixels, its image has {expected}")
        keyframes[places[path.stem]] = ids
    if not any(ids.any() for ids in keyframes.values()):
        raise ValueError(f"{folder}: no keyframe shows an object; paint each with an id from 1 to 65535")
    return keyframes


def track(
    model_folder: Path, images: list[Path], keyframes: dict[int, np.ndarray], device: str
) -> list[np.ndarray]:
    """Ids of all images, each `[height, width]`."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    import torch
    from transformers import Sam2VideoModel, Sam2VideoProcessor

    model = Sam2VideoModel.from_pretrained(model_folder, local_files_only=True).to(device).eval()
    processor = Sam2VideoProcessor.from_pretrained(model_folder, local_files_only=True)
    pictures = [Image.open(path).convert("RGB") for path in images]
    session = processor.init_video_session(video=pictures, inference_device=device, dtype=torch.float32)
    masks: list[np.ndarray] = [np.zeros((picture.height, picture.width), np.uint16) for picture in pictures]

    def keep(output) -> None:
        size = [[session.video_height, session.video_width]]
        logits = processor.post_process_masks([output.pred_masks], original_sizes=size, binarize=False)[0][:, 0]
        surest, which = logits.max(0)
        ids = np.array(list(session.obj_ids), np.uint16)[which.cpu().numpy()]
        masks[output.frame_idx] = ids * (surest > 0).cpu().numpy()

    first = min(place for place, ids in keyframes.items() if ids.any())
    with torch.inference_mode():
        for place, ids in sorted(keyframes.items()):
            present = [int(one) for one in np.unique(ids) if one]
            if not present:
                continue
            processor.add_inputs_to_inference_session(
                inference_session=session,
                frame_idx=place,
                obj_ids=present,
                input_masks=[ids == one for one in present],
            )
            model(inference_session=session, frame_idx=place)
        for output in model.propagate_in_video_iterator(session, start_frame_idx=first):
            keep(output)
        if first > 0:
            for output in model.propagate_in_video_iterator(session, start_frame_idx=first, reverse=True):
                keep(output)
    for place, ids in keyframes.items():
        masks[place] = ids
    return masks


def write_masks(output: Path, names: list[str], masks: list[np.ndarray], labels: Path | None) -> None:
    """Write PNG files of ids, 8 bits where they fit, and the labels; the folder appears when it is whole."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=".track-") as unfinished:
        folder = Path(unfinished) / "masks"
        folder.mkdir()
        for name, ids in zip(names, masks, strict=True):
            Image.fromarray(ids if ids.max(initial=0) > 255 else ids.astype(np.uint8)).save(
                folder / f"{name}.png"
            )
        if labels is not None:
            shutil.copyfile(labels, folder / "instances.json")
        else:
            ids = sorted({int(one) for mask in masks for one in np.unique(mask)} - {0})
            table = [{"id": one, "label": f"instance_{one}"} for one in ids]
            (folder / "instances.json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
        folder.rename(output)


if __name__ == "__main__":
    sys.exit(main())
