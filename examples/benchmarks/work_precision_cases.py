"""The cases of the work-precision benchmark, as data: a scene, what is wanted of it, the methods that compute it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import boundary_global
import boundary_soft_shadow
import media
import numpy as np
import work_precision_exact as exact
from common import psdr

from scenes import BLUE, CASES, SKY, TEXTURED, mesh, stage, write_ply

#: No path is ended at random.
NEVER = 1_000_000
UP = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Method:
    """A way to compute a case.

    Attributes:
        options: of ours, of `psdr.PathIntegrator`; of Mitsuba's, a dictionary of an integrator, where None stands for
            the number of samples.
        forget: forget what guiding has learnt before every run.
        full: left out of the quick runs.
    """

    options: dict = field(default_factory=dict)
    forget: bool = False
    full: bool = False


@dataclass(frozen=True)
class Case:
    """A scene, and a number for each of its pixels, or parameters.

    Attributes:
        write: folder -> the scene's file, written there, with ``$resolution``.
        depth: most path vertices behind the camera.
        kind: an image; a derivative image along ``direction`` (forward mode); or the gradient of a weighted sum of the
            pixels (reverse mode).
        parameter: its name here; ``theirs``: in Mitsuba, where it has another.
        direction: tangent of the parameter, broadcast to its shape.
        step: half of the distance of finite differences; 0: there are none.
        ours, mitsuba: name -> method; the first gives the renderer's reference.
        closed: pixels -> values in float64; None: references are long runs.
        pixels: of a side, quick and full; None: the run's.
        counts: samples a pixel, quick and full; None: the run's.
        quick: part of the quick runs.
        rr_depth: depth from which paths end at random.
    """

    write: Callable[[Path], Path]
    depth: int
    kind: Literal["image", "forward", "reverse"]
    ours: dict[str, Method]
    mitsuba: dict[str, Method]
    parameter: str = ""
    theirs: str = ""
    direction: object = 0.0
    step: float = 0.0
    closed: Callable[[int], np.ndarray] | None = None
    pixels: tuple[int, int] | None = None
    counts: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    quick: bool = True
    rr_depth: int = 5


IMAGE = {
    "ours": Method({"sampler": "sobol"}),
    "ours, independent": Method({"sampler": "independent"}, full=True),
}
PATH = {"Mitsuba path": Method({"type": "path"})}
INTERIOR = {
    "ours, Replay": Method({"boundary": None}),
    "ours, textbook": Method({"boundary": None, "interior": psdr.interior.Textbook()}, full=True),
}
PRB = {"Mitsuba prb": Method({"type": "prb"})}
VOLPATH = {"Mitsuba volpath": Method({"type": "volpath"})}
PRBVOLPATH = {"Mitsuba prbvolpath": Method({"type": "prbvolpath"})}
TRACKED = {
    "ours, Replay": INTERIOR["ours, Replay"],
    "ours, ratio tracking": Method({"boundary": None, "interior": psdr.interior.DifferentialRatioTracking()}),
}


def _path_space(guiding=None, **more) -> Method:
    return Method({"boundary": psdr.boundary.PathSpace(guiding=guiding)}, **more)


BOUNDARY = {
    # The first makes the references: guided ones have the least noise.
    "ours, KdTree": _path_space(psdr.guiding.KdTree()),
    "ours, unguided": _path_space(),
    "ours, KdTree, first call": _path_space(psdr.guiding.KdTree(), forget=True),
    "ours, Octree": _path_space(psdr.guiding.Octree(), full=True),
    "ours, Grid": _path_space(psdr.guiding.Grid(), full=True),
    "ours, EdgeSampling": Method({"boundary": psdr.boundary.EdgeSampling()}, full=True),
    "ours, Projective": Method({"boundary": psdr.boundary.Projective()}, full=True),
}
#: Where there is nothing to guide.
PLAIN = {name: BOUNDARY[name] for name in ("ours, unguided", "ours, EdgeSampling")}


def _projective(guiding: str, **more) -> Method:
    return Method({"type": "prb_projective", "sppc": None, "sppp": None, "sppi": None, "guiding": guiding}, **more)


PROJECTIVE = {
    f"Mitsuba, {guiding}": _projective(guiding, full=guiding != "none") for guiding in ("none", "grid", "octree")
}
UNGUIDED = {"Mitsuba, none": PROJECTIVE["Mitsuba, none"]}


def _of(name: str) -> Callable[[Path], Path]:
    """A scene of ``scenes.py``."""

    def write(folder: Path) -> Path:
        return CASES[name].write(folder, name)

    return write


def _text(stem: str, xml: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        file = folder / f"{stem}.xml"
        file.write_text(xml)
        return file

    return write


def _floating_box(folder: Path, stem: str, lights: str) -> Path:
    """A welded box above a floor, seen from above, under other lights."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    write_ply(folder / "box.ply", 0.45 * corners @ turn.T + [0.1, 0.0, 0.1], faces)
    shape = (
        '<shape type="ply" id="box"><string name="filename" value="box.ply"/>'
        f'<boolean name="face_normals" value="true"/>{BLUE}</shape>'
    )
    return _text(stem, stage(shape, lights))(folder)


