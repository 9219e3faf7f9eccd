"""Surfaces that touch: motions along contacts are differentiated, of motions across them forward mode warns."""

import warnings

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr

from .measure import Case, assert_agrees, derivatives, differences, move
from .mirrors import wall
from .scenes import box, camera, diffuse, floor, load, mesh, panel, register, room
from .test_table import moved, turned

DIRECT = psdr.PathIntegrator(max_depth=2)
BOX, GROUND, LEFT, LIGHT = (f"{n}.vertex_positions" for n in ("box", "ground", "left", "light"))
UP, ASIDE, IN = moved(0.0, 0.0, 1.0), moved(1.0, -0.5, 0.0), moved(1.0, 0.0, 0.0)
QUAD = [[0, 1, 2], [0, 2, 3]]


def halves(gap=0.0):
    """Two squares side by side that only a mirror shows, under a light."""
    corners = np.array([[-0.5, -3.1, 0.2], [0.5, -3.1, 0.2], [0.5, -2.1, 0.2], [-0.5, -2.1, 0.2]])
    aside = np.array([0.5, 0.0, 0.0])
    return {
        "sensor": camera((0.3, -2.0, 1.0), (0.0, 1.2, 0.9)),
        "mirror": wall(1.0),
        "first": mesh(corners - (1.0 + gap) * aside, QUAD, diffuse(0.8, 0.3, 0.2)),
        "second": mesh(corners + aside, QUAD, diffuse(0.2, 0.4, 0.8)),
        "light": panel((0.2, -2.4, 2.0), 0.4),
    }


def standing(shape, **more):
    return {"sensor": camera(), "floor": floor(), "shape": shape, "light": panel((0.5, -0.3, 2.2), 0.35), **more}


def ball_on_floor(subdivisions):
    """A ball that stands on its lowest vertex."""
    m = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = 0.4 * np.asarray(m.vertices)
    vertices[:, 2] -= vertices[:, 2].min()
    return mesh(vertices, m.faces, diffuse(0.5))


def prism():
    """A roof upside down, on its edge."""
    vertices = [[-0.5, 0, 0], [0.5, 0, 0], [-0.5, 0.3, 0.4], [0.5, 0.3, 0.4], [-0.5, -0.3, 0.4], [0.5, -0.3, 0.4]]
    return mesh(vertices, [[0, 1, 3], [0, 3, 2], [0, 5, 1], [0, 4, 5]], diffuse(0.5))


SHAPE = "shape.vertex_positions"
register(
    {
        "halves": halves,
        "halves apart": lambda: halves(0.004),
        "room sunk": lambda: room(-0.01),
        "room above": lambda: room(0.01),
        "coarse ball on floor": lambda: standing(ball_on_floor(1)),
        "fine ball on floor": lambda: standing(ball_on_floor(4)),
        "prism on its edge": lambda: standing(prism()),
        "two boxes": lambda: standing(
            box((0.0, 0.0, 0.2), (0.3, 0.3, 0.2), diffuse(0.5)),
            top=box((0.0, 0.0, 0.6), (0.3, 0.2, 0.2), diffuse(0.6)),
        ),
        "split box": lambda: standing(box((0.0, 0.0, 0.6), (0.3, 0.3, 0.2), diffuse(0.5), 0.4, split=True)),
    }
)


def tip(values):
    """One vertex moves."""
    tangent = np.zeros_like(values)
    tangent[0] = 1.0
    return tangent


ACROSS = [
    ("room", {BOX: UP}, ("ground", "box")),
    ("room", {BOX: lambda v: -UP(v)}, ("ground", "box")),
    ("room", {BOX: turned(1)}, ("ground", "box")),
    ("room", {BOX: lambda v: ASIDE(v) + 0.01 * UP(v)}, ("ground", "box")),
    ("room", {GROUND: UP}, ("ground", "left")),
    ("room", {LEFT: IN}, ("ground", "left")),
    ("prism on its edge", {SHAPE: UP}, ("floor", "shape")),
    ("two boxes", {"top.vertex_positions": UP}, ("shape", "top")),
    # Two pairs of their edges lie on each other, which one slides past.
    ("two boxes", {"top.vertex_positions": IN}, ("shape", "top")),
    ("halves", {"first.vertex_positions": UP}, ("first", "second")),
    ("halves", {"first.vertex_positions": IN}, ("first", "second")),
]
ALONG = [
    ("room", {BOX: ASIDE}),
    ("room", {BOX: turned(2)}),
    ("room", {LIGHT: UP}),
    ("room", {f"{n}.vertex_positions": moved(0.3, 0.2, 1.0) for n in room() if n != "sensor"}),
    ("room above", {BOX: UP}),
    ("room sunk", {BOX: UP}),
    ("coarse ball on floor", {SHAPE: UP}),
    ("fine ball on floor", {SHAPE: UP}),
    ("two boxes", {"top.vertex_positions": UP, SHAPE: UP, "floor.to_world": UP}),
    ("two boxes", {"top.vertex_positions": moved(0.0, 1.0, 0.0)}),
    ("halves", {"first.vertex_positions": moved(0.0, 1.0, 0.0)}),
    ("halves apart", {"first.vertex_positions": UP}),
    ("split box", {SHAPE: UP}),
]


