"""Exact shapes that are smooth mirrors or glass themselves: what moves, and is seen in them, against differences."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import ALONG, GLASS, MIRROR, behind, glass, lamp, shining
from .scenes import T, camera, diffuse, floor, load, panel, register
from .test_exact_sphere import POSE, TILES, VIEW, entry, radius

PAPER = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": TILES, "raw": True}}
LAMP = {"light": panel((0.8, -0.8, 2.5), 0.4)}
TWO_SIDED = {"type": "twosided", "bsdf": MIRROR}
BALL, OTHER = "ball.to_world", "other.to_world"


def soft_sky():
    """A map of low frequencies, other in each channel."""
    theta, phi = (np.arange(8)[:, None] + 0.5) / 8 * np.pi, (np.arange(16) + 0.5) / 16 * 2 * np.pi
    channels = [1.0 + 0.5 * np.sin(theta) * np.cos(phi + k) + (0.4 - 0.4 * k) * np.cos(theta) for k in range(3)]
    return {"type": "envmap", "bitmap": np.float32(np.stack(channels, -1)), "to_world": T.rotate([1, 0, 0], 90)}


def exact(kind, pose, bsdf, **more):
    return {"type": kind, "exact": True, "to_world": pose, "bsdf": bsdf, **more}


def sphere(center, size, bsdf):
    return exact("sphere", T.translate(list(center)).scale(size), bsdf)


def room(bsdf, kind="sphere", pose=POSE, **more):
    """A mirror, or glass, over a papered floor."""
    return {"sensor": VIEW, "floor": floor(half=2.0, bsdf=PAPER), "ball": exact(kind, pose, bsdf), **more}


BLUE = diffuse(0.3, 0.6, 0.8)
GLOW = shining(sphere((0.9, 0.3, 0.6), 0.2, diffuse(0.0)), 3.0, 2.4, 1.8)
register(
    {
        "exact mirror, close": lambda: {
            "sensor": camera((0.3, -4.0, 0.6), (0.15, 0.0, 0.7), fov=6.0),
            "sky": soft_sky(),
            "ball": exact("sphere", POSE, MIRROR),
        },
        "exact mirror, sky": lambda: {"sensor": VIEW, "sky": soft_sky(), "ball": exact("sphere", POSE, MIRROR)},
        "exact mirror, behind": lambda: {
            **behind(),
            "mirror": sphere((0.0, 1.5, 0.6), 1.0, MIRROR),
            "lamp": lamp((-1.6, -2.6, 1.9), 0.9),
        },
        "exact glass, behind": lambda: glass(sphere((0.0, 0.0, 0.0), 0.7, GLASS)),
        "exact mirror, lamp": lambda: room(MIRROR, **LAMP),
        "exact mirror, two": lambda: room(MIRROR, **LAMP, other=sphere((-0.75, -0.1, 0.5), 0.3, BLUE), glow=GLOW),
        "exact cylinder": lambda: room(
            TWO_SIDED,
            "cylinder",
            T.translate([0.1, 0.1, 0.3]).rotate([1, 0, 0], 10.0).scale([0.4, 0.4, 0.8]),
            **LAMP,
            other=sphere((-0.6, -0.6, 0.35), 0.25, BLUE),
        ),
    }
)
X = entry(0, 3)


def axis(pose):
    """One axis of an ellipsoid grows."""
    r = 0.0 * pose
    r[0, :3] = pose[0, :3]
    return r


CASES = [
    # Nothing but a sky: all of it is the interior, of which the limb has no jump, and rare large samples.
    Case("exact mirror, close", BALL, axis, 0.005, "axis", 2, 16, 64, slow=False),
    Case("exact mirror, sky", BALL, X, 0.005, "x", 2, 4096, 1024),
    Case("exact mirror, sky", BALL, axis, 0.005, "axis", 2, 4096, 1024),
    # Lamps that are seen in it, or through it: nothing but edges.
    Case("exact mirror, behind", "mirror.to_world", X, 0.002, "x", spp=6144, difference_spp=24576),
    Case("exact mirror, behind", "lamp.vertex_positions", ALONG, 0.01, "lamp moves", spp=6144, difference_spp=24576),
    Case("exact glass, behind", "glass.to_world", X, 0.002, "x", 4, 4096, 16384),
    Case("exact glass, behind", "glass.bsdf.eta", np.ones_like, 0.005, "index", 4, 4096, 16384),
    Case("exact glass, behind", "lamp.vertex_positions", ALONG, 0.01, "lamp moves", 4, 2048, 8192),
    # A papered floor, a lamp, its shadows and other exact shapes.
    Case("exact mirror, two", "glow.to_world", radius, 0.005, "lamp grows", 3, 4096, 16384),
    Case("exact mirror, two", "sensor.to_world", X, 0.005, "camera moves", 3, 3072, 12288),
    Case("exact mirror, lamp", BALL, X, 0.005, "x", 3, 10240, 40960),
]


@pytest.mark.slow_rows("exact mirror, close, axis, depth 2-forward")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "names", "depth"),
    [
        ("exact mirror, two", [BALL, OTHER, "glow.to_world", "floor.to_world", "sensor.to_world"], 3),
        ("exact glass, behind", ["glass.to_world", "glass.bsdf.eta", "lamp.vertex_positions", "sensor.to_world"], 4),
        ("exact cylinder", [BALL, OTHER, "light.vertex_positions"], 4),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names, depth) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 16, "seed": 3})


@pytest.mark.slow
def test_a_fine_mesh_has_the_same_derivative() -> None:
    """A mirror ball of 10^5 triangles with interpolated normals, below its limb, under a sky."""
    view = camera((0.3, -4.0, 0.6), (0.15, 0.0, 0.7), fov=6.0)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
    images = []
    for more in ({"exact": True}, {"resolution": 230}):
        ball = {"type": "sphere", "to_world": POSE, "bsdf": MIRROR, **more}
        scene = psdr.load_dict({"type": "scene", "sensor": view, "sky": soft_sky(), "ball": ball})
        params = psdr.traverse(scene)
        tangent = {"ball.to_world": np.float32(axis(params["ball.to_world"].numpy()))}
        images.append(psdr.render_forward(scene, params, tangent, integrator=integrator, spp=64, seed=1).numpy())
    exact_one, fine = (image.astype(np.float64) for image in images)
    assert abs((exact_one * fine).sum() / (fine * fine).sum() - 1.0) < 0.002
