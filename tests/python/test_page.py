"""The page of `cif view` and `cif export --html` in a browser: pictures, controls, and what it asks the network for.

Runs where Playwright and Pillow are installed (`make test-page`) and a Chromium is found: CIF_TEST_CHROMIUM names it,
else chromium, chromium-browser or google-chrome of the PATH is taken. CIF_TEST_PAGE=require fails without them.
"""

from __future__ import annotations

import base64
import csv
import importlib.util
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cif
import numpy as np
import pytest
from conftest import make_field, motion_of
from numpy.typing import NDArray

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Playwright

CAPTURE = Path(__file__).parents[2] / "examples" / "tabletop-mini"
NAMES = [os.environ.get("CIF_TEST_CHROMIUM"), "chromium", "chromium-browser", "google-chrome"]
CHROMIUM = next(filter(None, (shutil.which(name) for name in NAMES if name)), None)
LACKING = [name for name in ("playwright", "PIL") if importlib.util.find_spec(name) is None]
LACKING += [] if CHROMIUM else ["a Chromium"]
REASON = f"{', '.join(LACKING)} not found: see tests/README.md"
REQUIRED = os.environ.get("CIF_TEST_PAGE") == "require"
pytestmark = pytest.mark.skipif(bool(LACKING) and not REQUIRED, reason=REASON)

DRAWING = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Seconds of training; masks, motion that bends and motion in parts are there, fits of rigid bodies are not.
SETTINGS = {
    "stages": {"coarse": 100, "fine": 250, "instance": 60},
    "model.max_initial_points": 1500,
    "motion": {"gaussians": 150, "rehearsal": 150, "rigid": False},
    "report": {"step_every": 1000, "curve_frames": 1},
}
TIMES = [0, 17, 35, 53, 71]
# A picture of the splats at a time code, RGBA in base64: as seen where plain is false, else in their own colours.
PIXELS = """([shot, code, lowPass, plain]) => {
  const { engine } = cif;
  const before = engine.code;
  engine.setTime(code);
  const values = engine.pixels(shot ?? cif.shot(), lowPass, plain);
  engine.setTime(before);
  let text = '';
  for (let i = 0; i < values.length; i += 8192) text += String.fromCharCode(...values.subarray(i, i + 8192));
  return btoa(text);
}"""
CANVAS = """(canvas) => {
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let text = '';
  for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192));
  return [canvas.width, canvas.height, btoa(text)];
}"""
TWO_FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
Picture = NDArray[Any]


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    assert not LACKING, REASON
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="session")
def browser(playwright: Playwright) -> Iterator[Browser]:
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=DRAWING)
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "scene.cif"
    cif.train(CAPTURE, path, preset="draft", settings=SETTINGS, seed=1)
    return path


@pytest.fixture(scope="session")
def trained(scene: Path) -> cif.Field:
    return cif.Field.load(scene)


@pytest.fixture(scope="session")
def served() -> Iterator[Callable[..., str]]:
    """Addresses of scenes and captures, each served once."""
    addresses: dict[tuple, str] = {}
    with ExitStack() as stack:

        def serve(path: Path, capture: Path | None = None) -> str:
            key = path, capture
            if key not in addresses:
                page = stack.enter_context(cif.view(path, capture=capture, open_browser=False))
                addresses[key] = page.address
            return addresses[key]

        yield serve


