"""Film points among shapes that hide each other: silhouettes, shadows, contacts and skies, before each pixel filter."""

import functools

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from tests.gradients.measure import NO_ROULETTE, shared_random_numbers
from tests.gradients.scenes import rgb
from warp_psdr.estimate.boundary.terms import Request
from warp_psdr.estimate.guiding import store
from warp_psdr.plan.motion import motion

SIZE = 16
#: Difference of two means over their standard error that independent batches exceed once in 16,000 tries.
Z = 4.0
#: The difference quotient's own error.
SLOPE = 0.02
#: What moves.
KINDS = ("camera", "box", "flying", "floor")
#: Sums in another order.
ROUNDING = 1e-4
FILM, REPLAY = psdr.interior.FilmAntithetic(), psdr.interior.Replay()
#: Corners at the ends of x, y and z of a box, whose numbers have the bits of 4, 2 and 1.
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def box(center, half, bsdf):
    """A box, turned about the vertical, with its front outside."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    c, s = np.cos(0.5), np.sin(0.5)
    corners = (corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + center).astype(np.float32)
    faces = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))], np.int32)
    at = corners[faces]
    inwards = (np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]) * (at.mean(axis=1) - center)).sum(axis=1) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return {"type": "mesh", "vertices": corners, "faces": faces, "face_normals": True, "bsdf": bsdf}


DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.2, 0.6, 0.4)}


def resting():
    """A box that stands on the floor, and one that flies before both."""
    return {
        "box": box([0.1, -0.1, 0.3], [0.3, 0.4, 0.3], DIFFUSE),
        "flying": box([-0.5, -0.6, 0.9], [0.25, 0.2, 0.1], {"type": "roughconductor", "alpha": 0.4}),
    }


def crossing():
    """A box that is sunk into the floor, and one that runs through it, both leaning."""
    lower = box([0.1, -0.1, 0.2], [0.3, 0.4, 0.3], DIFFUSE)
    upper = box([-0.15, -0.45, 0.45], [0.3, 0.25, 0.15], DIFFUSE)
    for shape, a, b in ((lower, 0.07, 0.11), (upper, 0.2, 0.13)):
        shape["vertices"] = shape["vertices"] @ np.array([[1, 0, a], [0, 1, b], [-a, -b, 1]], np.float32)
    return {"box": lower, "flying": upper}


def smooth():
    """A coarse ball with interpolated normals above the floor."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    corners = (0.45 * np.asarray(ball.vertices) + [0.0, -0.2, 0.6]).astype(np.float32)
    return {"box": {"type": "mesh", "vertices": corners, "faces": np.asarray(ball.faces, np.int32), "bsdf": DIFFUSE}}


@functools.cache
def load(rfilter, shapes=resting):
    """Shapes on and above a floor, a lamp and, but over the ball, a sky."""
    sky = {} if shapes is smooth else {"sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)}}
    pose = psdr.Transform.look_at([-0.4, -4.0, 2.0], [0.1, 0.0, 0.3], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}}
    film["sample_border"] = rfilter != "box"
    above = psdr.Transform.look_at([1.0, -0.5, 2.5], [0, 0, 0], [0, 1, 0]) @ psdr.Transform.scale(0.5)
    floor = psdr.Transform.scale([1.6, 1.4, 1.0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 45.0, "to_world": pose, "film": film},
            "floor": {
                "type": "rectangle",
                "to_world": floor,
                "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)},
            },
            **shapes(),
            "lamp": {
                "type": "rectangle",
                "to_world": above,
                "emitter": {"type": "area", "radiance": rgb(6, 5, 4)},
            },
            **sky,
        }
    )
    return scene, psdr.traverse(scene)


def moved(params, kind):
    """A parameter and a direction in which it moves."""
    if kind == "camera":
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 3] = (0.6, 0.3, 0.5)
        return "sensor.to_world", tangent
    if kind == "approach":
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 3] = params["sensor.to_world"].numpy()[:3, 2]
        return "sensor.to_world", tangent
    if kind == "floor":
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 3] = (0.6, 0.3, 0.0)
        tangent[:3, :2] = 0.2 * params["floor.to_world"].numpy()[:3, :2]
        return "floor.to_world", tangent
    grows = kind.endswith(" grows")
    name = f"{kind.removesuffix(' grows')}.vertex_positions"
    points = params[name].numpy()
    if grows:
        return name, points - points.mean(axis=0)
    turn = [0.0, 0.0, 0.8] if kind == "box" else [0.2, 0.1, 0.8]
    speed = [0.5, 0.3, 0.0] if kind == "box" else [0.5, 0.3, 0.3]
    return name, (np.cross(turn, points - points.mean(axis=0)) + speed).astype(np.float32)


