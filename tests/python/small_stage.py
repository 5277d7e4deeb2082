"""A stage of every kind of motion, written as text, so that any USD can read it without our package."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

FRAMES = 9
"""Time codes 0 to 8."""
COUNT = 20
"""Splats of every prim."""
RED_BAND_0 = (1.2, -1.0, -1.2)
"""First coefficient of every splat: red."""


def turned(angle: float) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of a turn about z."""
    return (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))


def positions(seed: int, frame: int = 0, bend: float = 0.0) -> np.ndarray:
    """Centres of a prim's splats, local frame; those that bend rise with x squared."""
    centres = np.random.default_rng(seed).uniform(-0.1, 0.1, (COUNT, 3))
    centres[:, 2] += bend * frame * centres[:, 0] ** 2
    return centres


def scales(seed: int) -> np.ndarray:
    """Standard deviations of a prim's splats."""
    return np.random.default_rng(seed + 100).uniform(0.005, 0.03, (COUNT, 3))


def orientations(seed: int) -> np.ndarray:
    """Unit quaternions (w, x, y, z) of a prim's splats."""
    values = np.random.default_rng(seed + 200).normal(size=(COUNT, 4))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def write_stage(path: Path, up_axis: str = "Z", meters_per_unit: float = 1.0) -> Path:
    """A mug that stands, a car that drives and turns, a box of two parts, a napkin that bends, a background.

    The car turns by 0.4 rad and drives by 0.1 a frame; the lid turns by 0.1 rad a frame on a box that slides;
    the ball is hidden until frame 3; the camera looks down from 2 units above and rises by 0.1 a frame.
    """
    codes = range(FRAMES)
    body = [
        _object(
            "red_mug_001",
            ["mug", "red mug"],
            1,
            _pose((0.5, 0.0, 0.1), turned(0.3)),
            _splats(1) + _proxy("/World/red_mug_001", 1),
        ),
        _object(
            "toy_car_002",
            ["car", "toy car"],
            2,
            _poses((f, (0.1 * f, -0.4, 0.0), turned(0.4 * f)) for f in codes),
            _splats(2),
        ),
        _object(
            "box_003",
            ["box"],
            3,
            _poses([(0, (-0.5, 0.0, 0.0), turned(0)), (8, (-0.5, 0.8, 0.0), turned(0))]),
            _part("part_00", _pose((0, 0, 0), turned(0)), _splats(3))
            + _part("part_01", _poses((f, (0, 0, 0.2), turned(0.1 * f)) for f in codes), _splats(4)),
        ),
        _object(
            "green_napkin_007",
            ["napkin", "green napkin"],
            7,
            _poses((f, (0.0, 0.05 * f, 0.3), turned(0)) for f in codes),
            _splats(5, bend=2.0),
        ),
        _object(
            "ball_008",
            ["ball"],
            8,
            _pose((0.0, 0.6, 0.0), turned(0))
            + 'token visibility = "invisible"\n'
            + 'token visibility.timeSamples = { 0: "invisible", 3: "inherited" }\n',
            _splats(6),
        ),
        _object("background", ["background"], None, _pose((0, 0, -0.5), turned(0)), _splats(9)),
        _camera(),
    ]
    path.write_text(
        f"""#usda 1.0
(
    customLayerData = {{ dictionary cif = {{ float3 backgroundColor = (0.5, 0.25, 1) }} }}
    defaultPrim = "World"
    upAxis = "{up_axis}"
    metersPerUnit = {meters_per_unit}
    timeCodesPerSecond = 12
    framesPerSecond = 12
    startTimeCode = 0
    endTimeCode = {FRAMES - 1}
)
def Xform "World" (kind = "assembly")
{{
{"".join(body)}
}}
"""
    )
    return path


def _tuple(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{float(value):.9g}" for value in values) + ")"


def _array(rows: Iterable) -> str:
    return "[" + ", ".join(_tuple(row) if np.ndim(row) else f"{float(row):.9g}" for row in rows) + "]"


def _pose(translation: Iterable[float], rotation: Iterable[float]) -> str:
    return f"""double3 xformOp:translate = {_tuple(translation)}
quatf xformOp:orient = {_tuple(rotation)}
uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]
"""


