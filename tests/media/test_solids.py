"""Shapes without triangles in and around media: images and derivatives, against meshes, closed forms and Mitsuba."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import BLACK, FLOOR, NOTHING, VIEW, camera, cube, integrator, lamp, medium, rgb, sky, whole
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

SIZE = 16
#: Depth at which no path is ended by roulette, whose weights have a tail in dense media.
NEVER = 100000
MILK = {**medium((1.5, 1.0, 2.0), (0.95, 0.9, 0.8), g=0.6), "id": "milk"}
EXACT, FINE = {"exact": True}, {"resolution": 128}
PAINT = {"type": "diffuse", "reflectance": rgb(0.3, 0.5, 0.7)}


def ball(center, radius, how, **more):
    return {"type": "sphere", "center": center, "radius": radius, **how, **more}


#: Of what spheres are in the scene; ``how``: exact, or of triangles.
SCENES = {
    "of milk": lambda how: {"ball": ball([0, 0, -0.2], 1.0, how, bsdf=NOTHING, interior=MILK)},
    "milk in rough glass": lambda how: {
        "ball": ball(
            [0, 0, -0.2], 1.0, how, bsdf={"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.3}, interior=MILK
        )
    },
    "ink in milk": lambda how: {
        "ball": ball([0, 0, -0.2], 1.0, how, bsdf=NOTHING, interior=MILK),
        "ink": ball(
            [0.1, 0.1, -0.2], 0.4, how, bsdf=NOTHING, exterior={"type": "ref", "id": "milk"}, interior=medium(5.0, 0.3)
        ),
    },
    "painted, in milk": lambda how: {
        "cube": cube(MILK, turn=20.0, scale=1.2),
        "ball": ball([0.2, 0.1, -0.2], 0.6, how, bsdf=PAINT),
    },
    "shines in milk": lambda how: {
        "cube": cube(MILK, turn=20.0, scale=1.2),
        "ball": ball([0.2, 0.1, -0.2], 0.4, how, bsdf=BLACK, emitter={"type": "area", "radiance": rgb(4.0, 3.0, 2.0)}),
    },
}
FAST = ("of milk", "shines in milk")
ALL = [pytest.param(name, marks=[pytest.mark.slow] * (name not in FAST)) for name in SCENES]


def described(name, how, depth=8):
    parts = {"sensor": camera(*VIEW[:3], SIZE), "floor": FLOOR, "lamp": lamp(), "sky": sky(0.2, 0.3, 0.4)}
    return whole(integrator=integrator(max_depth=depth), **parts, **SCENES[name](how))


@pytest.mark.parametrize("name", ALL)
def test_images_of_exact_spheres_are_those_of_fine_meshes(name) -> None:
    scenes = [psdr.load_dict(described(name, how)) for how in (EXACT, FINE)]
    exact, fine = (batches(scene, spp=64, seed=100 * i) for i, scene in enumerate(scenes))
    assert_same_mean(blocks(exact, 4), blocks(fine, 4), name)
    assert [psdr.invalid_samples(scene)["image"] for scene in scenes] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_images_equal_mitsubas_whose_spheres_are_exact(name) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    ours = batches(psdr.load_dict(described(name, EXACT)), spp=64)
    parts = described(name, {})
    theirs = mi.load_dict(for_mitsuba(mi, {**parts, "integrator": {**parts["integrator"], "rr_depth": 100}}))
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    assert_same_mean(blocks(ours, 4), blocks(theirs, 4), name, MITSUBA_ROUNDING)


@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the edges of cubes and triangles
@pytest.mark.parametrize("name", ALL)
def test_derivatives_beside_exact_spheres_are_those_beside_fine_meshes(name) -> None:
    """Of the same random numbers, so that what differs is the surface alone."""
    adjoint = np.linspace(0.5, 1.5, 3 * SIZE * SIZE, dtype=np.float32).reshape(SIZE, SIZE, 3)
    found = []
    for how in (EXACT, FINE):
        scene = psdr.load_dict(described(name, how, 6))
        params = psdr.traverse(scene)
        ends = (
            "sigma_t.value.value",
            "albedo.value.value",
            "scale",
            "phase_function.g",
            "reflectance.value",
            "radiance.value",
        )
        names = [n for n in params if n.endswith(ends)]
        assert any("medium" in n for n in names)
        params.requires_grad_only(*names)
        found.append([])
        for seed in range(8):
            params.zero_grad()
            options = {"integrator": psdr.PathIntegrator(max_depth=6), "spp": 64, "seed": seed}
            psdr.render_backward(scene, params, adjoint, **options)
            found[-1].append(np.concatenate([params[n].grad.numpy().ravel() for n in names]))
    exact, fine = np.array(found, np.float64)
    assert_same_mean(exact, fine, name)
    assert np.abs(fine.mean(axis=0)).min() > 0.0


def before_the_sky(inside, depth, fov):
    """A sphere of the radius 1 far away, beside a sky of radiance 1."""
    sensor = camera([0, -200.0, 0], [0, 0, 0], fov, SIZE)
    parts = {"ball": ball([0, 0, 0], 1.0, EXACT, bsdf=NOTHING, interior=inside), "sky": sky(1.0, 1.0, 1.0)}
    scene = psdr.load_dict(whole(sensor=sensor, **parts))
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth, rr_depth=NEVER), spp=64, seed=0).numpy()
    assert psdr.invalid_samples(scene)["image"] == 0
    return image


def test_light_that_is_absorbed_in_a_sphere_has_its_closed_form() -> None:
    """The mean of exp(-2 sigma cos) over pixels."""
    fine = 8 * SIZE
    x = ((np.arange(fine) + 0.5) / fine * 2.0 - 1.0) * 200.0 * np.tan(np.radians(0.1))
    exact = np.exp(-3.0 * np.sqrt(1.0 - x[:, None] ** 2 - x[None, :] ** 2)).reshape(SIZE, 8, SIZE, 8).mean(axis=(1, 3))
    image = before_the_sky(medium(1.5, 0.0), 1, 0.2)
    np.testing.assert_allclose(image, np.repeat(exact[..., None], 3, axis=2), rtol=0.01)


@pytest.mark.parametrize("density", [20.0, 200.0])
def test_a_sphere_that_absorbs_nothing_is_as_bright_as_the_sky(density) -> None:
    image = before_the_sky(medium(density, 1.0), -1, 0.65)[..., 0]
    error = image.std(ddof=1) / SIZE
    assert abs(image.mean() - 1.0) < 4.0 * error and error < 0.01


def test_what_moves_beside_grids_is_refused_and_meshes_are_offered() -> None:
    """Also what moves beside them, and with the interior term alone."""
    axis = np.linspace(-1.0, 1.0, 8, dtype=np.float32)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    stone = {"type": "sdfgrid", "grid": (np.sqrt(x * x + y * y + z * z) - 0.6)[..., None], "bsdf": PAINT}
    pose = psdr.Transform.translate([-0.5, -0.5, -0.5])
    parts = described("of milk", EXACT) | {"stone": stone | {"to_world": pose}}
    scene = psdr.load_dict(parts)
    for moved in ("stone.to_world", "floor.to_world", "sensor.to_world"):
        for boundary in ("auto", None):
            with pytest.raises(ValueError, match=r"where there is 'stone', .*; extract its triangles"):
                psdr.plan(scene, names=[moved], integrator=psdr.PathIntegrator(max_depth=4, boundary=boundary))


def test_other_ways_to_differentiate_name_replay() -> None:
    scene = psdr.load_dict(described("of milk", EXACT))
    way = psdr.PathIntegrator(max_depth=4, interior=psdr.interior.DifferentialRatioTracking())
    with pytest.raises(ValueError, match=r"participating media beside shapes without triangles.*interior.Replay\(\)"):
        psdr.plan(scene, names=["ball.interior_medium.scale"], integrator=way)
