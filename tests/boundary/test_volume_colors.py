"""Colours of a grid of voxels on shapes without triangles: what is read, and derivatives of what colours or moves."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, sphere
from tests.path.helpers import assert_same_mean, batches, blocks

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, floor, load, register
from .test_exact_sphere import LIGHTS, POSE, ROTATION, VIEW, entry
from .test_sdfgrid import MATRIX, one_half, values
from .test_tubes import coordinate, tube

VOXELS = np.random.default_rng(4).uniform(0.05, 0.95, (4, 3, 5, 3)).astype(np.float32)
BOX = T.translate([-0.6, -0.4, -0.1]) @ T.rotate([0.2, 0.5, 0.8], 25) @ T.scale([1.3, 1.2, 1.5])
DATA, PLACED = (f"body.bsdf.reflectance.volume.{name}" for name in ("data", "to_world"))
GRID, POINTS, MOVES, SHIFT = "body.grid", "body.control_points", "body.to_world", "body.layer2.bias"
#: Of a value between voxels, in float32.
ROUNDING = 2.0e-5


def colors(**more) -> dict:
    grid = {"type": "gridvolume", "data": VOXELS, "to_world": BOX, **more}
    return {"type": "diffuse", "reflectance": {"type": "volume", "volume": grid}}


BODIES = {
    "cubic": lambda: {"type": "sdfgrid", "grid": values(), "interpolation": "cubic", "to_world": T(MATRIX)},
    "linear": lambda: {"type": "sdfgrid", "grid": values(), "normals": "analytic", "to_world": T(MATRIX)},
    "exact": lambda: {"type": "sphere", "exact": True, "to_world": POSE},
    "network": lambda: fitted(sphere, (24, 24)).plugin(to_world=T(MATRIX)),
    "tube": lambda: {"type": "bsplinecurve", "control_points": tube("fat")},
}


def room(body: str, light: str, **more):
    def made() -> dict:
        shape = {**BODIES[body](), "bsdf": colors(), **more}
        return {"sensor": VIEW, "floor": floor(half=2.0), "body": shape, **LIGHTS[light]()}

    return made


register(
    {
        **{f"{body}, voxels, lamp": room(body, "lamp") for body in BODIES},
        "fine, voxels, lamp": room("exact", "lamp", exact=False, resolution=320),
    }
)


def at_random(value):
    return 0.5 * np.random.default_rng(5).standard_normal(value.shape)


#: Of every kind what moves its surface.
OWN = {
    "cubic": (GRID, one_half, 0.003),
    "linear": (GRID, one_half, 0.003),
    "exact": (MOVES, ROTATION, 0.01),
    "network": (SHIFT, np.ones_like, 0.003),
    "tube": (POINTS, coordinate(2, 4), 0.004),
}
CASES = [
    Case(f"{body}, voxels, lamp", name, tangent, step, what, 2, spp, 4 * spp)
    for body in BODIES
    for what, name, tangent, step, spp in (
        ("voxels", DATA, at_random, 0.05, 64),
        ("the volume moves", PLACED, entry(0, 3), 0.01, 256),
        ("its own", *OWN[body], 1024),
        ("x", MOVES, entry(0, 3), 0.01, 1024),
        ("the camera moves", "sensor.to_world", entry(0, 3), 0.01, 1024),
    )
]
CASES += [Case("cubic, voxels, lamp", "floor.to_world", entry(2, 3), 0.01, "the floor moves", 3, 1024, 4096)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_reverse_mode_is_the_transpose() -> None:
    scene, params = load("cubic, voxels, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [GRID, MOVES, DATA, PLACED, "sensor.to_world"], options)


def interpolated(x: np.ndarray) -> np.ndarray:
    """Colours (N, 3) at points (N, 3) of the scene: voxels have their values in their middles."""
    size = np.array(VOXELS.shape[2::-1])
    q = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(BOX.matrix)[:3].T * size - 0.5
    low = np.floor(q).astype(int)
    f, found = q - low, np.zeros((len(x), 3))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = np.clip(low + corner, 0, size - 1).T
        found += VOXELS[k, j, i] * np.where(corner, f, 1.0 - f).prod(axis=1)[:, None]
    return found


@pytest.mark.parametrize("body", ["cubic", *(pytest.param(b, marks=pytest.mark.slow) for b in BODIES if b != "cubic")])
def test_voxels_are_read_where_the_surface_is(body: str) -> None:
    whole = {"type": "scene", **room(body, "lamp")()}
    del whole["floor"]
    film = {**VIEW["film"], "rfilter": {"type": "box"}}
    scene = psdr.load_dict({**whole, "sensor": {**VIEW, "film": film}})
    found = psdr.render_aov(scene, ["albedo", "position"], spp=1)
    seen = (found["albedo"].numpy() > 0.0).any(axis=-1)  # the lamp is black
    assert seen.sum() > 20
    x, albedo = (found[name].numpy()[seen] for name in ("position", "albedo"))
    np.testing.assert_allclose(albedo, interpolated(x.astype(np.float64)), atol=ROUNDING)
    assert np.ptp(albedo) > 0.2


@pytest.mark.slow
def test_images_equal_those_of_a_fine_mesh() -> None:
    exact, fine = (batches(load(f"{body}, voxels, lamp")[0], spp=256, max_depth=3) for body in ("exact", "fine"))
    # Facets of a 320th of a turn leave the sphere by 5e-5.
    assert_same_mean(blocks(exact, 2), blocks(fine, 2), "voxels on a sphere", 1.0e-3)


def test_nearest_voxels_may_not_slide() -> None:
    """Points of grids slide whatever moves, those of exact shapes with their own shape."""
    for body, refused in (
        ("cubic", ("floor.to_world", "sensor.to_world", GRID)),
        ("exact", (MOVES, "sensor.to_world")),
    ):
        scene = psdr.load_dict({"type": "scene", **room(body, "lamp", bsdf=colors(filter_type="nearest"))()})
        for name in refused:
            with pytest.raises(ValueError, match="trilinear"):
                psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=2))
        psdr.plan(scene, names=[DATA, "floor.bsdf.reflectance.value"], integrator=psdr.PathIntegrator(max_depth=2))
