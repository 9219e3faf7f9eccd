"""Derivatives of cylinders that disks close, and of those that stand on a floor: rims that are no open edges."""

import warnings

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.estimate.arguments import flat_tangents
from warp_psdr.topology import contacts
from warp_psdr.topology.kinds.joined_rims import joined_rims

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import SCENES, T, camera, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, entry, moved_light

VIEW = camera((0.3, -2.6, 1.9), (0.0, 0.0, 0.35), fov=40.0)
TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.3), "other": diffuse(0.3, 0.6, 0.5)}
CAP = {"type": "twosided", "bsdf": diffuse(0.2, 0.6, 0.8), "other": diffuse(0.8, 0.7, 0.2)}
#: An ellipse across; the axis leans to the viewer, or is upright.
ALOFT = T.translate([0.1, 0.0, 0.45]).rotate([1, -1, 0], 25.0)
UPRIGHT = T.translate([0.1, 0.0, 0.0]).rotate([0, 0, 1], 30.0)
HOVERING = T.translate([0.1, 0.0, 0.45]).rotate([0, 0, 1], 30.0)
SIZE = (0.4, 0.3, 0.6)


def closed(pose, light: str, ends: tuple[int, ...] = (1,), ground: dict | None = None):
    """A cylinder, with disks at some of its ends."""
    shapes = {"shape": {"type": "cylinder", "to_world": pose @ T.scale(list(SIZE)), "bsdf": TWO_SIDED}}
    for e in ends:
        at = T.translate([0.0, 0.0, e * SIZE[2]]) @ T.scale([SIZE[0], SIZE[1], 1.0])
        shapes[f"cap{e}"] = {"type": "disk", "to_world": pose @ at, "bsdf": CAP}
    whole = {name: {"exact": True, **shape} for name, shape in shapes.items()}
    return lambda: {"sensor": VIEW, "floor": ground or floor(half=2.0), **whole, **LIGHTS[light]()}


def under_the_sun(pose, ends: tuple[int, ...]):
    """The sun stands in the plane of the wall."""
    sun = {"light": {"type": "directional", "direction": [0.0, 0.0, -1.0], "irradiance": 2.0}}
    return lambda: {**closed(pose, "sun", ends)(), **sun}


PLATE = {"type": "disk", "exact": True, "to_world": T.scale(2.0), "bsdf": diffuse(0.7, 0.6, 0.5)}
register(
    {
        **{f"lid, {light}": closed(ALOFT, light) for light in LIGHTS},
        **{f"cup, {light}": closed(ALOFT, light, (0,)) for light in LIGHTS},
        **{f"tin, {light}": closed(ALOFT, light, (0, 1)) for light in LIGHTS},
        **{f"standing, {light}": closed(UPRIGHT, light, ()) for light in LIGHTS},
        **{f"standing lid, {light}": closed(UPRIGHT, light) for light in LIGHTS},
        **{f"standing tin, {light}": closed(UPRIGHT, light, (0, 1)) for light in LIGHTS},
        **{f"on a plate, {light}": closed(UPRIGHT, light, (), PLATE) for light in LIGHTS},
        "hovering, overhead": under_the_sun(HOVERING, (0, 1)),
        "standing lid, overhead": under_the_sun(UPRIGHT, (1,)),
    }
)


def field(pose, linear):
    """A motion of all of space, x' = L (x - c) in the axes of a pose, c its origin: what joins stays together."""
    m = pose.matrix[:3, :3]
    g = np.zeros((4, 4))
    g[:3, :3] = m @ np.array(linear, np.float64) @ m.T
    g[:3, 3] = -g[:3, :3] @ pose.matrix[:3, 3]
    return lambda v: g @ v


def shift(x, y, z):
    g = np.zeros((4, 4))
    g[:3, 3] = x, y, z
    return lambda v: g @ v


def motions(pose):
    return {
        "radius": field(pose, np.diag([1.0, 1.0, 0.0])),
        "height": field(pose, np.diag([0.0, 0.0, 1.0])),
        "x": shift(1.0, 0.0, 0.0),
        "z": shift(0.0, 0.0, 1.0),
        "rotation": field(pose, [[0, -1, 0.5], [1, 0, 0], [-0.5, 0, 0]]),
        "turn": field(pose, [[0, -1, 0], [1, 0, 0], [0, 0, 0]]),
        "lean": field(pose, [[0, 0, 1], [0, 0, 0], [0, 0, 0]]),
    }