def adjoint():
    across = np.linspace(-1.0, 1.0, SIZE)[None, :, None]
    return (np.random.default_rng(3).uniform(0.5, 1.5, size=(SIZE, SIZE, 3)) + across).astype(np.float32)


def integrator(method, boundary="auto"):
    return psdr.PathIntegrator(max_depth=3, rr_depth=NO_ROULETTE, interior=method, boundary=boundary)


def backward(rfilter, kind, method, seeds, spp, shapes=resting, boundary="auto"):
    """Mean and standard error of derivatives by reverse mode."""
    scene, params = load(rfilter, shapes)
    name, tangent = moved(params, kind)
    params.requires_grad_only(name)
    found = []
    for seed in seeds:
        params.zero_grad()
        options = {"integrator": integrator(method, boundary), "spp": spp, "seed": seed}
        psdr.render_backward(scene, params, adjoint(), **options)
        found.append((params[name].grad.numpy().astype(np.float64) * tangent).sum())
    assert not any(psdr.invalid_samples(scene).values())
    return np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rfilter", ["tent", "box"])
def test_mean_is_that_of_replay(rfilter, kind):
    film, film_error = backward(rfilter, kind, FILM, range(64), 256)
    replay, replay_error = backward(rfilter, kind, REPLAY, range(64), 256)
    assert abs(replay) > 10.0 * replay_error
    assert abs(film - replay) < Z * np.hypot(film_error, replay_error)


@functools.cache
def by_replay(shapes, kind):
    return backward("box", kind, REPLAY, range(64), 384, shapes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shapes", "kind", "guiding"),
    [
        (smooth, "box grows", None),
        (smooth, "approach", None),
        (crossing, "flying grows", None),
        (crossing, "approach", None),
        (resting, "flying grows", psdr.guiding.KdTree(max_leaves=512)),
        (resting, "flying grows", psdr.guiding.Octree(max_leaves=512)),
        (resting, "flying grows", psdr.guiding.Grid(shape=(64, 4, 4), photons=2000, importons=2000)),
    ],
    ids=["normals", "normals, camera", "curves", "curves, camera", "k-d tree", "octree", "grid"],
)
def test_mean_is_that_of_replay_beside_other_terms(shapes, kind, guiding):
    film, film_error = backward("box", kind, FILM, range(64), 384, shapes, psdr.boundary.PathSpace(guiding=guiding))
    replay, replay_error = by_replay(shapes, kind)
    error = np.hypot(film_error, replay_error)
    assert abs(replay) > 40.0 * error
    assert abs(film - replay) < Z * error


def test_structures_of_film_points_and_of_replay_are_kept_apart():
    guiding = psdr.guiding.KdTree()
    scene, params = load("box")
    name, _tangent = moved(params, "flying")
    keys = set()
    for method in (REPLAY, FILM):
        options = psdr.PathIntegrator(max_depth=3, interior=method, boundary=psdr.boundary.PathSpace(guiding=guiding))
        plan = psdr.plan(scene, names=[name], integrator=options)
        request = Request(scene, plan, motion(scene, [name]), "reverse", 0, 16, 1)
        keys.add(store.key_of(request, guiding, store.EDGES))
    assert len(keys) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("rfilter", "kind"), [("tent", "floor"), ("box", "flying")])
def test_slope_of_finite_differences(rfilter, kind):
    scene, params = load(rfilter)
    name, tangent = moved(params, kind)
    found, error = backward(rfilter, kind, FILM, range(160), 512)
    value = params[name].numpy().copy()

    def loss(change, seed):
        params[name] = (value + change * tangent).astype(np.float32)
        params.update()
        image = psdr.render(scene, integrator=integrator(REPLAY), spp=4096, seed=seed)
        return (image.numpy().astype(np.float64) * adjoint()).sum()

    step = 0.02
    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(48)])
    finally:
        params[name] = value
        params.update()
    noise = np.hypot(slopes.std(ddof=1) / np.sqrt(len(slopes)), error) / abs(slopes.mean())
    assert noise < SLOPE
    assert abs(found / slopes.mean() - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
@pytest.mark.parametrize(("rfilter", "kind"), [("box", "camera"), ("tent", "flying")])
def test_forward_mode_sums_to_reverse_mode(rfilter, kind):
    scene, params = load(rfilter)
    name, tangent = moved(params, kind)
    reverse, _error = backward(rfilter, kind, FILM, [11, 11], 16)
    options = {"integrator": integrator(FILM), "spp": 16, "seed": 11}
    image = psdr.render_forward(scene, params, {name: tangent}, **options).numpy().astype(np.float64) * adjoint()
    assert abs(reverse) > 0.1
    assert abs(image.sum() - reverse) <= ROUNDING * np.abs(image).sum()