# The textures hold floats: Mitsuba does not differentiate 8-bit ones.
_PAINTED = TEXTURED.replace("texture.png", "paint.exr").replace(
    "</texture>", '<boolean name="raw" value="true"/></texture>'
)
_CONSTANT = '<emitter type="constant"><rgb name="radiance" value="1, 0.9, 0.8"/></emitter>'
_LAMP = (
    '<emitter type="point"><point name="position" x="0.6" y="3" z="0.8"/><rgb name="intensity" value="20"/></emitter>'
)
#: Tangent of a camera's pose: to the side, per unit.
_SIDEWAYS = np.zeros((4, 4))
_SIDEWAYS[0, 3] = 1.0

_MATERIALS = {"kind": "forward", "ours": INTERIOR, "mitsuba": PRB}
_SHAPE_COUNTS = ((2, 4, 8, 16), (4, 16, 64, 256))
_SHAPES = {"kind": "forward", "ours": BOUNDARY, "mitsuba": PROJECTIVE, "counts": _SHAPE_COUNTS}

IMAGES = {
    "Cornell box": Case(_of("Cornell box"), 6, "image", IMAGE, PATH),
    "textured mesh": Case(_of("textured mesh"), 6, "image", IMAGE, PATH),
    "rough gold under a sky": Case(_of("rough gold under a sky"), 6, "image", IMAGE, PATH),
    "point, spot and sun": Case(_of("point, spot and sun"), 6, "image", IMAGE, PATH, quick=False),
}
MATERIALS = {
    "Cornell box: reflectance": Case(
        _of("Cornell box"), 6, parameter="white.reflectance.value", direction=(1.0, 1.0, 1.0), step=0.01, **_MATERIALS
    ),
    "Cornell box: light": Case(
        _of("Cornell box"), 6, parameter="light.emitter.radiance.value", direction=(1.0, 1.0, 1.0), step=1.0,
        quick=False, **_MATERIALS,
    ),
    "rough gold: roughness": Case(
        _of("rough gold under a sky"), 6, parameter="object.bsdf.alpha.value", direction=1.0, step=0.002, **_MATERIALS
    ),
    "textured mesh: 8,192 texels": Case(
        _text("painted", stage(mesh("bumpy.ply", _PAINTED), SKY)), 6, "reverse", INTERIOR, PRB,
        parameter="object.bsdf.reflectance.data",
    ),
}  # fmt: skip
SHAPES = {
    "soft shadow of a sphere": Case(
        boundary_soft_shadow.write_scene, 2, parameter="sphere.vertex_positions",
        direction=boundary_soft_shadow.DIRECTION, step=0.008, **_SHAPES,
    ),
    "Cornell box: a box slides": Case(
        lambda folder: boundary_global.write_scenes(folder)["Cornell box, a box slides"], 4,
        parameter="small-box.vertex_positions", direction=(1.0, 0.0, 0.4), step=0.008,
        **_SHAPES,
    ),
    "a box under a constant sky": Case(
        lambda folder: _floating_box(folder, "sky_box", _CONSTANT), 2, parameter="box.vertex_positions",
        direction=UP, step=0.008, **_SHAPES,
    ),
    "hard shadow of a point light": Case(
        lambda folder: _floating_box(folder, "lamp_box", _LAMP), 2, "forward", PLAIN, UNGUIDED,
        parameter="box.vertex_positions", direction=UP, step=0.008, counts=_SHAPE_COUNTS,
    ),
    "the camera moves": Case(
        lambda folder: _floating_box(folder, "camera_box", _CONSTANT), 2, "forward", PLAIN, UNGUIDED,
        parameter="sensor.to_world", direction=_SIDEWAYS, step=0.008, counts=_SHAPE_COUNTS, quick=False,
    ),
}  # fmt: skip

