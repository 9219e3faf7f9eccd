"""Every kind of shape, scattering model and light in one scene, swept over sizes and places.

**A new kind joins by a line of its table**, and ``test_every_kind_is_listed`` fails until it has one. Shapes hang above
a floor in a row, one after another of every model, under all lights; the first shape moves. Compared is the scene of
size one at the origin, with the same random numbers. Powers of two scale every float32 number exactly, so that any
length that does not scale with the scene shows in the last bit.
"""

import functools
import itertools
from collections.abc import Sequence

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene.plugins import PLUGINS

from .record import Case, parameters
from .sweeps import Result, passes, worst

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

T = psdr.Transform
SIZE, VELOCITY = 0.4, np.array([0.3, 0.5, -0.2])
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
METAL = {"eta": {"type": "rgb", "value": 0.5}, "k": 3.0}

#: Pose in world units -> the shape. Files of meshes become "mesh" on loading.
SHAPES = {
    "sphere": lambda pose: {"type": "sphere", "to_world": pose},
    "rectangle": lambda pose: {"type": "rectangle", "to_world": pose},
    "cube": lambda pose: {"type": "cube", "to_world": pose},
    "disk": lambda pose: {"type": "disk", "to_world": pose},
    "cylinder": lambda pose: {"type": "cylinder", "to_world": pose},
    "mesh": lambda pose: {
        "type": "mesh", "faces": FACES, "face_normals": True,
        "vertices": CORNERS @ pose.matrix[:3, :3].T + pose.matrix[:3, 3],
    },
}  # fmt: skip
BSDFS = {
    "diffuse": {"type": "diffuse", "reflectance": 0.6},
    "twosided": {"type": "twosided", "a": {"type": "diffuse", "reflectance": 0.4}},
    "roughconductor": {"type": "roughconductor", "alpha": 0.3} | METAL,
    "beckmann": {"type": "roughconductor", "alpha": 0.3, "distribution": "beckmann"} | METAL,
    "conductor": {"type": "conductor"} | METAL,
    "dielectric": {"type": "dielectric", "int_ior": 1.5},
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.4},
    "roughplastic": {"type": "roughplastic", "diffuse_reflectance": 0.4, "alpha": 0.3},
    "orennayar": {"type": "orennayar", "sigma": 0.5},
    "ashikhminshirley": {"type": "ashikhminshirley", "nu": 20.0},
    "abc": {"type": "abc", "A": 0.3, "B": 20.0, "C": 1.5} | METAL,
    "principled": {"type": "principled", "metallic": 0.3, "clearcoat": 0.5, "sheen": 0.5, "anisotropic": 0.5},
    "mask": {"type": "mask", "opacity": 0.6, "a": {"type": "diffuse"}},
    "blendbsdf": {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": {"type": "conductor"} | METAL},
}
#: An image that ends in black: its light has no edge.
FRAMED = np.pad(np.full((4, 4, 3), 0.7, np.float32), ((1, 1), (1, 1), (0, 0)))
#: (size, where) -> the light; what an inverse square divides by has to scale.
LIGHTS = {
    "area": lambda s, at: {
        "type": "rectangle", "to_world": T.translate(at((0.5, 0.0, 3.5))) @ T.scale(0.5 * s) @ T.rotate((1, 0, 0), 180),
        "emitter": {"type": "area", "radiance": 8.0},
    },
    "point": lambda s, at: {"type": "point", "position": at((-1.0, -2.0, 3.0)), "intensity": 6.0 * s * s},
    "spot": lambda s, at: {
        "type": "spot", "intensity": 20.0 * s * s, "cutoff_angle": 40.0, "beam_width": 20.0,
        "to_world": T.look_at(at((1.5, -1.0, 3.0)), at((0.0, 0.0, 0.0)), (0, 0, 1)),
    },
    "projector": lambda s, at: {
        "type": "projector", "scale": 6.0 * s * s, "fov": 80.0,
        "irradiance": {"type": "bitmap", "bitmap": FRAMED},
        "to_world": T.look_at(at((-1.0, 1.0, 4.0)), at((0.0, 0.0, 0.0)), (0, 1, 0)),
    },
    "directional": lambda s, at: {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": 1.0},
    "envmap": lambda s, at: {
        "type": "envmap", "bitmap": np.random.default_rng(5).uniform(0.2, 1.0, (6, 12, 3)).astype(np.float32),
    },
    "constant": lambda s, at: {"type": "constant", "radiance": 0.5},
}  # fmt: skip


def scene(size: float, offset: Sequence[float], sky: str, masked: bool) -> dict:
    """Return the scene ``size`` large and ``offset`` away, with one of the two lights that surround it.

    ``masked``: with a mask, and without lights of no area, beside which what moves is refused then.
    """

    def at(point) -> list[float]:
        return (size * np.asarray(point) + np.asarray(offset)).tolist()

    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    found = {
        "type": "scene",
        "camera": {
            "type": "perspective", "fov": 40.0, "near_clip": 0.01 * size, "far_clip": 100.0 * size, "film": film,
            "to_world": T.look_at(at((0.0, -5.0, 3.0)), at((0.0, 0.0, 0.5)), (0, 0, 1)),
        },
        "floor": {"type": "rectangle", "to_world": T.translate(at((0, 0, 0))) @ T.scale(3.0 * size),
                  "bsdf": BSDFS["diffuse"]},
    }  # fmt: skip
    bsdfs = [bsdf for name, bsdf in BSDFS.items() if masked or name != "mask"]
    count = max(len(SHAPES), len(bsdfs))
    for i in range(count):
        shape = list(SHAPES.values())[i % len(SHAPES)]
        place = ((i - 0.5 * (count - 1)) * 0.7, 0.1 * (-1) ** i, 0.8 + 0.05 * i)
        pose = (
            T.translate(at(place))
            @ T.rotate((0.28221627, 0.18814418, 0.94072091), 25.0 + 40.0 * i)
            @ T.scale(0.5 * SIZE * size)
        )
        found[f"shape{i}"] = shape(pose) | {"bsdf": bsdfs[(i + 1) % len(bsdfs)]}
    shown = {"area", sky} if masked else set(LIGHTS) - {"envmap", "constant"} | {sky}
    lights = {name: light for name, light in LIGHTS.items() if name in shown}
    return found | {name: light(size, at) for name, light in lights.items()}


@functools.cache
def result(size: float = 1.0, offset=(0.0, 0.0, 0.0), sky: str = "envmap", masked: bool = False) -> Result:
    """Return image and derivatives of the scene as its last shape, a mesh, moves."""
    name = f"shape{list(SHAPES).index('mesh')}.vertex_positions"
    loaded = psdr.load_dict(scene(size, offset, sky, masked))
    return passes(loaded, size * VELOCITY, name=name, depth=3, spp=8)


def sizes(exponents, sky: str = "envmap") -> float:
    cases = itertools.product(exponents, (False, True))
    return max(worst(result(2.0**k, sky=sky, masked=m), result(sky=sky, masked=m)) for k, m in cases)


def places(decades) -> float:
    cases = itertools.product(decades, (False, True))
    away = {k: tuple((10.0**k * np.array([1.0, 0.7, -0.4])).tolist()) for k in decades}
    return max(worst(result(1.0, away[k], masked=m), result(masked=m)) for k, m in cases)


CASES = (
    Case(
        family="kinds", name="every kind, size 2^-13 .. 2^20", bound=0.0, slow=True,
        measure=lambda: max(sizes((-13, 7, 20)), sizes((-13, 20), "constant")),
        hard="any length that does not scale with the scene shows", naive="a ray epsilon of 1e-4 is the whole scene",
    ),
    Case(
        family="kinds", name="every kind, 1e4 and 1e6 sizes away", bound=1.3e-5, slow=True,
        measure=lambda: places((4, 6)),
        hard="positions of lights and shapes are rounded before they are subtracted", naive="black at 1e6",
    ),
    Case(
        family="kinds", name="every kind, 1e2 sizes away, which is not moved to the origin", bound=5e-3, slow=True,
        measure=lambda: places((2,)),
        hard="derivatives of what mirrors and glass show magnify roundings; images are within 1e-5",
        naive="a ray epsilon of 1e-4 is less than the roundings",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_kinds(case, check) -> None:
    check(case)


def test_every_kind_is_listed() -> None:
    """Kinds of files are read as meshes; wrappers and textures have tests of their own.

    Curves move in ``tests/boundary/test_tubes.py``, grids of distances in ``tests/boundary/test_sdfgrid.py``, and
    ``tests/path/test_sdfgrid.py`` scales those; networks move in ``tests/interior/test_neuralsdf.py``.
    """
    resting = {"sdfgrid", "linearcurve", "bsplinecurve", "neuralsdf"}
    files = {"ply", "obj", "stl", "off", "gltf", "glb", "serialized"}
    assert set(PLUGINS["shape"]) - files - resting - {"shapegroup", "instance", "merge"} == set(SHAPES)
    # A map needs texture coordinates; its heights are lengths along them. Beside rough glass and
    # thin sheets nothing may move, nor beside what light passes without a turn, if it comes from a point.
    others = {"normalmap", "bumpmap", "roughdielectric", "principledthin", "thindielectric", "null"}
    assert set(PLUGINS["bsdf"]) - others == set(BSDFS) - {"beckmann"}
    # Beside the hard edge of its light nothing may move; a sunsky is two others.
    assert set(PLUGINS["emitter"]) - {"directionalarea", "sunsky"} == set(LIGHTS)
