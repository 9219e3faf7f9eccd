"""Derivatives beside exact shapes that shine: what moves in their light, and the lights, all terms together."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, box, camera, diffuse, floor, load, panel, register, sky
from .test_exact_sphere import ROTATION, TILES, entry, moved_light, radius, scene_shape
from .test_sdfgrid import all_values
from .test_side_by_side import BALL, beside
from .test_tubes import coordinate

LIGHT, THING, FLOOR = "light.to_world", "thing.to_world", "floor.to_world"
CORNERS = "thing.vertex_positions"
POSES = {
    "sphere": T.translate([0.5, -0.5, 2.2]).rotate([0, 1, 1], 35.0).scale([0.5, 0.3, 0.4]),
    "disk": T.translate([0.5, -0.5, 2.2]).rotate([1, 0.3, 0], 165.0).scale([0.5, 0.4, 0.5]),
    "cylinder": T.translate([0.1, -0.5, 2.2]).rotate([0, 1, 0], 80.0).scale([0.2, 0.25, 0.8]),
}
ROUND = ("sphere", "cylinder")
#: The camera that does not see the lights, and the one that sees the light, low behind what is in front of it.
AWAY = camera((0.3, -3.0, 2.0), (0.0, 0.0, 0.3), fov=38.0)
FACING = camera((0.3, -3.0, 1.6), (0.0, 0.0, 0.9), fov=50.0)
LOW = T.translate([0.2, 0.9, 1.3]).rotate([0, 1, 1], 35.0).scale([0.5, 0.35, 0.45])


def area(value) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(value)}}


def light(kind: str, **more) -> dict:
    """A black shape that shines."""
    emitter = area((10.0, 9.0, 8.0))
    return {"type": kind, "exact": True, "to_world": POSES[kind], "emitter": emitter, "bsdf": diffuse(0.0), **more}


def ball(**more) -> dict:
    pose = T.translate([0.1, 0.0, 0.75]).rotate([0, 1, 1], 35.0).scale([0.5, 0.35, 0.45])
    return {"type": "sphere", "exact": True, "to_world": pose, "bsdf": diffuse(0.7, 0.5, 0.3), **more}


def body() -> dict:
    return box((0.1, 0.0, 0.7), (0.35, 0.3, 0.25), diffuse(0.7, 0.5, 0.3), turn=0.4)


def room(kind: str, thing, **more):
    """A light over a floor, and a thing between the two."""
    return lambda: {"sensor": AWAY, "floor": floor(half=2.0), "thing": thing(), "light": light(kind), **more}


def seen(kind: str):
    """The camera sees the light, a part of which a ball hides."""
    return lambda: {
        "sensor": FACING,
        "floor": floor(half=2.0),
        "thing": ball(),
        "light": light(kind, to_world=LOW),
        "wall": panel((0.0, 2.0, 3.0), 0.3, radiance=4.0),
    }


def walled():
    """Light between a wall, a ball and a light that reflects as well."""
    wall = T.translate([-0.75, 0.1, 0.8]).rotate([0, 1, 0], 80.0).scale(0.6)
    return {
        **room("sphere", ball)(),
        "light": light("sphere", bsdf=diffuse(0.5)),
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "twosided", "bsdf": diffuse(0.3, 0.6, 0.8)}},
    }


def among(kind: str, interpolation: str, plugin: str):
    """A light beside a grid and a curve."""
    others = beside("lamp", interpolation, BALL, plugin)()
    return lambda: {**{name: others[name] for name in ("sensor", "floor", "body", "hair")}, "light": light(kind)}


def painted(kind: str):
    """The light has a texture."""
    radiance = {"type": "bitmap", "bitmap": 12.0 * TILES, "raw": True}
    return lambda: {**room(kind, ball)(), "light": light(kind, emitter={"type": "area", "radiance": radiance})}


register(
    {
        **{f"{kind} light, body": room(kind, body) for kind in POSES},
        **{f"{kind} light, ball": room(kind, ball) for kind in POSES},
        **{f"{kind} light, seen": seen(kind) for kind in POSES},
        "disk light, grid and tube": among("disk", "linear", "bsplinecurve"),
        "sphere light, sky": room("sphere", ball, sky=sky()),
        "sphere light, wall": walled,
        **{f"{kind} light, painted": painted(kind) for kind in POSES},
        "cylinder light, inwards": lambda: {
            **room("cylinder", ball)(),
            "light": light(
                "cylinder",
                flip_normals=True,
                to_world=T.translate([0.5, -0.5, 2.1]).rotate([1, 0.3, 0], 10.0).scale([0.5, 0.4, 0.4]),
            ),
        },
    }
)

CASES = [
    # What moves in their light.
    Case("disk light, body", CORNERS, moved_light, 0.01, "the body moves", 2, 256, 4096),
    *(Case(f"{kind} light, body", CORNERS, moved_light, 0.02, "the body moves", 2, 512, 8192) for kind in ROUND),
    *(Case(f"{kind} light, ball", THING, radius, 0.02, "the ball grows", 2, 2048, 8192) for kind in POSES),
    Case("sphere light, ball", THING, entry(0, 3), 0.02, "the ball moves", 2, 2048, 8192),
    Case("sphere light, ball", FLOOR, entry(2, 3), 0.02, "the floor moves", 2, 1024, 4096),
    Case("sphere light, ball", "sensor.to_world", entry(0, 3), 0.02, "the camera moves", 2, 1024, 4096),
    # The lights.
    *(
        Case(f"{kind} light, ball", LIGHT, tangent, 0.02, f"the light {what}", 2, spp, 4 * spp)
        for kind in POSES
        for what, tangent, spp in (
            ("grows", radius, 512),
            ("moves", entry(0, 3), 2048),
            ("sinks", entry(2, 3), 1024),
            ("turns", ROTATION, 6144),
        )
    ),
    Case("disk light, body", LIGHT, radius, 0.02, "the light grows", 2, 256, 512),
    *(Case(f"{kind} light, body", LIGHT, radius, 0.02, "the light grows", 2, 512, 2048) for kind in ROUND),
    *(Case(f"{kind} light, seen", LIGHT, radius, 0.01, "the light grows", 2, 512, 2048) for kind in POSES),
    *(Case(f"{kind} light, seen", LIGHT, entry(0, 3), 0.01, "the light moves", 2, 512, 4096) for kind in POSES),
    Case("sphere light, seen", THING, entry(0, 3), 0.01, "the ball moves", 2, 512, 4096),
    Case("sphere light, seen", "sensor.to_world", entry(0, 3), 0.01, "the camera moves", 2, 512, 4096),
    # What they hide of other lights.
    Case("sphere light, sky", LIGHT, radius, 0.02, "the light grows", 2, 1024, 4096),
    Case("sphere light, sky", LIGHT, entry(0, 3), 0.02, "the light moves", 2, 4096, 16384),
    Case("cylinder light, inwards", LIGHT, radius, 0.02, "the light grows", 2, 1024, 4096),
    Case("cylinder light, inwards", LIGHT, entry(2, 3), 0.02, "the light sinks", 2, 2048, 8192),
    Case("cylinder light, inwards", THING, radius, 0.02, "the ball grows", 2, 2048, 8192),
    # Light that is scattered on.
    Case("sphere light, wall", LIGHT, radius, 0.02, "the light grows", 4, 1024, 4096),
    Case("sphere light, wall", LIGHT, entry(2, 3), 0.02, "the light sinks", 4, 2048, 8192),
    Case("sphere light, wall", THING, radius, 0.02, "the ball grows", 4, 2048, 8192),
    # Beside grids and curves.
    *(
        Case("disk light, grid and tube", name, tangent, step, what, 2, 2048, 8192)
        for what, name, tangent, step in (
            ("the grid", "body.grid", all_values, 0.003),
            ("the grid rises", "body.to_world", entry(2, 3), 0.01),
            ("the curve", "hair.control_points", coordinate(3), 0.004),
            ("the curve moves", "hair.to_world", entry(0, 3), 0.01),
            ("the light grows", LIGHT, radius, 0.01),
            ("the light moves", LIGHT, entry(0, 3), 0.01),
        )
    ),
    # The camera looks through the lights.
    Case("sphere light, seen", LIGHT, radius, 0.02, "the light grows, unseen", 2, 512, 2048, hidden=True),
    Case("sphere light, seen", THING, entry(0, 3), 0.02, "the ball moves, unseen", 2, 1024, 4096, hidden=True),
    Case("cylinder light, seen", LIGHT, entry(2, 3), 0.02, "the light sinks, unseen", 2, 1024, 4096, hidden=True),
    # Textures that they carry along.
    *(Case(f"{kind} light, painted", LIGHT, radius, 0.02, "the light grows", 2, 1024, 4096) for kind in POSES),
    *(Case(f"{kind} light, painted", LIGHT, ROTATION, 0.02, "the light turns", 2, 6144, 8192) for kind in POSES),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "others"),
    [
        ("sphere light, wall", [THING]),
        ("cylinder light, seen", [THING]),
        ("disk light, body", [CORNERS]),
        ("disk light, grid and tube", ["body.grid", "hair.control_points"]),
    ],
)
def test_reverse_mode_is_the_transpose(name: str, others: list[str]) -> None:
    scene, params = load(name)
    names = [LIGHT, FLOOR, *others]
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 8, "seed": 1}
    assert_transposes(scene, params, names, options)


METHODS = {
    "kdtree": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=512)),
    "octree": psdr.boundary.PathSpace(guiding=psdr.guiding.Octree(max_leaves=512)),
    "grid": psdr.boundary.PathSpace(guiding=psdr.guiding.Grid(shape=(64, 4, 4), photons=2000, importons=2000)),
    "projective": psdr.boundary.Projective(),
    "projective, octree": psdr.boundary.Projective(guiding=psdr.guiding.Octree(max_leaves=512), paths=8192),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "case",
    [
        Case("sphere light, body", CORNERS, moved_light, 0.02, "the body moves", 2, 512, 8192),
        Case("cylinder light, ball", THING, radius, 0.02, "the ball grows", 2, 2048, 8192),
        Case("disk light, body", LIGHT, radius, 0.02, "the light grows", 2, 512, 2048),
    ],
    ids=str,
)
def test_other_ways_to_sample_agree(case: Case, method: str) -> None:
    psdr.guiding.reset(load(case.scene)[0])
    assert_agrees(derivatives(case, "forward", METHODS[method]), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("kind", POSES)
def test_is_the_fine_tessellations(kind: str) -> None:
    """By every number of the light's pose, and of the floor's and the ball's, under a sky that the light hides."""
    found = {}
    for form in ({}, {"exact": False, "resolution": 256, "face_normals": True}):
        whole = {**room(kind, ball)(), "sky": sky(0.3)}
        whole["light"] = {**whole["light"], **form}
        scene = psdr.load_dict({"type": "scene", **whole})
        params = psdr.traverse(scene)
        params.requires_grad_only(LIGHT, FLOOR, THING)
        batches = []
        for seed in range(8):
            params.zero_grad()
            options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 2048, "seed": seed}
            psdr.render_backward(scene, params, np.ones((*scene_shape(scene), 3)), **options)
            batches.append(np.stack([params[n].grad.numpy().ravel() for n in (LIGHT, FLOOR, THING)]))
        found[bool(form)] = np.array(batches, np.float64)
    a, b = found[False], found[True]
    gap, error = a.mean(axis=0) - b.mean(axis=0), np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 8.0)
    scale = np.abs(b.mean(axis=0)).max(axis=1, keepdims=True)
    assert (np.abs(gap) < 5.0 * error + 0.01 * scale).all(), gap / scale
    assert (error < 0.05 * scale).all()


def test_a_hidden_light_that_runs_through_something_is_refused() -> None:
    scene = psdr.load_dict({"type": "scene", **room("sphere", ball)(), "light": light("sphere", to_world=T.scale(0.3))})
    integrator = psdr.PathIntegrator(max_depth=2, hide_emitters=True)
    with pytest.raises(ValueError, match="'light', a light that hide_emitters hides, runs through the surface of"):
        psdr.plan(scene, names=[THING], integrator=integrator)
    psdr.plan(scene, names=[THING], integrator=psdr.PathIntegrator(max_depth=2))