def _poses(samples: Iterable[tuple[float, Iterable[float], Iterable[float]]]) -> str:
    samples = list(samples)
    translations = ", ".join(f"{code}: {_tuple(t)}" for code, t, _ in samples)
    rotations = ", ".join(f"{code}: {_tuple(q)}" for code, _, q in samples)
    return (
        _pose(samples[0][1], samples[0][2])
        + f"""double3 xformOp:translate.timeSamples = {{ {translations} }}
quatf xformOp:orient.timeSamples = {{ {rotations} }}
"""
    )


def _object(name: str, labels: list[str], number: int | None, pose: str, children: str) -> str:
    words = ", ".join(f'"{label}"' for label in labels)
    data = ""
    schema = (
        ""
        if number is None
        else f"""uniform int cif:id = {number}
uniform token cif:motion:model = "rigid"
uniform int2 cif:sourceFrames = (0, {FRAMES - 1})
uniform string cif:motion:report = "{{}}"
"""
    )
    if selected := re.search(r"# selected: (\w+)", children):
        data += f"""
    variants = {{ string physics = "{selected[1]}" }}
    prepend variantSets = "physics\""""
    return f"""def Xform "{name}" (
    kind = "component"
    displayName = "{labels[-1]}"
    prepend apiSchemas = ["SemanticsLabelsAPI:class", "SemanticsLabelsAPI:instance"]
    {data}
) {{
token[] semantics:labels:class = [{words}]
token[] semantics:labels:instance = ["{name}"]
custom string userProperties:label = "{labels[-1]}"
{schema}{pose}
{children}
}}
"""


def _part(name: str, pose: str, children: str) -> str:
    return f'def Xform "{name}" {{\n{pose}\n{children}\n}}\n'


def _splats(seed: int, bend: float = 0.0) -> str:
    samples = ""
    if bend:
        sampled = ", ".join(f"{f}: {_array(positions(seed, f, bend))}" for f in range(FRAMES))
        samples = f"point3f[] positions.timeSamples = {{ {sampled} }}\n"
    harmonics = np.zeros((COUNT, 4, 3))
    harmonics[:, 0] = RED_BAND_0
    return f"""def ParticleField3DGaussianSplat "Splats" {{
point3f[] positions = {_array(positions(seed))}
{samples}quatf[] orientations = {_array(orientations(seed))}
float3[] scales = {_array(scales(seed))}
float[] opacities = {_array(np.full(COUNT, 0.8))}
uniform int radiance:sphericalHarmonicsDegree = 1
float3[] radiance:sphericalHarmonicsCoefficients = {_array(harmonics.reshape(-1, 3))} (
    elementSize = 4
    interpolation = "vertex"
)
}}
"""


def _proxy(parent: str, seed: int) -> str:
    """Points at the centres of splats, to be drawn in their stead, in the form that `cif export` gives them."""
    return f"""def PointInstancer "Proxy" {{
uniform token purpose = "proxy"
point3f[] positions = [(0, 0, 0)]
int[] protoIndices = [0]
rel prototypes = <{parent}/Proxy/Prototypes/Points>
over "Prototypes" {{
def Points "Points" {{
point3f[] points = {_array(positions(seed))}
float[] widths = {_array(np.full(COUNT, 0.04))} (interpolation = "vertex")
color3f[] primvars:displayColor = {_array(np.full((COUNT, 3), (0.8, 0.2, 0.2)))} (interpolation = "vertex")
}}
}}
}}
"""


