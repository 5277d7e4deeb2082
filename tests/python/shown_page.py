"""A page of `cif view` in Chromium: what it draws and holds, and what it reported and loaded."""

from __future__ import annotations

import importlib.util
import io
import os
import shutil
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cif
import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page, Playwright

NAMES = [os.environ.get("CIF_TEST_CHROMIUM"), "chromium", "chromium-browser", "google-chrome"]
CHROMIUM = next(filter(None, (shutil.which(name) for name in NAMES if name)), None)
LACKING = [name for name in ("playwright", "PIL", "pxr") if importlib.util.find_spec(name) is None]
LACKING += [] if CHROMIUM else ["Chromium"]
REASON = f"{', '.join(LACKING)} not found: see tests/README.md"
NEEDED = pytest.mark.skipif(bool(LACKING) and os.environ.get("CIF_TEST_PAGE") != "require", reason=REASON)

DRAWING = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TWO_FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
# Splats as the page draws them at a time code: all, in their own colours, where plain is true.
DRAW = """([shot, code, plain]) => {
  const { engine } = cif, before = engine.code;
  engine.setTime(code);
  const drawn = engine.pixels(shot, 0.3, plain);
  engine.setTime(before);
  return drawn;
}"""
READ = """(canvas) => [canvas.width, canvas.height,
  canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]"""
MARK = """JSON.stringify([cif.state, cif.shot().pose, document.activeElement.id,
  document.documentElement.dataset.theme, document.getElementById('help-dialog').open])"""


def until(is_so: Callable[[], Any]) -> None:
    end = time.monotonic() + 20
    while not is_so():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def launch(playwright: Playwright, *arguments: str) -> Browser:
    return playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *(arguments or DRAWING)])


class ShownPage:
    """A page in the browser."""

    def __init__(self, page: Page, address: str) -> None:
        self.page, self.address, self.mouse = page, address, page.mouse
        self.loaded: list[str] = []
        self.problems: list[str] = []
        page.on("request", lambda request: self.loaded.append(request.url))
        page.on("websocket", lambda socket: self.loaded.append(socket.url))
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("dialog", lambda dialog: (self.problems.append(dialog.message), dialog.dismiss()))
        page.on("console", self._note)

    def _note(self, message: Any) -> None:
        # The browser's own word on how long it takes to read pixels is no problem of the page.
        if message.type in ("error", "warning") and "GPU stall due to ReadPixels" not in message.text:
            self.problems.append(f"{message.type}: {message.text}")

    def open(self) -> str | None:
        """Loads the page, and returns its state."""
        self.page.goto(self.address)
        return self.page.wait_for_selector("html[data-state]").get_attribute("data-state")

    def get(self, script: str, argument: Any = None) -> Any:
        """The value of a script."""
        return self.page.evaluate(script, argument)

    def state(self, key: str) -> Any:
        """Something that users change."""
        return self.get("(key) => cif.state[key]", key)

    def document(self) -> dict[str, Any]:
        """The scene."""
        return self.get("cif.engine.document")

    def find(self, selector: str, **options: Any) -> Locator:
        """Elements."""
        return self.page.locator(selector, **options)

    def text(self, selector: str) -> str:
        """The text that an element shows."""
        return self.find(selector).inner_text()

    def press(self, *commands: str) -> None:
        """Clicks at buttons, by their commands."""
        for command in commands:
            self.find(f"button[data-command={command}]").click()

    def keys(self, *keys: str) -> None:
        """Presses keys."""
        for key in keys:
            self.page.keyboard.press(key)

    def hold(self, *keys: str) -> None:
        """Holds keys down until a picture was drawn."""
        for key in keys:
            self.page.keyboard.down(key)
        self.settle()
        for key in reversed(keys):
            self.page.keyboard.up(key)

    def go(self, code: float) -> None:
        """Scrubs to a time code."""
        self.find("#scrub").fill(str(code))

    def select(self, label: str) -> dict[str, Any]:
        """Selects an object in the list."""
        self.find("#list .item", has_text=label).first.click()
        return self.document()["nodes"][self.state("selected")]

    def settle(self) -> None:
        """Waits until changes are drawn."""
        self.get(TWO_FRAMES)

    def mark(self) -> str:
        """Everything that a key or a button may change."""
        self.settle()
        return self.get(MARK)

    def shot(self) -> dict[str, Any]:
        """The camera of the picture."""
        self.settle()
        return self.get("cif.shot()")

    def draw(self, code: float, shot: dict[str, Any], plain: bool = True) -> np.ndarray:
        """What the engine draws, `[H, W, 3]` in [0, 1]."""
        drawn = np.array(self.get(DRAW, [shot, code, plain]), np.uint8)
        return drawn.reshape(*reversed(shot["size"]), 4)[..., :3] / 255

    def canvas(self, selector: str) -> np.ndarray:
        """What a 2D canvas holds, uint8 `[H, W, 4]`."""
        self.settle()
        width, height, values = self.find(selector).evaluate(READ)
        return np.array(values, np.uint8).reshape(height, width, 4)

    def screen(self, size: tuple[int, int]) -> np.ndarray:
        """The picture on the screen, reduced to a size, `[H, W, 3]` in [0, 1]."""
        from PIL import Image

        self.settle()
        picture = Image.open(io.BytesIO(self.find("#picture").screenshot())).convert("RGB")
        return np.asarray(picture.resize(size, Image.Resampling.BOX)) / 255


