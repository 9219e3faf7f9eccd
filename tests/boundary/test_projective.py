"""boundary.Projective: its seeds lie on silhouettes, its guiding finds more of them, and its derivatives are right."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr import guiding
from warp_psdr.boundary import PathSpace, Projective
from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms import Request, named
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.guiding.structure import Evaluator
from warp_psdr.kernels.boundary.guiding.path_segments import BLOCKED_LIGHT, SCATTERED
from warp_psdr.plan.motion import motion
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.neighbours import neighbour_tables, neighbours
from warp_psdr.topology.secondary_edges import secondary_edges

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import SCENES, T, ball, diffuse, load, panel, under
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, RECEIVER, moved

#: Small structures: built in tenths of a second.
SMALL = guiding.Octree(max_leaves=2048, samples=8)
TREE = guiding.KdTree(max_leaves=2048, samples=8)


def request(scene, name, method, depth=2, role="forward"):
    plan = psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=depth, boundary=method))
    return Request(scene, plan, motion(scene, [name]), role, 0, 16, 1)


def load_scene(**objects):
    return psdr.load_dict({"type": "scene", **objects})


def fine(subdivisions, split=False):
    occluder = ball((0.1, 0.1, 0.9), 0.4, diffuse(0.5), subdivisions=subdivisions)
    if split:
        faces = occluder["faces"]
        occluder["vertices"], occluder["faces"] = (
            occluder["vertices"][faces.reshape(-1)],
            np.arange(faces.size, dtype=np.int32).reshape(-1, 3),
        )
    return load_scene(**(under(panel((0.5, -0.3, 2.2), 0.35)) | {"occluder": occluder}))


@pytest.mark.parametrize("split", [False, True])
def test_neighbours_are_mutual_and_share_the_side(split) -> None:
    scene = fine(1, split)
    edges = secondary_edges(scene, {1})
    faces, numbers = neighbour_tables(scene, edges.ends.numpy())
    corners = scene.values.numpy()[scene.positions :][: 3 * scene.vertex_count].reshape(-1, 3)[scene.builder.indices]
    ends = scene.values.numpy()[scene.positions :][: 3 * scene.vertex_count].reshape(-1, 3)[edges.ends.numpy()]
    closed = scene.builder.face_shape == 1
    assert (faces[closed] >= 0).all() and (numbers[closed] >= 0).all()
    assert (np.sum(faces[~closed] >= 0, axis=1) == 1).all()  # two triangles each, a flat diagonal between them
    assert (np.sum(numbers[~closed] < 0, axis=1) == 1).all()
    for face, side in np.argwhere(faces >= 0):
        assert face in faces[faces[face, side]]
    for face, side in np.argwhere(numbers >= 0):
        found = {tuple(p) for p in corners[face, [side, (side + 1) % 3]]}
        assert found == {tuple(p) for p in ends[numbers[face, side]]}


def traced(scene, name, kind, paths, depth=2):
    """Return (edges, weight, wedge seeds, light seeds)."""
    r = request(scene, name, Projective(), depth)
    edges = secondary_edges(scene, set(r.moves.shapes))
    return (edges, *projective._trace(r, edges, neighbours(scene, edges), kind, paths))


@pytest.mark.slow_rows("1-0", "1-1", "5-0")
@pytest.mark.parametrize(("subdivisions", "kind"), [(1, BLOCKED_LIGHT), (1, SCATTERED), (5, BLOCKED_LIGHT)])
def test_rays_that_the_occluder_stops_are_projected(subdivisions, kind) -> None:
    """On 20,480 triangles a walk of 30 steps does not reach the silhouette: jumps do."""
    scene = fine(subdivisions)
    edges, weight, wedge, light = traced(scene, OCCLUDER, kind, 4096, depth=3)
    tried = weight > 0.0
    assert tried.sum() > 100
    assert (light[~tried] < 0.0).all() and (wedge[~tried] < 0.0).all()
    if kind == SCATTERED:
        assert (light < 0.0).all()
    # Coordinates of the wedge's cube exist in directions in which the edge is a silhouette only.
    found = (wedge >= 0.0).all(axis=1) & (wedge < 1.0).all(axis=1)
    assert found.sum() > 0.9 * tried.sum()
    edge = np.searchsorted(edges.cdf.numpy().astype(float), wedge[found, 0], side="right") - 1
    shapes = scene.builder.face_shape[edges.faces.numpy()[edges.first.numpy()[edge]]]
    assert (shapes == 1).sum() > 50


@pytest.mark.slow_rows("point-light")
@pytest.mark.parametrize(
    ("name", "technique"),
    [
        ("soft", "wedge"),
        ("soft", "light"),
        ("point", "light"),
        pytest.param("sun", "light", marks=pytest.mark.slow),
        pytest.param("envmap", "light", marks=pytest.mark.slow),
    ],
)
def test_seeds_carry_light(name, technique) -> None:
    """At points of the cube near which light is blocked the integrand is hardly ever zero, at random ones often."""
    scene, _params = load(name)
    r = request(scene, OCCLUDER, Projective(guiding=SMALL, paths=8192))
    guiding.reset(scene)
    _edges, _guide = store.guide(r, r.method.guiding, projective.asker(r))
    (built,) = guiding.structures(scene)
    seeds = projective.seeds(r, built.edges, 8192)[technique]
    assert len(seeds) > 100
    evaluate = Evaluator(r, built, store.edge_space(r, built), technique).at
    random = np.random.default_rng(2).random((8192, 3))
    assert (evaluate(seeds) > 0.0).mean() > max(0.4, 3.0 * (evaluate(random) > 0.0).mean())


def drawn(scene, r, built, technique, count):
    """Return (share of non-zero values among samples of the leaves, the same among uniform ones)."""
    leaves = built.leaves[technique]
    random = np.random.default_rng(3)
    which = random.choice(len(leaves.low), count, p=leaves.mass / leaves.mass.sum())
    low, high = leaves.low[which].astype(float), leaves.high[which].astype(float)
    evaluate = Evaluator(r, built, store.edge_space(r, built), technique).at
    guided = evaluate(low + random.random((count, 3)) * (high - low))
    return (guided > 0.0).mean(), (evaluate(random.random((count, 3))) > 0.0).mean()


@pytest.mark.parametrize("tree", [SMALL, TREE], ids=["octree", "kd-tree"])
@pytest.mark.parametrize(
    ("name", "parameter", "depth", "technique", "factor"),
    [
        ("soft", OCCLUDER, 2, "light", 3.0),
        pytest.param("floating", BOX, 3, "wedge", 2.0, marks=pytest.mark.slow),
    ],
)
def test_guided_samples_find_silhouettes(name, parameter, depth, technique, factor, tree) -> None:
    scene, _params = load(name)
    r = request(scene, parameter, Projective(guiding=tree), depth)
    guiding.reset(scene)
    store.guide(r, tree, projective.asker(r))
    (built,) = guiding.structures(scene)
    guided, uniform = drawn(scene, r, built, technique, 8192)
    assert uniform > 0.0 and guided > factor * uniform


def test_without_seeds_it_is_uniform() -> None:
    """Nothing blocks any light: no seed, no mass, and the structure is the uniform cube."""
    objects = under(panel((0.5, -0.3, 2.2), 0.35))
    objects["occluder"] = ball((0.0, 0.0, 30.0), 0.4, diffuse(0.5))  # behind the light
    scene = load_scene(**objects)
    r = request(scene, OCCLUDER, Projective(guiding=SMALL, paths=512))
    edges, guide = store.guide(r, SMALL, projective.asker(r))
    (built,) = guiding.structures(scene)
    seeds = projective.seeds(r, edges, 512)
    assert len(seeds["light"]) == len(seeds["wedge"]) == 0
    assert not built.leaves["light"].mass.any()
    density = np.diff(guide.light.cdf.numpy()) / np.prod(guide.light.high.numpy() - guide.light.low.numpy(), axis=1)
    np.testing.assert_allclose(density, 1.0, atol=1e-3)  # absorbs the multiples of 2^-24
    image = psdr.render_forward(
        scene,
        psdr.traverse(scene),
        {OCCLUDER: 1.0},
        integrator=psdr.PathIntegrator(max_depth=2, boundary=r.method),
        spp=4,
    ).numpy()
    assert not image.any()


CASES = [
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048, slow=False),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=1024, difference_spp=4096),
    Case("point", OCCLUDER, ALONG, 0.01, "occluder moves"),
    Case("sun", FLOOR, moved(0.2, 0.1, 1.0), 0.01, RECEIVER, difference_spp=2048),
    Case("envmap", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=8192),
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    guiding.reset(load(case.scene)[0])
    assert_agrees(derivatives(case, mode, Projective(guiding=SMALL, paths=8192)), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("method", [Projective(), Projective(guiding=TREE), Projective(guiding=None)])
def test_the_structure_does_not_change_the_mean(method) -> None:
    case = CASES[0]
    other = derivatives(case, "forward", PathSpace())
    found = derivatives(replace(case, spp=1024), "forward", method)
    error = np.sqrt((other.var(ddof=1) + found.var(ddof=1)) / len(other))
    # A z-test: three standard errors.
    assert abs(found.mean() - other.mean()) < 3.0 * error
    assert error < 0.02 * abs(other.mean())


def test_uniform_sampling_aims_at_point_like_lights_only() -> None:
    for name, share in (("soft", 1.0), ("point", 0.5)):
        scene, _params = load(name)
        term = named("secondary").launch(request(scene, OCCLUDER, Projective(guiding=None)))
        record = next(x for x in term.inputs(0, wp.zeros((1, 1), dtype=wp.vec3)) if hasattr(x, "share"))
        assert record.share == share


def test_it_keeps_what_it_built_apart_from_others() -> None:
    scene, params = load("soft")
    guiding.reset(scene)
    for method in (PathSpace(guiding=SMALL), Projective(guiding=SMALL, paths=1024), Projective(guiding=SMALL)):
        for spp in (1, 2):
            integrator = psdr.PathIntegrator(max_depth=2, boundary=replace(method, spp_secondary=spp))
            psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=1)
    assert len(guiding.structures(scene)) == 3


def test_its_modes_are_transposes_and_the_plan_names_it() -> None:
    scene, params = load("soft")
    integrator = psdr.PathIntegrator(max_depth=2, boundary=Projective(guiding=SMALL, paths=1024))
    params.requires_grad_only(OCCLUDER)
    lines = {line[0]: line for line in psdr.plan(scene, params, integrator=integrator).lines}
    assert lines["boundary term"][1] == "boundary.Projective" and lines["guiding"][1] == "guiding.Octree"
    assert_transposes(scene, params, [OCCLUDER], {"integrator": integrator, "spp": 16, "seed": 3})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"guiding": "octree"}, "guiding"),
        ({"paths": 0}, "paths"),
        ({"paths": True}, "paths"),
        ({"paths": 1.5}, "paths"),
    ],
)
def test_wrong_options_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        Projective(**options)


def test_what_it_does_not_cover_names_it() -> None:
    cone = {"type": "spot", "to_world": T.translate([0, 0, 3]), "cutoff_angle": 20.0, "beam_width": 20.0}
    scene = psdr.load_dict({"type": "scene", **SCENES["soft"](), "light": cone})
    integrator = psdr.PathIntegrator(max_depth=2, boundary=Projective())
    with pytest.raises(ValueError, match=r"boundary\.Projective\(\) cannot"):
        psdr.plan(scene, names=[OCCLUDER], integrator=integrator)


def test_scenes_are_those_of_the_table() -> None:
    assert {c.scene for c in CASES} <= set(SCENES)
    assert neighbours(fine(0), secondary_edges(fine(0), {1})).faces.shape == (len(fine(0).builder.indices), 3)
    assert len(scene_adjacency(fine(0)).length) == 30 + 5 + 5