def write_simulation(path: Path) -> Path:
    """A cube that hovers, a pusher on a track, a step that stands, a table without a collider at height -0.5.

    Instances have the variants `physics` that an export has. The pusher moves along x by 0.05 a frame.
    """
    track = [(f, (-0.6 + 0.05 * f, 0.8, 0.0), turned(0)) for f in range(FRAMES)]
    rest = [(0, (0.0, 0.0, 0.0), turned(0.3))]
    table = np.random.default_rng(4).uniform([-2, -2, -0.002], [2, 2, 0.002], (COUNT * 20, 3))
    step = [(0, (0.9, 0.0, -0.45), turned(0))]
    hull = _collider(0.12)
    body = [
        _object("cube_001", ["cube"], 1, "", _physics(rest, "none") + _splats(1) + hull),
        _object("pusher_002", ["tool", "pusher"], 2, "", _physics(track, "kinematic") + _splats(2) + hull),
        _object("step_003", ["step"], 3, "", _physics(step, "none") + _splats(3) + hull),
        _object("background", ["background"], None, _pose((0, 0, -0.5), turned(0)), _flat(table)),
    ]
    path.write_text(
        f"""#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Z"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    timeCodesPerSecond = 12
    framesPerSecond = 12
    startTimeCode = 0
    endTimeCode = {FRAMES - 1}
)
def Xform "World" (kind = "assembly")
{{
def PhysicsScene "PhysicsScene" {{
vector3f physics:gravityDirection = (0, 0, -1)
float physics:gravityMagnitude = 9.81
}}
{"".join(body)}
}}
"""
    )
    return path


def write_cabinet(path: Path) -> Path:
    """A cabinet at height 0.5 whose door turns about z by 0.1 rad a frame and whose drawer slides, on joints.

    Its parts lie 0.3 apart; the floor is a background at height 0.
    """
    codes = range(FRAMES)
    floor = np.random.default_rng(4).uniform([-2, -2, -0.002], [2, 2, 0.002], (COUNT * 20, 3))
    parts = (
        _part("part_00", _pose((0, 0, 0), turned(0)), _splats(1))
        + _part("part_01", _poses((f, (0.3, 0, 0), turned(0.1 * f)) for f in codes), _splats(2))
        + _part("part_02", _poses((f, (0, 0.3 + 0.02 * f, 0), turned(0)) for f in codes), _splats(3))
        + _joint("Revolute", "part_01", (0.3, 0, 0), "Z", 180 / np.pi * 0.1 * (FRAMES - 1))
        + _joint("Prismatic", "part_02", (0, 0.3, 0), "Y", 0.02 * (FRAMES - 1))
    )
    body = [
        _object("cabinet_001", ["cabinet"], 1, _pose((0, 0, 0.5), turned(0)), parts),
        _object(
            "background",
            ["background"],
            None,
            _pose((0, 0, 0), turned(0)),
            'uniform token cif:kind = "background"\n' + _flat(floor),
        ),
    ]
    path.write_text(
        f"""#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Z"
    metersPerUnit = 1
    timeCodesPerSecond = 12
    framesPerSecond = 12
    startTimeCode = 0
    endTimeCode = {FRAMES - 1}
)
def Xform "World" (kind = "assembly")
{{
{"".join(body)}
}}
"""
    )
    return path


def _joint(kind: str, part: str, place: tuple, axis: str, upper: float) -> str:
    """A joint between the first part of the cabinet and another, at the origin of that."""
    return f"""def Physics{kind}Joint "Joint_{part}" {{
rel physics:body0 = </World/cabinet_001/part_00>
rel physics:body1 = </World/cabinet_001/{part}>
point3f physics:localPos0 = {_tuple(place)}
uniform token physics:axis = "{axis}"
float physics:lowerLimit = 0
float physics:upperLimit = {upper:.9g}
}}
"""


def _flat(places: np.ndarray) -> str:
    """A prim of round splats at the given places."""
    count = len(places)
    return f"""def ParticleField3DGaussianSplat "Splats" {{
point3f[] positions = {_array(places)}
quatf[] orientations = {_array([(1, 0, 0, 0)] * count)}
float3[] scales = {_array([(0.05, 0.05, 0.001)] * count)}
float[] opacities = {_array([0.9] * count)}
uniform int radiance:sphericalHarmonicsDegree = 0
float3[] radiance:sphericalHarmonicsCoefficients = {_array([(0, 0, 0)] * count)} (
    elementSize = 1
    interpolation = "vertex"
)
}}
"""