SHAPE, LID, BOTTOM, FLOOR = (f"{name}.to_world" for name in ("shape", "cap1", "cap0", "floor"))
NAMES = {"lid": (SHAPE, LID), "cup": (SHAPE, BOTTOM), "tin": (SHAPE, BOTTOM, LID), "standing": (SHAPE,)}
NAMES |= {"standing lid": (SHAPE, LID), "on a plate": (SHAPE,), "standing tin": (SHAPE, BOTTOM, LID)}
NAMES |= {"hovering": NAMES["tin"]}
POSES = {"lid": ALOFT, "cup": ALOFT, "tin": ALOFT, "hovering": HOVERING}
ON_FLOOR = ("standing", "standing lid", "on a plate", "standing tin")
FAST = {("lid", "lamp", "radius")}


def case(kind: str, light: str, what: str, depth: int = 2, names=None, tangent=None) -> Case:
    names = names or NAMES[kind]
    tangent = tangent or motions(POSES.get(kind, UPRIGHT))[what]
    fast = (kind, light, what) in FAST and depth == 2
    against = kind in ON_FLOOR and what in ("radius", "x", "lean", "the floor slides")  # rare large samples
    spp, difference_spp = (192, 2560) if fast else (4096, 16384) if against else (2048, 8192)
    return Case(f"{kind}, {light}", names, tangent, 0.005, what, depth, spp, difference_spp, slow=not fast)


ALONG = ("radius", "height", "x", "turn", "lean")
CASES = [
    *(
        case(kind, light, what)
        for kind in ("lid", "cup", "tin")
        for light in ("sky", "lamp")
        for what in ("radius", "height", "x", "z", "rotation")
    ),
    *(case(kind, light, "radius") for kind in ("lid", "cup", "tin") for light in ("point", "sun", "spot")),
    *(case(kind, "lamp", "radius", 3) for kind in ("lid", "cup", "tin")),
    *(case(kind, light, what) for kind in ON_FLOOR for light in ("sky", "lamp") for what in ALONG),
    *(case(kind, light, "x") for kind in ("standing", "standing lid") for light in ("point", "sun")),
    *(case(kind, "lamp", "radius", 3) for kind in ("standing", "standing lid")),
    *(case(kind, "overhead", what) for kind in ("hovering", "standing lid") for what in ("radius", "x")),
    *(
        case(kind, "lamp", what, 2, name, tangent)
        for kind in ("tin", "standing lid")
        for what, name, tangent in (
            ("the lamp moves", "light.vertex_positions", moved_light),
            ("the camera moves", "sensor.to_world", entry(0, 3)),
            ("the floor slides", FLOOR, entry(0, 3)),
        )
    ),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cup", "standing tin"])
def test_reverse_mode_is_the_transpose(kind: str) -> None:
    scene, params = load(f"{kind}, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # random motions part what joins
        assert_transposes(scene, params, [*NAMES[kind], FLOOR], options)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.9, 0.0])
def test_area_on_the_film(angle: float) -> None:
    """Orthographic: of a closed cylinder, 2 r L |sin(psi)| + pi r^2 cos(psi), by radius, length and angle.

    Along its axis the end in front counts, whose area has a maximum there.
    """
    radius, length = 0.4, 0.7
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    black = {"exact": True, "bsdf": diffuse(0.0)}
    pose = T.rotate([1, 0, 0], np.degrees(angle) - 90.0)  # the axis is (0, cos(angle), sin(angle)), rays along y
    shapes = {"tube": {"type": "cylinder", "to_world": pose @ T.scale([radius, radius, length])}}
    for e in (0, 1):
        at = pose @ T.translate([0.0, 0.0, e * length]) @ T.scale([radius, radius, 1.0])
        shapes[f"cap{e}"] = {"type": "disk", "to_world": at}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "orthographic",
                "to_world": T.look_at([0, -5, 0], [0, 0, 0], [0, 0, 1]).scale([2.0, 2.0, 1.0]),
                "film": film,
            },
            "sky": {"type": "constant", "radiance": 1.0},
            **{name: {**shape, **black} for name, shape in shapes.items()},
        }
    )
    params = psdr.traverse(scene)
    names = [f"{name}.to_world" for name in shapes]
    turn = np.zeros((4, 4))
    turn[1, 2], turn[2, 1] = -1.0, 1.0
    fields = [field(pose, np.diag([1.0, 1.0, 0.0])), field(pose, np.diag([0.0, 0.0, 1.0])), lambda v: turn @ v]
    params.requires_grad(*names)
    found = []
    for seed in range(8):
        params.zero_grad()
        options = {"spp": 1024, "seed": seed, "integrator": psdr.PathIntegrator(max_depth=1)}
        psdr.render_backward(scene, params, np.full((16, 16, 3), -((4.0 / 16.0) ** 2) / 3.0, np.float32), **options)
        g = {n: params[n].grad.numpy().reshape(4, 4).astype(np.float64) for n in names}
        held = {n: params[n].numpy().reshape(4, 4).astype(np.float64) for n in names}
        found.append([sum((g[n] * f(held[n])).sum() for n in names) for f in fields])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    s, c = np.sin(angle), np.cos(angle)
    side, end = 2.0 * radius * length * s, np.pi * radius**2 * c
    expected = [side + 2.0 * end, side, 2.0 * radius * length * c * np.sign(s) - np.pi * radius**2 * s]
    assert (error < 4e-3).all()
    # Absorbs the distance at which rays pass a rim, and float32.
    assert (np.abs(mean - expected) < 4.0 * error + 5e-5).all(), (mean, error, expected)