_FOG = """<shape type="cube" id="fog"><transform name="to_world"><scale value="0.95"/></transform><bsdf type="null"/>
    <medium type="homogeneous" name="interior"><float name="sigma_t" value="0.8"/><float name="albedo" value="0.8"/>
        <phase type="hg"><float name="g" value="0.3"/></phase></medium></shape>"""
#: Mitsuba has no derivative by what moves in media, and none in forward mode.
MEDIA = {
    "smoke": Case(lambda folder: media.write(folder)["smoke"][0], media.DEPTH, "image", IMAGE, VOLPATH),
    "smoke: 262,144 voxels": Case(
        lambda folder: media.write(folder)["smoke"][0], media.DEPTH, "reverse", TRACKED, PRBVOLPATH,
        parameter=media.DENSITY,
    ),
    "a box in fog": Case(
        lambda folder: _floating_box(folder, "fog_box", _LAMP + _FOG), 3, "forward",
        {name: BOUNDARY[name] for name in BOUNDARY if name not in ("ours, Grid", "ours, EdgeSampling")}, {},
        parameter="box.vertex_positions", direction=UP, step=0.008, counts=_SHAPE_COUNTS,
    ),
}  # fmt: skip


def _exact_cases() -> dict[str, Case]:
    """What float32 costs: values that are known in float64."""
    cases = {}
    pixels, counts = (16, 16), ((4, 8, 16, 32), (4, 16, 64, 256))
    common = {"depth": exact.FURNACE_DEPTH, "pixels": pixels, "counts": counts, "rr_depth": NEVER}
    cases["white furnace"] = Case(
        exact.write_furnace, kind="image", ours=IMAGE, mitsuba=PATH, closed=exact.furnace, **common
    )
    cases["white furnace: albedo"] = Case(
        exact.write_furnace, kind="forward", ours=INTERIOR, mitsuba=PRB, parameter="walls.bsdf.reflectance.value",
        direction=(1.0, 1.0, 1.0), closed=exact.furnace_derivative, **common,
    )  # fmt: skip
    common = {"depth": 2, "pixels": pixels, "counts": ((4, 16, 64, 256), (4, 16, 64, 256, 1024))}
    setups = {f"moved {away:.0e} sizes away".replace("e+0", "e"): exact.Plane(away=away) for away in (1e2, 1e4, 1e6)}
    setups |= {f"light of radius {r:.0e}".replace("e-0", "e-"): exact.Plane(radius=r) for r in (1e-3, 1e-5)}
    for name, plane in setups.items():
        quick = name in ("moved 1e4 sizes away", "light of radius 1e-5")
        cases[name] = Case(
            plane.write, kind="image", ours=IMAGE, mitsuba=PATH, closed=plane.image, quick=quick, **common
        )
        cases[f"{name}: its height"] = Case(
            plane.write, kind="forward", ours=PLAIN, mitsuba=UNGUIDED, parameter="light.vertex_positions",
            direction=exact.HEIGHT, closed=plane.derivative, quick=quick, **common,
        )  # fmt: skip
    return cases


EXACT = _exact_cases()
ALL = IMAGES | MATERIALS | SHAPES | MEDIA | EXACT