def rows(table):
    """Mark what is seen by two reflections: its kernels are its own."""
    return [pytest.param(*row, marks=[pytest.mark.slow] if row[0].startswith("halves") else []) for row in table]


def forward(name, directions):
    scene, params = load(name)
    depth = psdr.PathIntegrator(max_depth=3) if name.startswith("halves") else DIRECT
    tangents = {n: np.asarray(f(params[n].numpy()), np.float32) for n, f in directions.items()}
    return psdr.render_forward(scene, params, tangents, integrator=depth, spp=1).numpy()


@pytest.mark.slow_rows("prism on its edge-directions6-pair6")
@pytest.mark.parametrize(("name", "directions", "pair"), rows(ACROSS))
def test_motions_across_contacts_are_warned_of(name, directions, pair) -> None:
    with pytest.warns(RuntimeWarning, match="one-sided") as found:
        forward(name, directions)
    assert all(repr(shape) in str(found[0].message) for shape in pair)


@pytest.mark.slow_rows("coarse ball on floor-directions6", "room sunk-directions5", "fine ball on floor-directions7")
@pytest.mark.parametrize(("name", "directions"), rows(ALONG))
def test_motions_along_contacts_are_not(name, directions) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert np.isfinite(forward(name, directions)).all()


def test_tearing_a_mesh_apart_is_warned_of() -> None:
    with pytest.warns(RuntimeWarning, match="tears the mesh 'shape' apart"):
        forward("split box", {SHAPE: tip})


def test_the_interior_term_alone_takes_every_motion() -> None:
    scene, params = load("room")
    integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
    tangent = UP(params[BOX].numpy()).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        image = psdr.render_forward(scene, params, {BOX: tangent}, integrator=integrator, spp=1).numpy()
    assert np.isfinite(image).all()


@pytest.mark.slow
def test_reverse_mode_takes_touching_shapes_and_the_plan_says_what_holds() -> None:
    scene, params = load("room")
    params.requires_grad(BOX)
    params.zero_grad()
    psdr.render_backward(scene, params, np.ones((16, 16, 3)), integrator=DIRECT, spp=4)
    assert np.abs(params[BOX].grad.numpy()).max() > 0.0
    (line,) = (line for line in psdr.plan(scene, params, integrator=DIRECT).lines if line[0] == "contacts")
    assert "'ground' and 'box'" in line[2] and "one-sided" in line[2]
    params.requires_grad_only(LIGHT)
    assert "contacts" not in str(psdr.plan(scene, params, integrator=DIRECT))
    above, _params = load("room above")
    assert "contacts" not in str(psdr.plan(above, names=[BOX], integrator=DIRECT))


def test_contacts_follow_edits() -> None:
    _scene, params = load("room")
    base = params[BOX].numpy().copy()
    try:
        move(params, {BOX: base + 0.05 * UP(base)})
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            assert np.isfinite(forward("room", {BOX: UP})).all()
    finally:
        move(params, {BOX: base})
    with pytest.warns(RuntimeWarning, match="one-sided"):
        forward("room", {BOX: UP})


@pytest.mark.slow
def test_what_is_warned_of_has_two_derivatives() -> None:
    """The sum of the image as a wall of a room is moved in, over the floor's end, and out, which opens a gap."""
    scene, params = load("room")
    base, step, seeds = params[LEFT].numpy().copy(), 0.02, range(8)

    def sums(way):
        move(params, {LEFT: base + way * IN(base)})
        return np.array([
            psdr.render(scene, integrator=DIRECT, spp=256, seed=s).numpy().sum(dtype=np.float64) for s in seeds
        ])  # fmt: skip

    try:
        out, here, inside = (sums(h) for h in (-step, 0.0, step))
    finally:
        move(params, {LEFT: base})
    kink = (inside - 2.0 * here + out) / step
    slope = np.abs((inside - out) / (2.0 * step)).mean()
    assert abs(kink.mean()) > 0.2 * slope + 5.0 * kink.std(ddof=1) / np.sqrt(len(kink))


BOTH = ("first.vertex_positions", "second.vertex_positions")
CASES = [
    Case("halves", BOTH, moved(1.0, 0.3, 0.4), 0.01, "both move", 3, 1024, 4096),
    Case("halves", BOTH[0], moved(0.0, 1.0, 0.0), 0.02, "one slides along the seam", 3, 4096, 12288),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_seam_in_a_mirror(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])