def test_rims_that_join_are_found() -> None:
    def joined(kind: str):
        scene, _params = load(f"{kind}, lamp")
        name = [s.path for s in scene.description.shapes]
        found = joined_rims(scene)
        caps = {(name[d], name[c], e) for d, c, e in found.caps}
        stands = {(name[c], e, name[m]) for c, e, m in found.stands}
        return caps, stands, {(name[d], name[m]) for d, m in found.buried}

    low, high, ground = ("cap0", "shape", 0), ("cap1", "shape", 1), ("shape", 0, "floor")
    assert joined("lid") == ({high}, set(), set())
    assert joined("cup") == ({low}, set(), set())
    assert joined("tin") == ({low, high}, set(), set())
    assert joined("standing") == joined("on a plate") == (set(), {ground}, set())
    assert joined("standing lid") == ({high}, {ground}, set())
    assert joined("standing tin") == ({low, high}, {ground}, {("cap0", "floor")})
    scene, params = load("standing tin, lamp")
    held = params[LID].numpy().copy()
    try:
        moved = held.copy()
        moved[2, 3] += 1.0e-3
        params[LID] = moved
        params.update()
        assert len(joined_rims(scene).caps) == 1, "a gap"
    finally:
        params[LID] = held
        params.update()


BALL = {"type": "sphere", "exact": True, "bsdf": {"type": "conductor"}, "radius": 0.1, "center": [1.0, 0.0, 0.5]}
DISK = {"type": "disk", "exact": True, "to_world": UPRIGHT @ T.scale([SIZE[0], SIZE[1], 1.0])}
APART = 3.0e-5


@pytest.mark.parametrize(
    ("kind", "change", "problem"),
    [
        (
            "lid",
            {"cap1": {"to_world": ALOFT @ T.translate([0, 0, SIZE[2] + APART]) @ T.scale([SIZE[0], SIZE[1], 1.0])}},
            "'cap1' touches 'shape'",
        ),
        ("standing", {"shape": {"to_world": UPRIGHT @ T.translate([0, 0, APART]) @ T.scale(list(SIZE))}}, "touches"),
        ("standing", {"floor": {"to_world": T.translate([2.1, 0, 0]) @ T.scale(2.0)}}, "'floor' touches 'shape'"),
        ("standing", {"cap": DISK}, "'cap' lies in the surface .*; leave it out"),
        ("lid", {"ball": BALL}, "'cap1' and 'shape' join at a rim, which is not followed through smooth mirrors"),
    ],
)
def test_what_has_no_terms_is_refused(kind: str, change: dict, problem: str) -> None:
    whole = {"type": "scene", **SCENES[f"{kind}, lamp"]()}
    for name, more in change.items():
        whole[name] = {**whole.get(name, {}), **more}
    with pytest.raises(ValueError, match=problem):
        psdr.plan(psdr.load_dict(whole), names=[SHAPE], integrator=psdr.PathIntegrator(max_depth=2))


@pytest.mark.parametrize(
    ("kind", "tangents", "problem"),
    [
        ("lid", {SHAPE: motions(ALOFT)["radius"]}, "'shape' and 'cap1' join at a rim, .* neither of them"),
        ("standing lid", {n: motions(UPRIGHT)["z"] for n in (SHAPE, LID)}, "'shape' and 'floor' .* that of sinking in"),
        ("standing lid", {n: motions(UPRIGHT)["z"] for n in (SHAPE, LID, FLOOR)}, ""),
        ("lid", {SHAPE: motions(ALOFT)["turn"]}, "'shape' and 'cap1'"),
    ],
)
def test_motions_that_part_what_joins_are_told(kind: str, tangents: dict, problem: str) -> None:
    scene, params = load(f"{kind}, lamp")
    given = {n: np.float32(f(params[n].numpy().astype(np.float64))) for n, f in tangents.items()}
    target = flat_tangents(scene, params, given).numpy()
    if problem:
        with pytest.warns(RuntimeWarning, match=problem):
            contacts.warn(scene, target)
    else:
        contacts.warn(scene, target)