def _physics(samples: list, selected: str) -> str:
    """The variant set `physics` and the variant that is chosen; bodies and tracks live inside the variants."""
    still = _pose(samples[0][1], samples[0][2])
    moving = _poses(samples) if len(samples) > 1 else still
    body = """prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]"""
    return f"""variantSet "physics" = {{
"none" {{
{moving}
}}
"kinematic" ({body}) {{
{moving}
bool physics:kinematicEnabled = 1
float physics:density = 1000
}}
"dynamic" ({body}) {{
{still}
bool physics:kinematicEnabled = 0
float physics:density = 1000
}}
}}
# selected: {selected}
"""


def _collider(half: float) -> str:
    """A cube around the origin."""
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    sides = ("0132", "4675", "0451", "2376", "0264", "1573")
    triangles = ", ".join(f"{a}, {b}, {c}, {a}, {c}, {d}" for a, b, c, d in sides)
    return f"""def Mesh "Collider" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]) {{
uniform token purpose = "guide"
uniform token physics:approximation = "convexHull"
uniform token subdivisionScheme = "none"
point3f[] points = {_array(corners)}
float3[] extent = {_array([(-half,) * 3, (half,) * 3])}
int[] faceVertexCounts = [{", ".join(["3"] * 12)}]
int[] faceVertexIndices = [{triangles}]
}}
"""


def _camera() -> str:
    return f"""def Camera "camera_0" {{
float focalLength = 18
float horizontalAperture = 36
float verticalAperture = 27
float horizontalApertureOffset = 1.8
float2 clippingRange = (0.01, 1000)
int userProperties:imageWidth = 64
int userProperties:imageHeight = 48
{_poses((f, (0, 0, 2 + 0.1 * f), turned(0)) for f in range(FRAMES))}
}}
"""


ROWS = {
    "point3f[] positions": "(0, 0, {height})",
    "quatf[] orientations": "(1, 0, 0, 0)",
    "float3[] scales": "(0.1, 0.1, 0.1)",
    "float[] opacities": "0.5",
    "color3f[] primvars:displayColor": "(1, 0, 0)",
}
"""Attributes of splats, and a value of each."""


def write_windows(folder: Path) -> Path:
    """A mug that shows from frame 2 on with 20 splats, and from frame 5 on with 12 others, which rise."""

    def values(row: str, count: int, height: float = 0) -> str:
        return "[" + ", ".join([row.format(height=height)] * count) + "]"

    def clip(code: int, count: int, rises_until: int | None = None) -> str:
        lines = []
        for name, row in ROWS.items():
            samples = [f"{code}: {values(row, count)}"]
            if rises_until and "positions" in name:
                samples.append(f"{rises_until}: {values(row, count, 0.3)}")
            lines.append(f"{name}.timeSamples = {{ {', '.join(samples)} }}")
        return over("\n".join(lines))

    def over(text: str) -> str:
        return f'over "World"\n{{\nover "mug_001"\n{{\nover "mug_001_splats"\n{{\n{text}\n}}\n}}\n}}\n'

    full = "\n".join(f"{name} = {values(row, 20)}" for name, row in ROWS.items())
    layers = {
        "full": f'def "Full"\n{{\ndef ParticleField3DGaussianSplat "mug_001_splats"\n{{\n{full}\n}}\n}}\n',
        "window-001": clip(0, 20),
        "window-002": clip(5, 12, rises_until=8),
        "manifest": over("\n".join(ROWS)),
    }
    for name, text in layers.items():
        (folder / f"{name}.usda").write_text(f"#usda 1.0\n{text}")
    path = folder / "walk.usda"
    path.write_text("""#usda 1.0
(
    customLayerData = {
        dictionary cif = {
            int windows = 2
        }
    }
    defaultPrim = "World"
    startTimeCode = 0
    endTimeCode = 8
)
def Xform "World" (
    clips = {
        dictionary default = {
            double2[] active = [(0, 0), (5, 1)]
            asset[] assetPaths = [@./window-001.usda@, @./window-002.usda@]
            asset manifestAssetPath = @./manifest.usda@
            string primPath = "/World"
        }
    }
)
{
    def Xform "mug_001" (
        payload = @./full.usda@</Full>
    )
    {
        token[] semantics:labels:class = ["mug"]
        token visibility.timeSamples = { 0: "invisible", 2: "inherited" }
        double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 8: (4, 0, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
""")
    return path
