"""What moves beside exact shapes in and around media: closed forms, differences, and motions of all together."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media.scenes import FLOOR, NOTHING, T, camera, cube, lamp, medium, rgb, sky, square, whole
from tests.media.test_boundary import COLOURS, assert_mean, derivatives

SIZE, BATCHES = 16, 6
FOG = medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.3)
PAINT = {"type": "diffuse", "reflectance": rgb(0.3, 0.5, 0.7)}
STEP = 0.03


def ball(center, radius, bsdf=PAINT, **more):
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf, "exact": True, **more}


def fogged(**more):
    """A painted ball and a leaf in a cube of fog, between a lamp and a floor."""
    leaf = T.translate([0.1, -0.75, 0.5]) @ T.rotate([0, 1, 0], 25.0) @ T.scale(0.25)
    parts = {
        "sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE),
        "fog": cube(FOG, scale=1.1, turn=15.0),
        "ball": ball([0.1, 0.05, 0.2], 0.45),
        "leaf": {"type": "rectangle", "to_world": leaf, "bsdf": {"type": "twosided", "bsdf": PAINT}},
        "floor": square(-1.3, 1.6, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
        "lamp": lamp(2.2, 0.5),
    }
    return psdr.load_dict(whole(**parts | more))


def sunk():
    """The ball in the floor, in the fog."""
    fog = cube(FOG, scale=1.4, turn=15.0)
    sensor = camera([4, 1.0, 0.6], [0, 0, -0.8], 38.0, SIZE)
    return fogged(ball=ball([0.1, 0.05, -1.2], 0.5), fog=fog, sensor=sensor)


def tin():
    """A closed cylinder in the fog."""
    pose = T.translate([0.1, 0.05, -0.2]) @ T.rotate([1, 0.3, 0], 35.0) @ T.scale([0.35, 0.35, 0.6])
    lid = pose @ T.translate([0, 0, 1])
    parts = {"wall": {"type": "cylinder", "to_world": pose}, "lid": {"type": "disk", "to_world": lid}}
    parts = {name: part | {"exact": True, "bsdf": {"type": "twosided", "bsdf": PAINT}} for name, part in parts.items()}
    return fogged(ball=ball([9.0, 9.0, 9.0], 0.1), **parts)


def of_milk():
    """A ball of milk behind a surface that is not there, beside a painted one."""
    milk = medium((1.5, 1.0, 2.0), (0.95, 0.9, 0.8), g=0.6)
    return psdr.load_dict(
        whole(
            sensor=camera([4, 3, 2.5], [0, 0, -0.3], 40.0, SIZE),
            floor=FLOOR,
            lamp=lamp(),
            sky=sky(0.2, 0.3, 0.4),
            ball=ball([0, 0, 0.2], 0.8, NOTHING, interior=milk),
            stone=ball([1.5, 0.1, -0.8], 0.3),
        )
    )


def test_a_ball_that_absorbs_grows_as_its_closed_form_says() -> None:
    """Its shadow before a sky of radiance 1 is 2 pi times the integral of (exp(-2 sigma s) - 1) s from 0 to r."""
    sigma, fov = 1.5, 0.65
    sensor = camera([0, -200.0, 0], [0, 0, 0], fov, SIZE)
    absorbs = ball([0, 0, 0], 1.0, NOTHING, interior=medium(sigma, 0.0))
    scene = psdr.load_dict(whole(sensor=sensor, ball=absorbs, sky=sky(1.0, 1.0, 1.0)))
    pose = psdr.traverse(scene)["ball.to_world"].numpy()
    adjoint = np.zeros((SIZE, SIZE, 3), np.float32)
    adjoint[..., 0] = (400.0 * np.tan(np.radians(0.5 * fov)) / SIZE) ** 2
    found = derivatives(scene, ["ball.to_world"], adjoint, depth=1, spp=256)
    assert_mean([(g[0] * widen(pose)).sum() for g in found], 2.0 * np.pi * (np.exp(-2.0 * sigma) - 1.0))


#: Scene, parameter, direction, depth, samples a pixel.
ROWS = [
    (fogged, "ball.to_world", widen, 2, 512, "grows"),
    (fogged, "ball.to_world", shift(0.0, 0.0, 1.0), 2, 512, "rises"),
    (fogged, "leaf.to_world", shift(0.0, 1.0, 0.0), 2, 1024, "a leaf"),
    (fogged, "lamp.to_world", shift(0.0, 1.0, 0.0), 3, 1024, "the lamp"),
    (fogged, "sensor.to_world", shift(0.0, 0.5, 0.5), 2, 1024, "the camera"),
    (sunk, "sensor.to_world", shift(0.0, 0.5, 0.5), 2, 512, "the camera, sunk"),
    (sunk, "ball.to_world", widen, 2, 512, "grows, sunk"),
    (tin, ("wall.to_world", "lid.to_world"), shift(0.0, 0.0, 1.0), 2, 512, "a tin"),
    (of_milk, "ball.to_world", widen, 2, 1024, "milk grows"),
    (of_milk, "stone.to_world", shift(0.0, 0.0, 1.0), 3, 1024, "beside milk"),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the edges of cubes
@pytest.mark.parametrize(("make", "names", "motion", "depth", "spp", "what"), ROWS, ids=[row[-1] for row in ROWS])
def test_derivative_equals_finite_differences(make, names, motion, depth, spp, what) -> None:
    """A weighted image is compared, in both modes."""
    names = [names] if isinstance(names, str) else list(names)
    scene = make()
    params = psdr.traverse(scene)
    tangents = {name: motion(params[name].numpy()) for name in names}
    weights = np.mean([moved(scene, tangents, depth, 512, 900 + i) for i in range(2)], axis=0)
    adjoint = (weights / np.abs(weights).max()).astype(np.float32)
    expected = [(adjoint * moved(scene, tangents, depth, 4096, i)).sum() for i in range(BATCHES)]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    gradients = derivatives(scene, names, adjoint, spp=spp, depth=depth, batches=BATCHES)
    found = [sum((g * tangents[name]).sum() for g, name in zip(batch, names, strict=True)) for batch in gradients]
    # What the step leaves is of second order.
    assert_mean(found, np.mean(expected), np.hypot(error, 0.003 * np.mean(expected)))
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": spp, "seed": 50}
    image = psdr.render_forward(scene, params, tangents, **options).numpy()
    np.testing.assert_allclose((adjoint * image).sum(), found[0], rtol=1e-3)


def moved(scene, tangents, depth, spp, seed):
    """Return the central difference of the image, all that is named moved together."""
    params = psdr.traverse(scene)
    base = {name: params[name].numpy().copy() for name in tangents}
    images = []
    for side in (STEP, -STEP):
        for name, tangent in tangents.items():
            params[name] = (base[name] + side * tangent).astype(np.float32)
        params.update()
        integrator = psdr.PathIntegrator(max_depth=depth)
        images.append(psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy().astype(np.float64))
    for name, value in base.items():
        params[name] = value
    params.update()
    return (images[0] - images[1]) / (2.0 * STEP)


@pytest.mark.slow
def test_nothing_changes_where_all_moves_together() -> None:
    """Sample by sample: exact shapes in fog around the camera, one of them the border of another medium."""
    air = {"type": "ref", "id": "air"}
    scene = fogged(
        air={**FOG, "id": "air", "scale": 0.4},
        sensor=camera([2.0, 0.6, 0.4], [0, 0, 0], 50.0, SIZE, medium=air),
        fog=cube(air, scale=4.0),
        ink=ball([0.4, 0.6, -0.4], 0.3, NOTHING, interior=medium(2.0, 0.5), exterior=air),
    )
    names = [f"{part}.to_world" for part in ("ball", "ink", "leaf", "floor", "lamp", "sensor", "fog")]
    motion = shift(0.3, -0.5, 0.8)
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    parts = [(g * motion(g)).sum() for g in derivatives(scene, names, adjoint, spp=16, depth=4, batches=1)[0]]
    assert min(map(abs, parts)) > 0.0
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


GUIDED = {
    "k-d tree": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=4096)),
    "projective": psdr.boundary.Projective(guiding=psdr.guiding.Octree(max_leaves=4096)),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", GUIDED.values(), ids=GUIDED)
def test_guided_equals_unguided(method) -> None:
    scene = fogged()
    at = psdr.traverse(scene)["ball.to_world"].numpy()
    adjoint = np.broadcast_to(COLOURS, (SIZE, SIZE, 3)).astype(np.float32)
    motions = (shift(0.0, 0.0, 1.0), widen, aim(0, 1, 0))
    found = []
    for boundary in (psdr.boundary.PathSpace(), method):
        grads = derivatives(scene, ["ball.to_world"], adjoint, boundary, spp=512, depth=2)
        found.append(np.array([[(g[0] * motion(at)).sum() for motion in motions] for g in grads]))
    spread = np.std(found[1] - found[0], axis=0, ddof=1) / np.sqrt(len(found[0]))
    plain, guided = (f.mean(axis=0) for f in found)
    assert (np.abs(guided - plain) < 4.0 * spread).all(), (plain, guided, spread)
    assert (spread < 0.05 * np.abs(plain).max()).all(), "too noisy to tell"


def test_mirrors_beside_exact_shapes_in_media_are_refused() -> None:
    scene = fogged(panel=square(-3.0, 0.5, {"type": "conductor"}))
    with pytest.raises(
        ValueError, match="mirrors, glass and masks where there is 'ball', an exact 'sphere'; make them"
    ):
        psdr.plan(scene, names=["lamp.to_world"], integrator=psdr.PathIntegrator(max_depth=3))
