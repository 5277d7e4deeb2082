"""Preprocessing of pictures by Pillow and numpy, as the authors of the models do it: makes preprocessing.json.

python preprocessing.py > preprocessing.json      # needs pillow and numpy
"""

from __future__ import annotations

import json
import sys

import numpy as np
from PIL import Image

IMAGENET = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
CLIP = ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711])
FILTERS = {"bilinear": Image.Resampling.BILINEAR, "bicubic": Image.Resampling.BICUBIC}
SMALL = [((23, 17), to) for to in [(40, 30), (9, 5), (23, 30), (9, 17), (1, 1)]]
SIZES = [(640, 480), (480, 640), (1920, 1080), (3000, 500), (800, 800), (800, 1000), (64, 48), (333, 1000)]
SAMPLES = 240


def picture(width: int, height: int) -> Image.Image:
    """Stripes, edges and noise that every language makes alike."""
    y, x = np.mgrid[0:height, 0:width]
    red = (x * 37 + y * 91 + x * y * 13) % 256
    green = np.where((x // 3 + y // 2) % 2 == 0, 255, 0)
    blue = (x * x * 7 + y * 3) % 256
    return Image.fromarray(np.stack([red, green, blue], axis=-1).astype(np.uint8))


def short_side(width: int, height: int, size: int, longest: int) -> tuple[int, int]:
    """Follows `get_size_with_aspect_ratio` of DETR."""
    low, high = float(min(width, height)), float(max(width, height))
    if high / low * size > longest:
        size = round(longest * low / high)
    if (width <= height and width == size) or (height <= width and height == size):
        return width, height
    if width < height:
        return size, int(size * height / width)
    return int(size * width / height), size


def long_side(width: int, height: int, length: int) -> tuple[int, int]:
    """Follows `ResizeLongestSide.get_preprocess_shape` of Segment Anything."""
    scale = length * 1.0 / max(height, width)
    return int(width * scale + 0.5), int(height * scale + 0.5)


def tensor(image: Image.Image, statistics: tuple[list[float], list[float]], canvas: tuple[int, int]) -> dict:
    """Every so many values of `[3, height, width]`, normalised and padded."""
    mean, deviation = (np.array(values, np.float32) for values in statistics)
    values = (np.asarray(image).astype(np.float32) / 255 - mean) / deviation
    padded = np.zeros((canvas[1], canvas[0], 3), np.float32)
    padded[: image.height, : image.width] = values
    planes = padded.transpose(2, 0, 1).ravel()
    every = planes.size // SAMPLES
    return {"length": planes.size, "every": every, "values": [round(float(v), 6) for v in planes[::every]]}


def main() -> None:
    """Write everything."""
    resized = [
        {"from": of, "to": to, "filter": name, "bytes": picture(*of).resize(to, FILTERS[name]).tobytes().hex()}
        for of, to in SMALL
        for name in FILTERS
    ]
    sizes = [
        {"from": of, "short": short_side(*of, 800, 1333), "long": long_side(*of, 1024)}
        for of in [
            (640, 480),
            (480, 640),
            (1920, 1080),
            (3000, 500),
            (800, 800),
            (800, 1000),
            (64, 48),
            (333, 1000),
        ]
    ]
    image = picture(64, 48)
    to, inside = short_side(64, 48, 800, 1333), long_side(64, 48, 1024)
    made = {
        "grounding": tensor(image.resize(to, FILTERS["bilinear"]), IMAGENET, to),
        "segment": tensor(image.resize(inside, FILTERS["bilinear"]), IMAGENET, (1024, 1024)),
        "embedding": tensor(picture(300, 300).resize((224, 224), FILTERS["bicubic"]), CLIP, (224, 224)),
    }
    json.dump({"resized": resized, "sizes": sizes, "tensors": made}, sys.stdout, separators=(",", ":"))
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