def psnr(a: np.ndarray, b: np.ndarray, where: Any = ...) -> float:
    """Decibels, of values in [0, 1]."""
    return float(-10 * np.log10(np.mean((a[where] - b[where]) ** 2)))


def matrix_of(pose: list[float]) -> np.ndarray:
    """A pose of the page, `[4, 4]`."""
    w, i, j, k = np.array(pose[3:]) / np.linalg.norm(pose[3:])
    cross = np.array([[0, -k, j], [k, 0, -i], [-j, i, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * cross + cross @ cross)
    matrix[:3, 3] = pose[:3]
    return matrix


def camera_of(shot: dict[str, Any]) -> cif.Camera:
    """A camera of the page as one of cif."""
    inverse = np.linalg.inv(matrix_of(shot["pose"]))
    return cif.Camera(*shot["size"], tuple(shot["focal"]), tuple(shot["principal"]), inverse)


class NodeSplats:
    """Splats of a field as they stand at time 0, with the node of the page that each belongs to."""

    def __init__(self, field: cif.Field, document: dict[str, Any]) -> None:
        counts = [node["splats"]["count"] for node in document["nodes"]]
        self.field, self.nodes = field, np.repeat(np.arange(len(counts)), counts)
        self.background = tuple(document["background"])
        self.by_node = np.array([node["color"] for node in document["nodes"]])[self.nodes] / 255
        assert len(self.nodes) == len(field) and field.sh_degree == 1

    def colors(self, eye: list[float]) -> np.ndarray:
        """Colours as seen from a point, `[N, 3]`."""
        away = self.field.means - eye
        x, y, z = (away / np.linalg.norm(away, axis=1, keepdims=True)).T[..., None]
        sh = self.field.sh_coefficients
        return 0.5 + 0.28209479 * sh[:, 0] + 0.48860251 * (z * sh[:, 2] - y * sh[:, 1] - x * sh[:, 3])

    def render(self, camera: cif.Camera, colors: np.ndarray, rows: Any = ...) -> dict[str, np.ndarray]:
        """A picture of some of the splats, whose labels are nodes plus 1."""
        names = ("means", "scales", "quaternions", "opacities")
        nodes = np.eye(self.nodes.max() + 1, dtype=np.float32)[self.nodes[rows]]
        field = cif.Field.from_arrays(
            **{name: getattr(self.field, name)[rows] for name in names},
            colors=colors[rows].clip(0, None).astype(np.float32),
            identities=nodes,
            instances=[{"id": k + 1, "label": str(k), "category": ""} for k in range(nodes.shape[1])],
            background=self.background,
        )
        return field.render(camera)
