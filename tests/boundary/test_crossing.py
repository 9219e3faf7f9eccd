"""Derivatives of exact shapes that meshes run through, all terms together: their common curves move with both."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.crossing_curves import cut
from warp_psdr.topology.crossing_fields import EXACT_FIELDS, Field

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, SHEAR, entry, moved_light, radius

VIEW = camera((0.3, -2.2, 1.5), (0.0, 0.0, 0.15), fov=45.0)
TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.3), "other": diffuse(0.3, 0.6, 0.5)}
#: Each is sunk into the floor, the disk and the cylinder aslant.
POSES = {
    "sphere": T.translate([0.1, 0.0, 0.2]).rotate([0, 1, 1], 35.0).scale([0.6, 0.45, 0.5]),
    "disk": T.translate([0.1, 0.0, 0.15]).rotate([1, 0.3, 0], 60.0).scale(0.6),
    "cylinder": T.translate([0.1, 0.2, -0.2]).rotate([1, -1, 0], 25.0).scale([0.4, 0.3, 0.9]),
}


def sunk(kind: str, light: str):
    shape = {"type": kind, "exact": True, "to_world": POSES[kind], "bsdf": TWO_SIDED}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "shape": shape, **LIGHTS[light]()}


def pierced_wall():
    """A ball that reaches through a wall, over a floor: light between all three."""
    wall = T.translate([0.35, 0.1, 0.5]).rotate([0, 1, 0], 80.0).scale(0.7)
    bsdf = {"type": "twosided", "bsdf": diffuse(0.3, 0.6, 0.8)}
    return {**sunk("sphere", "lamp")(), "wall": {"type": "rectangle", "to_world": wall, "bsdf": bsdf}}


def crossed(light: str):
    """A ball with another one in its side, a plate and a pipe through it, over a floor."""
    pipe = {"p0": [0.1, -0.35, 0.75], "p1": [0.25, 0.3, 0.95], "radius": 0.15}
    shapes = {
        "shape": {"type": "sphere", "center": [0.1, 0.0, 0.6], "radius": 0.35, "bsdf": diffuse(0.7, 0.5, 0.3)},
        "other": {"type": "sphere", "center": [-0.3, -0.15, 0.5], "radius": 0.25, "bsdf": diffuse(0.3, 0.6, 0.5)},
        "plate": {"type": "disk", "to_world": T.translate([0.3, 0.0, 0.5]).rotate([1, 1, 0], 25.0).scale(0.4)},
        "pipe": {"type": "cylinder", **pipe},
    }
    whole = {name: {"exact": True, "bsdf": TWO_SIDED, **shape} for name, shape in shapes.items()}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), **whole, **LIGHTS[light]()}


register({f"sunk {kind}, {light}": sunk(kind, light) for kind in POSES for light in LIGHTS})
register({"sunk, wall": pierced_wall, **{f"crossed, {light}": crossed(light) for light in LIGHTS}})
NAME, FLOOR = "shape.to_world", "floor.to_world"
FAST = ("sphere", "lamp", "z")
MOTIONS = (("radius", NAME, radius), ("z", NAME, entry(2, 3)), ("x", NAME, entry(0, 3)))
CASES = [
    *(
        Case(
            f"sunk {kind}, {light}",
            name,
            tangent,
            0.005,
            what,
            2,
            512 if (kind, light, what) == FAST else 1024,
            2048 if (kind, light, what) == FAST else 16384 if (light, what) == ("sky", "x") else 4096,
            slow=(kind, light, what) != FAST,
        )
        for kind in POSES
        for light in ("sky", "lamp", "point", "sun")
        for what, name, tangent in MOTIONS
    ),
    *(
        Case(f"sunk {kind}, {light}", NAME, SHEAR, 0.005, "shear", 2, 2048, 8192)
        for kind in POSES
        for light in ("sky", "lamp")
    ),
    *(
        Case(f"sunk {kind}, lamp", name, tangent, 0.005, what, depth, 1024, 4096)
        for kind in POSES
        for what, name, tangent, depth in (
            ("the floor moves", FLOOR, entry(2, 3), 2),
            ("the floor turns", FLOOR, entry(2, 0), 2),
            ("the lamp moves", "light.vertex_positions", moved_light, 2),
            ("the camera moves", "sensor.to_world", entry(0, 3), 2),
            ("z", NAME, entry(2, 3), 3),
            ("radius", NAME, radius, 3),
            ("the floor moves", FLOOR, entry(2, 3), 3),
        )
    ),
    *(
        Case(f"crossed, {light}", name, tangent, 0.005, what, depth, 1024, 4096)
        for light, depth in (("lamp", 2), ("lamp", 3), ("sky", 2), ("point", 2))
        for what, name, tangent in (
            ("radius", NAME, radius),
            ("the other ball moves", "other.to_world", entry(0, 3)),
            ("the plate moves", "plate.to_world", entry(2, 3)),
            ("the pipe moves", "pipe.to_world", entry(2, 3)),
        )
    ),
    Case("sunk, wall", NAME, radius, 0.005, "radius", 4, 1024, 4096),
    Case("sunk, wall", "wall.to_world", entry(0, 3), 0.005, "the wall moves", 4, 1024, 4096),
]


@pytest.mark.slow_rows("sunk sphere, lamp, z, depth 2-forward")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sunk, wall", "sunk cylinder, lamp"])
def test_reverse_mode_is_the_transpose(name: str) -> None:
    scene, params = load(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [NAME, FLOOR, *(["wall.to_world"] if "wall" in name else [])], options)


@pytest.mark.parametrize(
    ("change", "hide", "problem"),
    [
        (
            {"shape": {"to_world": T.translate([0.1, 0.0, 3e-5]).scale(0.4)}},
            False,
            "'floor' touches 'shape'",
        ),
        ({"floor": {"emitter": {"type": "area", "radiance": 1.0}}}, True, "'floor', a light that hide_emitters hides"),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, hide: bool, problem: str) -> None:
    whole = {"type": "scene", **sunk("cylinder", "lamp")()}
    for name, more in change.items():
        whole[name] |= more
    integrator = psdr.PathIntegrator(max_depth=2, hide_emitters=hide)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(psdr.load_dict(whole), names=[NAME], integrator=integrator)


def test_chords_have_the_length_of_the_curve() -> None:
    """Of a ball and a cylinder aslant, cut by a plane of two vast triangles, and of a disk."""
    size = 1.0e3
    corners = np.array([[-size, -size, 0.0], [size, -size, 0.0], [size, size, 0.0], [-size, size, 0.0]])[
        [[0, 1, 2], [0, 2, 3]]
    ]
    turn = T.rotate([0, 1, 0], 40.0).matrix[:3, :3]
    lengths = {}
    for kind, offset in (("sphere", 0.3), ("cylinder", -1.0), ("disk", -0.2)):
        linear = turn @ np.diag([1.0, 1.0, 3.0]) if kind == "cylinder" else turn
        chords = cut(Field(*EXACT_FIELDS[kind], linear, np.array([0.1, 0.2, offset])), corners, np.arange(2))
        steps = np.linalg.norm(np.diff(chords.points, axis=1)[:, 0], axis=1)
        lengths[kind] = float((steps * np.diff(chords.spans, axis=1)[:, 0]).sum())
    # The plane cuts the cylinder in a whole ellipse: its half axes are 1 and 1 / cos 40.
    t = (np.arange(4096) + 0.5) * 2.0 * np.pi / 4096.0
    ellipse = np.hypot(np.sin(t) / np.cos(np.radians(40.0)), np.cos(t)).mean() * 2.0 * np.pi
    expected = [
        2.0 * np.pi * np.sqrt(1.0 - 0.3**2),
        ellipse,
        2.0 * np.sqrt(1.0 - (0.2 / np.sin(np.radians(40.0))) ** 2),
    ]
    np.testing.assert_allclose(list(lengths.values()), expected, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_is_the_fine_tessellations(kind: str) -> None:
    """By every number of the pose of what is sunk into a floor, and of the floor's."""
    found = {}
    for form in ({"exact": True}, {"exact": False, "resolution": 160}):
        whole = sunk(kind, "lamp")()
        whole["shape"] |= form
        scene = psdr.load_dict({"type": "scene", **whole})
        params = psdr.traverse(scene)
        params.requires_grad_only(NAME, FLOOR)
        batches = []
        for seed in range(8):
            params.zero_grad()
            options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 512, "seed": seed}
            psdr.render_backward(scene, params, np.ones((16, 16, 3)), **options)
            batches.append(np.concatenate([params[n].grad.numpy().ravel() for n in (NAME, FLOOR)]))
        found[len(found)] = np.array(batches, np.float64)
    a, b = found[0], found[1]
    gap, error = a.mean(axis=0) - b.mean(axis=0), np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 8.0)
    scale = np.abs(b.mean(axis=0)).max()
    assert (np.abs(gap) < 5.0 * error + 0.01 * scale).all(), gap / scale
    assert (error < 0.02 * scale).all()