@pytest.fixture
def show(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Opens pages; in the end of the test they have loaded nothing of others, and reported nothing."""
    opened = []

    def open_page(address: str, *, clock: bool = False) -> Page:
        context = browser.new_context(
            viewport={"width": 960, "height": 560},
            permissions=["clipboard-read", "clipboard-write"] if address.startswith("http") else [],
            color_scheme="dark",
        )
        page = context.new_page()
        page.requests, page.problems = [], []
        opened.append((context, page, address))
        page.on("request", lambda request: page.requests.append(request.url))
        page.on("websocket", lambda socket: page.requests.append(socket.url))
        page.on("pageerror", lambda error: page.problems.append(str(error)))
        page.on("requestfailed", lambda request: page.problems.append(f"{request.url} failed"))
        page.on("dialog", lambda dialog: (page.problems.append(dialog.message), dialog.dismiss()))
        page.on("console", lambda message: note(page, message))
        if clock:
            page.clock.install()
        page.goto(address)
        page.wait_for_selector("html[data-state]")
        assert page.locator("html").get_attribute("data-state") == "ready", page.locator(
            "#message"
        ).inner_text()
        return page

    yield open_page
    for context, page, address in opened:
        assert page.problems == [] and all(url.startswith(address) for url in page.requests), page.requests
        context.close()


def note(page: Page, message: Any) -> None:
    """Keeps a message of the console, unless it is the browser's own word on how long reading pixels takes."""
    if message.type in ("error", "warning") and "GPU stall due to ReadPixels" not in message.text:
        page.problems.append(f"{message.type}: {message.text}")


@pytest.fixture
def page(show: Callable[..., Page], served: Callable[..., str], scene: Path) -> Page:
    """The trained scene with its capture."""
    return show(served(scene, CAPTURE))


def state(page: Page, key: str) -> Any:
    return page.evaluate("(key) => cif.state[key]", key)


def until(is_so: Callable[[], Any], seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


def document(page: Page) -> dict[str, Any]:
    return page.evaluate("cif.engine.document")


def node_of(page: Page, label: str) -> int:
    return [node["label"] for node in document(page)["nodes"]].index(label)


def press(page: Page, *commands: str) -> None:
    for command in commands:
        page.locator(f"button[data-command={command}]").click()


def select(page: Page, label: str) -> int:
    page.locator("#list .item", has_text=label).first.click()
    node = state(page, "selected")
    assert document(page)["nodes"][node]["label"] == label
    return node


def shot_of(page: Page) -> dict[str, Any]:
    page.evaluate(TWO_FRAMES)
    return page.evaluate("cif.shot()")


def pixels(page: Page, shot: dict | None, code: float, low_pass: float = 0.3, plain: bool = True) -> Picture:
    """What the page draws, `[H, W, 3]` in [0, 1]."""
    width, height = (shot or shot_of(page))["size"]
    data = base64.b64decode(page.evaluate(PIXELS, [shot, code, low_pass, plain]))
    return np.frombuffer(data, np.uint8).reshape(height, width, 4)[..., :3] / 255


def canvas(page: Page, selector: str) -> Picture:
    """What a 2D canvas holds, RGBA, `[H, W, 4]`."""
    page.evaluate(TWO_FRAMES)
    width, height, data = page.locator(selector).evaluate(CANVAS)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)


def screenshot(page: Page, size: list[int] | None = None) -> Picture:
    """The picture on the screen, `[H, W, 3]` in [0, 1], reduced to a size."""
    from PIL import Image

    page.evaluate(TWO_FRAMES)
    image = Image.open(io.BytesIO(page.locator("#picture").screenshot())).convert("RGB")
    return np.asarray(image.resize(size, Image.Resampling.BOX) if size else image) / 255


def psnr(a: Picture, b: Picture, where: Picture = ...) -> float:
    return float(-10 * np.log10(np.mean((a[where] - b[where]) ** 2)))


def quantized(color: Picture) -> Picture:
    return np.round(np.clip(color, 0, 1) * 255) / 255


def camera_of(shot: dict[str, Any]) -> cif.Camera:
    """A camera of the page as one of cif."""
    x, y, z, *turn = shot["pose"]
    w, i, j, k = np.array(turn) / np.linalg.norm(turn)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
        [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
        [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
    ]
    pose[:3, 3] = x, y, z
    return cif.Camera(*shot["size"], tuple(shot["focal"]), tuple(shot["principal"]), np.linalg.inv(pose))


def seen(camera: cif.Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of points in the world."""
    local = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    return local[:, :2] / local[:, 2:] * camera.focal + camera.principal


def inside(labels: Picture, label: int, margin: int = 2) -> NDArray[np.int64]:
    """Pixels (row, column) around which all carry a label."""
    windows = np.lib.stride_tricks.sliding_window_view(labels == label, (2 * margin + 1,) * 2)
    return np.argwhere(windows.all(axis=(2, 3))) + margin


def check_pictures(page: Page, field: cif.Field, codes: list[int], last: int) -> None:
    found = document(page)
    assert any(node["deformation"] for node in found["nodes"])
    for code in codes:
        (shot,) = [shot for shot in found["cameras"][0]["samples"] if shot["code"] == code]
        drawn = pixels(page, shot, code)
        expected = field.render(camera_of(shot), code / last)
        objects = expected["label"] > 0
        name = found["cameras"][0]["name"]
        print(
            f"{name} {code}: {psnr(drawn, expected['color']):.1f} dB, {psnr(drawn, expected['color'], objects):.1f}"
        )


def test_pictures_are_those_of_cif(page: Page, trained: cif.Field) -> None:
    check_pictures(page, trained, TIMES, 71)
    dataset = cif.open_dataset(CAPTURE)
    views = document(page)["views"]
    for index in (0, 17, 33, 57, 75):
        view, frame = views[index], dataset.frames[index]
        truth = dataset.load_frame(index)["image"] / 255
        drawn = psnr(pixels(page, view, view["code"]), truth)
        rendered = psnr(trained.render(dataset.camera(index), frame["time"])["color"], truth)
        print(index, drawn, rendered)


def test_recorded_motion_is_drawn_as_cif_draws_it(
    show: Callable[..., Page], served: Callable[..., str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A car that drives and turns, a napkin that bends."""
    folder = tmp_path_factory.mktemp("recorded")
    field = make_field()
    field.export(folder / "scene.usda", motion=motion_of(field))
    recorded, _ = cif.import_scene(folder / "scene.usda")
    recorded.save(folder / "scene.cif")
    page = show(served(folder / "scene.cif"))
    assert {"static", "rigid", "dense"} <= {node["motion"] for node in document(page)["nodes"]}
    check_pictures(page, recorded, [0, 1, 2, 4, 5], 5)


def test_a_written_page_works_from_disk(
    show: Callable[..., Page], page: Page, scene: Path, tmp_path: Path
) -> None:
    path = tmp_path / "out.html"
    assert cif.run(["export", str(scene), "--html", str(path)]) == 0
    print(path.stat().st_size)
    assert path.stat().st_size < 4e6
    written = show(path.as_uri())
    assert written.requests == [path.as_uri()]
    for code in TIMES:
        shot = document(page)["cameras"][0]["samples"][code]
        assert np.array_equal(pixels(written, shot, code), pixels(page, shot, code))
    press(written, "play")
    until(lambda: state(written, "code") > 0)
    assert written.requests == [path.as_uri()]


FINGERPRINT = """() => JSON.stringify([cif.state, cif.shot().pose, document.activeElement.id,
  document.documentElement.dataset.theme, document.getElementById('help-dialog').open])"""
KEYS = {"Space": " ", "Left": "ArrowLeft", "Right": "ArrowRight", "Esc": "Escape"}


def test_every_button_and_key_works_and_nothing_is_loaded_from_elsewhere(page: Page) -> None:
    def begin() -> str:
        page.keyboard.press("Escape")
        page.keyboard.press("Escape")
        page.locator("#picture").evaluate("(picture) => { document.activeElement.blur(); }")
        if state(page, "playing"):
            page.keyboard.press(" ")
        page.locator("#scrub").fill("20")
        if state(page, "selected") < 0:
            select(page, "red mug")
        if state(page, "isolated") < 0:
            press(page, "isolate")
        page.evaluate(TWO_FRAMES)
        return page.evaluate(FINGERPRINT)

    idle = []
    buttons = page.locator("button[data-command]").evaluate_all("(all) => all.map((b) => b.dataset.command)")
    for command in buttons:
        before = begin()
        press(page, command)
        page.evaluate(TWO_FRAMES)
        idle += [command] if page.evaluate(FINGERPRINT) == before else []
    begin()
    press(page, "help")
    sections = page.locator("#help-body section").evaluate_all(
        "(all) => all.slice(1).map((s) => [...s.querySelectorAll('kbd')].map((k) => k.textContent))"
    )
    keys = [key for section in sections for texts in section for key in texts.split(" or ")]
    for key in [*keys, *"WASDQE"]:
        before = begin()
        names = [KEYS.get(part, part.lower() if len(part) == 1 else part) for part in key.split(" + ")]
        page.keyboard.press("+".join(names), delay=100 if key in "WASDQE" else 0)
        page.evaluate(TWO_FRAMES)
        idle += [key] if page.evaluate(FINGERPRINT) == before else []
    print(len(buttons), len(keys), idle)


def test_nothing_is_shown_without_the_token(page: Page) -> None:
    address = page.url
    for wrong in (address[:-33] + "0" * 32 + "/", address[:-33], address[:-2] + "/"):
        answer = page.goto(wrong)
        assert answer.status == 403
        assert page.locator("canvas, script").count() == 0 and "not complete" in page.content()
    assert all("Failed to load resource" in problem and "403" in problem for problem in page.problems)
    page.problems.clear()
    page.requests.clear()


def test_time(show: Callable[..., Page], served: Callable[..., str], scene: Path) -> None:
    page = show(served(scene, CAPTURE), clock=True)
    page.clock.pause_at(page.evaluate("Date.now()") + 1000)
    rate = document(page)["timeline"]["per_second"]

    def run(seconds: float) -> float:
        before = state(page, "code")
        page.clock.run_for(1000 * seconds)
        return state(page, "code") - before

    for speed in ("0.25", "0.5", "1", "2", "4"):
        page.locator("#speed").select_option(speed)
        press(page, "first", "play")
        assert page.locator("#play").get_attribute("aria-label") == "Pause"
        assert run(0.4) == pytest.approx(0.4 * rate * float(speed), abs=0.05 * rate * float(speed))
        press(page, "play")
        assert not state(page, "playing") and run(0.5) == 0 and state(page, "code").is_integer()
    # Round to the start, or the end of it.
    press(page, "last", "back", "play")
    run(0.5)
    assert state(page, "playing") and state(page, "code") < 71
    press(page, "loop", "last", "back", "play")
    run(0.5)
    assert not state(page, "playing") and state(page, "code") == 71
    press(page, "forward")
    assert state(page, "code") == 71
    press(page, "first", "back")
    assert state(page, "code") == 0
    press(page, "loop", "back")
    assert state(page, "code") == 71
    press(page, "forward", "forward")
    assert state(page, "code") == 1
    page.locator("#scrub").fill("36.4")
    assert state(page, "code") == 36 and page.locator("#time").inner_text().split() == [
        "36",
        "/",
        "71",
        f"{36 / rate:.2f}",
        "s",
    ]
    box = page.locator("#scrub").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert state(page, "code") in (35, 36)


def test_objects_are_found_selected_and_picked(page: Page, trained: cif.Field) -> None:
    nodes = document(page)["nodes"]
    search, shown = page.locator("#search"), page.locator("#list li:visible .label")
    for words in ("box", "o", "mug red", "VEHICLE"):
        search.fill(words)
        texts = [f"{node['label']} {node['category']} {node['name']}".lower() for node in nodes]
        found = [k for k, text in enumerate(texts) if all(word in text for word in words.lower().split())]
        assert shown.all_inner_texts() == [nodes[k]["label"] for k in found]
        assert page.locator("#objects-count").inner_text() == f"{len(found)} of {len(nodes)}"
    search.press("Enter")
    assert nodes[state(page, "selected")]["label"] == "toy car"
    search.fill("nothing of this name")
    assert shown.count() == 0 and page.locator("#list .empty").is_visible()
    search.press("Escape")
    assert shown.count() == len(nodes)
    page.locator("#list .item", has_text="toy car").click()
    assert state(page, "selected") == -1
    # In the picture: through a recorded camera, and from where the page starts.
    page.locator("#camera").select_option(label="camera_0")
    page.locator("#scrub").fill("35")
    for _ in range(2):
        shot = shot_of(page)
        labels = trained.render(camera_of(shot), 35 / 71)["label"]
        picked = 0
        for index, instance in enumerate(trained.instances):
            places = inside(labels, index + 1)
            if not len(places):
                continue
            row, column = places[len(places) // 2]
            page.locator("#picture").click(position={"x": column + 0.5, "y": row + 0.5})
            assert nodes[state(page, "selected")]["label"] == instance["label"]
            picked += 1
        assert picked >= 4
        row, column = inside(labels, 0)[0]
        page.locator("#picture").click(position={"x": column + 0.5, "y": row + 0.5})
        assert state(page, "selected") == -1
        press(page, "reset")


def test_objects_are_hidden_isolated_and_tinted(page: Page, trained: cif.Field) -> None:
    node = select(page, "cereal box")
    nodes = document(page)["nodes"]
    look = lambda: pixels(page, shot, 0, plain=False)  # noqa: E731
    press(page, "box", "path", "joints")
    shot = shot_of(page)
    background = np.array(document(page)["background"])
    label = [instance["label"] for instance in trained.instances].index("cereal box") + 1
    labels = trained.render(camera_of(shot), 0)["label"]
    place = tuple(inside(labels, label)[0])
    press(page, "isolate")
    shown = np.abs(look() - background).max(axis=2) > 0.1
    print(
        "isolated", (shown & (labels != label)).sum() / (labels == label).sum(), shown[labels == label].mean()
    )
    assert shown[place] and page.locator("#list li[data-shown=true]").count() == 1
    press(page, "isolate", "hide")
    page.keyboard.press("Escape")
    hidden = look()
    page.locator("#list .eye").nth(node).click()
    all_shown = look()
    changed = np.abs(hidden - all_shown).max(axis=2) > 0.1
    print("hidden", changed[labels == label].mean(), changed[labels != label].mean())
    for button in page.locator("#list .eye").all():
        button.click()
    assert (np.abs(look() - background) < 0.01).all() and state(page, "hidden") == [True] * len(nodes)
    page.evaluate(TWO_FRAMES)
    assert (screenshot(page).reshape(-1, 3).std(axis=0) < 0.01).all()
    press(page, "show-all")
    assert np.array_equal(look(), all_shown) and page.locator("#show-all").is_disabled()
    press(page, "tint")
    tinted = look()
    press(page, "tint", "mode-instances")
    instances = look()
    print("tint", psnr(tinted, 0.45 * all_shown + 0.55 * instances))
    for index, instance in enumerate(trained.instances):
        places = inside(labels, index + 1, 4)
        if len(places):
            drawn = instances[tuple(places.T)]
            print(instance["label"], drawn.mean(axis=0), np.array(nodes[index]["color"]) / 255)
    press(page, "mode-depth")
    depth = look().mean(axis=2)
    expected = trained.render(camera_of(shot), 0)
    solid = expected["alpha"] > 0.95
    print("depth", np.corrcoef(depth[solid], expected["depth"][solid])[0, 1])


def test_the_camera_frames_follows_and_resets(page: Page) -> None:
    start = shot_of(page)
    node = select(page, "toy car")
    low, high = np.array(document(page)["nodes"][node]["extent"])
    press(page, "first", "frame")

    def corners() -> NDArray[np.float64]:
        code = state(page, "code")
        pose = page.evaluate("([node, code]) => [...cif.engine.pose(node, code)]", [node, code])
        turned = np.linalg.inv(camera_of({**start, "pose": pose}).camera_from_world)
        grid = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
        return grid @ turned[:3, :3].T + turned[:3, 3]

    shot = shot_of(page)
    places = seen(camera_of(shot), corners())
    assert (places > 0).all() and (places < shot["size"]).all()
    middle = places.mean(axis=0) / shot["size"]
    print("framed", middle, (np.ptp(places, axis=0) / shot["size"]).max())
    # The box is drawn there.
    press(page, "path")
    rows, columns = np.nonzero(canvas(page, "#overlay")[..., 3])
    drawn = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    print("box", drawn, places.min(axis=0), places.max(axis=0))
    press(page, "follow")
    before, centre = np.array(shot["pose"][:3]), corners().mean(axis=0)
    page.locator("#scrub").fill("40")
    moved = np.array(shot_of(page)["pose"][:3]) - before
    print("moved", moved, corners().mean(axis=0) - centre)
    assert moved == pytest.approx(corners().mean(axis=0) - centre, abs=1e-9) and np.abs(moved).max() > 0.01
    press(page, "follow")
    page.locator("#scrub").fill("10")
    assert np.array(shot_of(page)["pose"][:3]) == pytest.approx(before + moved)
    box = page.locator("#picture").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for button in ("left", "right"):
        at = shot_of(page)["pose"]
        page.mouse.move(x, y)
        page.mouse.down(button=button)
        page.mouse.move(x + 60, y + 30, steps=3)
        page.mouse.up(button=button)
        turned = shot_of(page)["pose"]
        assert (turned[:3] != at[:3]) and (np.allclose(turned[3:], at[3:]) == (button == "right"))
    page.mouse.wheel(0, 300)
    until(lambda: page.evaluate("cif.shot().pose[0]") != turned[0])
    press(page, "first", "reset")
    assert shot_of(page)["pose"] == pytest.approx(start["pose"], abs=1e-6)


def test_what_is_drawn_over_the_picture(page: Page) -> None:
    select(page, "toy car")
    press(page, "axes", "frame")
    count = lambda: int((canvas(page, "#overlay")[..., 3] > 0).sum())  # noqa: E731
    for command in ("cameras", "grid", "box", "path", "axes"):
        was_on = page.locator(f"#{command}").get_attribute("aria-pressed") == "true"
        before = count()
        press(page, command)
        print(command, before, count())
        assert count() != before
        if not was_on:
            press(page, command)
            assert count() == before
    assert count() == 0


def test_recorded_cameras_and_comparisons(page: Page, trained: cif.Field) -> None:
    found, dataset = document(page), cif.open_dataset(CAPTURE)
    page.locator("#camera").select_option(label="camera_1")
    page.locator("#scrub").fill("22")
    code, camera = 22, found["cameras"][1]
    (sample,) = [shot for shot in camera["samples"] if shot["code"] == code]
    shot = shot_of(page)
    assert shot["pose"] == pytest.approx(sample["pose"])
    assert shot["size"][0] / shot["size"][1] == pytest.approx(128 / 96, rel=0.01)
    page.locator("#follow-time").uncheck()
    page.locator("#scrub").fill("50")
    assert shot_of(page)["pose"] == pytest.approx(sample["pose"])
    page.locator("#follow-time").check()
    assert shot_of(page)["pose"] == pytest.approx([s for s in camera["samples"] if s["code"] == 50][0]["pose"])
    page.locator("#scrub").fill("22")
    (index,) = [
        k for k, view in enumerate(found["views"]) if (view["camera"], view["code"]) == ("camera_1", 22)
    ]
    frame = dataset.load_frame(index)
    truth = frame["image"] / 255
    render = quantized(trained.render(dataset.camera(index), 22 / 71)["color"])
    left = np.arange(128)[:, None] < 64
    expected = {
        "render": render,
        "split": np.where(left, truth, render),
        "difference": np.abs(truth - render),
        "image": truth,
    }
    for mode, picture in expected.items():
        press(page, f"compare-{mode}")
        until(lambda mode=mode: page.locator("#image").is_visible() == (mode != "render"))
        # Without the rows of the tags, and the columns of the divider.
        part = np.s_[12:, np.r_[0:61, 67:128]]
        print(mode, psnr(screenshot(page, [128, 96]), picture, part))
    assert np.array_equal(canvas(page, "#image")[..., :3], frame["image"])
    press(page, "compare-difference")
    page.locator("#gain").select_option("4")
    page.evaluate(TWO_FRAMES)
    print("gain", psnr(screenshot(page, [128, 96]), np.clip(4 * expected["difference"], 0, 1), part))
    press(page, "compare-split")
    page.locator("#split").fill("0.25")
    assert "75%" in page.locator("#image").evaluate("(image) => image.style.clipPath")
    until(lambda: page.locator("#psnr").inner_text().endswith("dB"))
    text = page.locator("#psnr").inner_text()
    print("psnr", text, psnr(render, truth))
    assert float(text.split()[0]) == pytest.approx(psnr(render, truth), abs=0.1)
    press(page, "mask")
    until(lambda: page.locator("#mask").is_visible())
    mask = canvas(page, "#mask")
    assert np.array_equal(mask[..., 3] > 0, frame["mask"] > 0)
    for instance in found["nodes"]:
        places = frame["mask"] == instance["id"]
        if instance["id"] is not None and places.any():
            # Colours of canvases are multiplied by their opacity, which rounds them.
            assert np.abs(mask[places][:, :3] - np.array(instance["color"])).max() <= 2
    name = page.locator("#view-name").inner_text()
    press(page, "next-view")
    assert page.locator("#view-name").inner_text() != name and state(page, "code") == 32
    press(page, "previous-view")
    assert page.locator("#view-name").inner_text() == name == f"{found['views'][index]['name']} (val)"


def test_details_tell_what_cif_knows(page: Page, trained: cif.Field) -> None:
    body = page.locator("#details-body")
    for label in ("red mug", "toy car", "cereal box"):
        node = document(page)["nodes"][select(page, label)]
        path = trained.trajectory(label)
        (found,) = trained.find(label)
        for text in (label, node["category"], node["motion"], found["path"]):
            assert text in body.inner_text()
        for code in (0, 36, 71):
            page.locator("#scrub").fill(str(code))
            position, turn = (
                np.array(page.locator(name).inner_text().split(), float) for name in ("#position", "#turn")
            )
            assert position == pytest.approx(path["translations"][code], abs=1e-3)
            sign = np.sign(turn @ path["rotations"][code])
            assert sign * turn == pytest.approx(path["rotations"][code], abs=1e-3)
        page.locator("#path-copy").click()
        until(lambda found=found: page.evaluate("navigator.clipboard.readText()") == found["path"])
        assert page.locator("#note").inner_text() == "Path copied."
        with page.expect_download() as download:
            page.locator("#csv").click()
        assert download.value.suggested_filename == f"{found['instance']}_poses.csv"
        rows = list(csv.DictReader(download.value.path().read_text().splitlines()))
        values = np.array(
            [[float(row[name]) for name in ("time_code", "seconds", "x", "y", "z")] for row in rows]
        )
        expected = np.column_stack([path["time_codes"], path["seconds"], path["translations"]])
        assert values == pytest.approx(expected, abs=1e-4)


def test_theme_and_help(page: Page) -> None:
    color = lambda: page.locator("#bar").evaluate("(bar) => getComputedStyle(document.body).backgroundColor")  # noqa: E731
    dark = color()
    press(page, "theme")
    light = color()
    press(page, "theme")
    assert color() == dark != light
    dialog = page.locator("#help-dialog")
    for leave in (lambda: page.keyboard.press("Escape"), lambda: page.locator("#help-close").click()):
        press(page, "help")
        assert dialog.is_visible() and "Find an object" in dialog.inner_text()
        leave()
        assert not dialog.is_visible()


def test_the_keyboard_suffices(page: Page) -> None:
    page.keyboard.press("/")
    page.keyboard.type("toy car")
    page.keyboard.press("Enter")
    node = node_of(page, "toy car")
    assert state(page, "selected") == node
    page.keyboard.press("Escape")
    page.keyboard.press("i")
    assert state(page, "isolated") == node
    page.keyboard.press(" ")
    until(lambda: state(page, "code") > 2)
    page.keyboard.press(" ")
    assert not state(page, "playing")
    page.keyboard.press("]")
    assert state(page, "camera") == 0
    page.keyboard.press("Escape")
    assert state(page, "camera") == -1 and state(page, "selected") == node

    def tab_to(selector: str) -> None:
        for _ in range(120):
            if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
                return
            page.keyboard.press("Tab")
        pytest.fail(f"Tab does not reach {selector}")

    tab_to("#list .item")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    assert state(page, "selected") == 1
    tab_to("#camera")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    assert state(page, "camera") == 1
    tab_to("#picture")
    before = shot_of(page)["pose"]
    page.keyboard.press("ArrowLeft")
    assert shot_of(page)["pose"] != before and state(page, "camera") == -1


HOSTILE = [
    "<img src=x onerror=alert(1)>",
    "\"'><script>alert(2)</script><b>",
    "../../etc/passwd",
    "</script><script>alert(3)</script>",
    "\u202eתווית</title>",
    "${alert(4)} `{{4}}` &amp; &lt;",
]


def test_labels_are_text(show: Callable[..., Page], served: Callable[..., str], tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    count = 20 * len(HOSTILE)
    field = cif.Field.from_arrays(
        means=rng.normal(0, 0.3, (count, 3)).astype(np.float32) + np.array([0, 0, 3], np.float32),
        scales=np.full((count, 3), 0.05, np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacities=np.full(count, 0.9, np.float32),
        colors=rng.uniform(size=(count, 3)).astype(np.float32),
        identities=np.repeat(np.eye(len(HOSTILE), dtype=np.float32), 20, axis=0),
        instances=[{"id": k + 1, "label": text, "category": text} for k, text in enumerate(HOSTILE)],
        cameras=[("<i>camera</i>", 0, cif.Camera(64, 48, (60.0, 60.0)))],
    )
    name = "<u>scene & 'more'.cif"
    field.save(tmp_path / name)
    assert cif.run(["export", str(tmp_path / name), "--html", str(tmp_path / "out.html")]) == 0
    for address in (served(tmp_path / name), (tmp_path / "out.html").as_uri()):
        page = show(address)
        assert page.title() == page.locator("#title").inner_text() == (name if "http" in address else "out")
        labels = page.locator("#list .label").evaluate_all("(all) => all.map((label) => label.textContent)")
        assert labels[: len(HOSTILE)] == HOSTILE
        for k, text in enumerate(HOSTILE):
            page.locator("#list .item").nth(k).click()
            assert page.locator("#details-body .name").evaluate("(name) => name.textContent") == text
            page.locator("#list .item").nth(k).hover()
        assert page.locator("#camera option").nth(1).inner_text() == "<i>camera</i>"
        made = page.locator("#app :is(script, b, i, u, img, iframe, object, embed)")
        assert made.count() == 0 and page.locator("script:not([type])").count() == 1


def test_a_capture_before_training(show: Callable[..., Page], served: Callable[..., str]) -> None:
    dataset = cif.open_dataset(CAPTURE)
    page = show(served(CAPTURE))
    assert page.locator("#statistics").inner_text().startswith(f"{len(dataset.points):,} of")
    assert len(dataset.points) > 0 and page.locator("#list .label").all_inner_texts() == ["points"]
    drawn = np.abs(pixels(page, None, 0) - document(page)["background"]).max(axis=2) > 0.05
    print("points", drawn.mean())
    # Frusta of both cameras.
    frusta = (canvas(page, "#overlay")[..., 3] > 0).sum()
    press(page, "cameras")
    print("frusta", frusta, (canvas(page, "#overlay")[..., 3] > 0).sum())
    page.locator("#camera").select_option(label="camera_0")
    press(page, "mask")
    for code in TIMES:
        page.locator("#scrub").fill(str(code))
        (index,) = [
            k
            for k, frame in enumerate(dataset.frames)
            if (frame["camera_name"], frame["time_index"]) == ("camera_0", code)
        ]
        frame = dataset.load_frame(index)
        until(lambda frame=frame: np.array_equal(canvas(page, "#image")[..., :3], frame["image"]))
        assert np.array_equal(canvas(page, "#mask")[..., 3] > 0, frame["mask"] > 0)
        assert page.locator("#image").is_visible() and page.locator("#mask").is_visible()
    assert page.locator("#psnr-field").is_hidden()


@pytest.mark.parametrize("ending", ["usdc", "glb"])
def test_files_of_other_formats_are_shown(
    show: Callable[..., Page], served: Callable[..., str], trained: cif.Field, tmp_path: Path, ending: str
) -> None:
    if ending == "usdc":
        pytest.importorskip("pxr")
    path = tmp_path / f"out.{ending}"
    trained.export(path)
    found = {object_["label"]: object_["path"] for object_ in cif.query_stage(path, "*")}
    page = show(served(path))
    nodes = document(page)["nodes"]
    print(found, [node["path"] for node in nodes])
    assert len(found) >= 9
    for node in nodes:
        if node["label"] in found:
            select(page, node["label"])
            assert found[node["label"]] in page.locator("#details-body").inner_text()
    expected = trained.render(camera_of(shot_of(page)), 0)["color"]
    shot = shot_of(page)
    print(ending, psnr(pixels(page, shot, 0), expected))


def test_lost_graphics(page: Page, playwright: Playwright) -> None:
    before = pixels(page, None, 30)
    page.evaluate("window.lost = cif.engine.gl.getExtension('WEBGL_lose_context')")
    page.evaluate("lost.loseContext()")
    page.locator("#scrub").fill("30")
    page.evaluate(TWO_FRAMES)
    page.evaluate("lost.restoreContext()")
    until(lambda: not page.evaluate("cif.engine.gl.isContextLost()"))
    page.evaluate(TWO_FRAMES)
    assert np.array_equal(pixels(page, None, 30), before)


@pytest.mark.parametrize(
    "arguments", [["--disable-3d-apis"], ["--disable-gpu", "--disable-webgl", "--disable-webgl2"]]
)
def test_without_graphics_the_page_says_so(
    playwright: Playwright, served: Callable[..., str], scene: Path, arguments
) -> None:
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *arguments])
    page = browser.new_page()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(served(scene, CAPTURE))
    page.wait_for_selector("html[data-state]")
    assert page.locator("html").get_attribute("data-state") == "failed"
    assert page.locator("#app").is_hidden() and page.locator("#message").is_visible()
    print(page.locator("body").inner_text())
    assert "WebGL 2" in page.locator("#message-text").inner_text() and problems == []
    browser.close()
