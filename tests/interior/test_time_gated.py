"""Interior term before a transient film: closed forms, finite differences, both modes, and what is refused."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.sensor import timed
from tests.sensor.test_transient import BOX, GAUSSIAN, seen_plane

DIRECT = psdr.PathIntegrator(max_depth=2, boundary=None)
ROOM = psdr.PathIntegrator(max_depth=3, boundary=None)
LIGHT = np.array([0.5, -0.8, 0.6], np.float32)
#: Noise of both sides, of the same random numbers, and the differences' own error.
SLOPE = 0.02


def along(scene, tangents, integrator, spp, seed=0):
    return psdr.render_forward(scene, psdr.traverse(scene), tangents, integrator=integrator, spp=spp, seed=seed).numpy()


def difference(make, name, direction, step, integrator, spp, batches=4):
    """Central differences of the primal image with the same random numbers."""
    images = []
    for sign in (1.0, -1.0):
        scene = make()
        params = psdr.traverse(scene)
        params[name] = params[name].numpy() + np.float32(sign * step) * direction
        params.update()
        images.append(
            np.mean(
                [psdr.render(scene, integrator=integrator, spp=spp, seed=s).numpy() for s in range(batches)], axis=0
            )
        )
    return (images[0] - images[1]) / (2.0 * step)


def slope_of(found, expected):
    return float((found * expected).sum() / (expected**2).sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("film", "gate"),
    [
        pytest.param(*BOX, id="box"),
        pytest.param(*GAUSSIAN, id="gaussian"),
    ],
)
def test_a_receding_plane_has_its_closed_form(film, gate) -> None:
    """With the length detached the derivative would be -0.32 for 1.55."""
    away = np.zeros((4, 4), np.float32)
    away[2, 3] = -1.0
    scene = timed.plane(**film)
    found = [along(scene, {"plane.to_world": away}, DIRECT, 512, seed=s).mean() for s in range(6)]
    _value, expected = seen_plane(gate)
    assert abs(np.mean(found) - expected) < 4.0 * np.std(found, ddof=1) / np.sqrt(6) + 2e-3 * abs(expected)
    assert expected > 0.0 and np.std(found, ddof=1) < 0.1 * expected


def test_light_that_moves_in_a_room_agrees_with_differences_in_both_modes() -> None:
    scene = timed.room(**timed.ROOM_BINS)
    params = psdr.traverse(scene)
    forward = np.mean([along(scene, {"lamp.position": LIGHT}, ROOM, 64, seed=s) for s in range(4)], axis=0)
    expected = difference(lambda: timed.room(**timed.ROOM_BINS), "lamp.position", LIGHT, 4e-3, ROOM, 64)
    assert slope_of(forward, expected) == pytest.approx(1.0, abs=SLOPE)
    assert np.corrcoef(forward.ravel(), expected.ravel())[0, 1] > 0.9
    params.requires_grad("lamp.position")
    adjoint = np.random.default_rng(2).normal(size=forward.shape).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=ROOM, spp=64)
    reverse = float(params["lamp.position"].grad.numpy() @ LIGHT)
    assert reverse == pytest.approx(float((adjoint * along(scene, {"lamp.position": LIGHT}, ROOM, 64)).sum()), rel=2e-4)


@pytest.mark.slow
def test_the_bins_of_a_derivative_add_up_to_the_steady_one() -> None:
    bins = along(timed.room(**timed.ROOM_BINS), {"lamp.position": LIGHT}, ROOM, 64).sum(axis=2)
    steady = along(timed.room(), {"lamp.position": LIGHT}, ROOM, 64)
    np.testing.assert_allclose(bins, steady, rtol=1e-3, atol=1e-4 * np.abs(steady).max())


AREA = {
    "type": "rectangle",
    "to_world": psdr.Transform.look_at((0.2, 0.9, 0.3), (0, -1, 0), (1, 0, 0)) @ psdr.Transform.scale(0.2),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9, 8, 7]}},
    "bsdf": timed.paint(0.0, 0.0, 0.0),
}
SPOT = {
    "type": "spot",
    "to_world": psdr.Transform.look_at((0.2, 0.6, 0.5), (0, -0.6, -0.6), (1, 0, 0)),
    "cutoff_angle": 80.0,
    "beam_width": 5.0,
}
MOVED = np.zeros((4, 4), np.float32)
MOVED[:3, 3] = (0.4, -0.5, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "name", "direction", "depth"),
    [
        # A lamp that the camera does not see hides nothing at depth 2.
        pytest.param(AREA, "lamp.to_world", MOVED, 2, id="area"),
        pytest.param(SPOT, "lamp.to_world", MOVED, 3, id="spot"),
        pytest.param(None, "camera.to_world", MOVED, 2, id="camera"),
        pytest.param(None, "wall20.bsdf.reflectance.value", np.ones(3, np.float32), 3, id="albedo"),
    ],
)
def test_slopes_are_those_of_differences(light, name, direction, depth) -> None:
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=None)

    def make():
        if name == "camera.to_world":
            return plane_seen_from_a_moving_camera()
        return timed.room(light, **timed.ROOM_BINS)

    forward = np.mean([along(make(), {name: direction}, integrator, 256, seed=s) for s in range(4)], axis=0)
    expected = difference(make, name, direction, 4e-3, integrator, 256)
    assert np.abs(expected).max() > 0.01
    assert slope_of(forward, expected) == pytest.approx(1.0, abs=SLOPE)
    scene = make()
    params = psdr.traverse(scene)
    params.requires_grad(name)
    adjoint = np.random.default_rng(2).normal(size=forward.shape).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=64)
    reverse = float((params[name].grad.numpy() * direction).sum())
    assert reverse == pytest.approx(float((adjoint * along(make(), {name: direction}, integrator, 64)).sum()), rel=1e-3)


def plane_seen_from_a_moving_camera():
    """A light beside the camera, and a plane that fills its view."""
    film = {"temporal_bins": 16, "bin_width_opl": 0.05, "start_opl": 2.0, "pulse_width_opl": 0.1}
    view = timed.camera((0, 0, 0), (0.1, 0, -1), 34.0, **film)
    lamp = {"type": "point", "position": [0.2, 0.1, 0]}
    ground = {"type": "rectangle", "to_world": psdr.Transform.translate((0, 0, -1)) @ psdr.Transform.scale((4, 4, 1))}
    return psdr.load_dict({"type": "scene", "camera": view, "lamp": lamp, "plane": ground})


GROUND = {"type": "rectangle", "to_world": psdr.Transform.translate((0, 0, -1)) @ psdr.Transform.scale((4, 4, 1))}
#: A plane that moves away from the camera, and is tilted.
AWAY = np.zeros((4, 4), np.float32)
AWAY[2] = (0.1, -0.05, 0.0, -1.0)


def filled(extra, ground=None, view=None, start=2.0, bins=24):
    """A plane that fills the view of a camera beside a point light, and what light passes on the way to it."""
    film = {"temporal_bins": bins, "bin_width_opl": 0.05, "start_opl": start, "pulse_width_opl": 0.1}
    camera = {**timed.camera((0, 0, 0), (0.1, 0, -1), 34.0, **film), **(view or {})}
    if camera["type"] == "orthographic":
        del camera["fov"]
    lamp = {"type": "point", "position": [0.2, 0.1, 0]}
    return psdr.load_dict(
        {"type": "scene", "camera": camera, "lamp": lamp, "plane": {**GROUND, **(ground or {})}, **extra}
    )


SHINING = {
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}},
    "bsdf": timed.paint(0.5, 0.6, 0.7),
}
#: The camera looks up at a mirror that shows the plane, and the lamp shines down past it.
MIRROR = {
    "type": "rectangle",
    "to_world": psdr.Transform.look_at((0, 0, 0.5), (0, 0, -1), (0, 1, 0)) @ psdr.Transform.scale((3, 3, 1)),
    "bsdf": {"type": "conductor"},
}
SLAB = {
    "type": "cube",
    "to_world": psdr.Transform.translate((0, 0, -0.5)) @ psdr.Transform.scale((4, 4, 0.1)),
    "bsdf": {"type": "dielectric", "int_ior": 1.5},
}
UPWARDS = {"to_world": psdr.Transform.look_at((0, 0, 0), (0.05, 0, 1), (0, 1, 0))}
PARALLEL = {"type": "orthographic", "to_world": psdr.Transform.look_at((0, 0, 0), (0, 0.1, -1), (0, 1, 0))}
LENS = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 1.5}
GAUSSIAN = {
    "film": {
        **{"type": "transient_hdr_film", "width": timed.SIZE, "height": timed.SIZE, "rfilter": {"type": "gaussian"}},
        **{"temporal_bins": 24, "bin_width_opl": 0.05, "start_opl": 2.0, "pulse": "gaussian"},
    }
}
#: A scene and its depth. Behind glass the light of a point is not found: the plane shines.
CASES = {
    "emission": lambda: (filled({}, SHINING, start=0.8), 2),
    "orthographic": lambda: (filled({}, view=PARALLEL), 2),
    "thin lens": lambda: (filled({}, view=LENS), 2),
    "rough": lambda: (filled({}, {"bsdf": {"type": "roughconductor", "alpha": 0.4}}), 2),
    "mirror": lambda: (filled({"mirror": MIRROR}, view=UPWARDS, start=2.5, bins=40), 3),
    "glass": lambda: (filled({"slab": SLAB}, SHINING, start=0.9), 3),
    "wide filter": lambda: (filled({}, view=GAUSSIAN), 2),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_tilting_plane_has_the_slopes_of_differences(case) -> None:
    """Emission, next-event estimates and refracted segments, each found by rays of the camera, a mirror or glass."""
    depth = CASES[case]()[1]
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=None)

    def make():
        return CASES[case]()[0]

    forward = np.mean([along(make(), {"plane.to_world": AWAY}, integrator, 256, seed=s) for s in range(4)], axis=0)
    expected = difference(make, "plane.to_world", AWAY, 2e-3, integrator, 256)
    assert np.abs(expected).max() > 0.01
    assert slope_of(forward, expected) == pytest.approx(1.0, abs=SLOPE)
    assert np.corrcoef(forward.ravel(), expected.ravel())[0, 1] > 0.95
    scene = make()
    params = psdr.traverse(scene)
    params.requires_grad("plane.to_world")
    adjoint = np.random.default_rng(2).normal(size=forward.shape).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=64)
    reverse = float((params["plane.to_world"].grad.numpy() * AWAY).sum())
    expected = float((adjoint * along(make(), {"plane.to_world": AWAY}, integrator, 64)).sum())
    assert reverse == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_tape_carries_a_loss_of_bins() -> None:
    scene = timed.room(**timed.ROOM_BINS)
    params = psdr.traverse(scene)
    params.requires_grad("lamp.position")
    with wp.Tape() as tape:
        image = psdr.render(scene, params, integrator=ROOM, spp=32, spp_grad=32, tape=tape)
        loss = psdr.losses.l2(image, np.zeros((*image.shape, 3), np.float32))
    tape.backward(loss)
    taped = params["lamp.position"].grad.numpy().copy()
    params["lamp.position"].grad.zero_()
    psdr.render_backward(scene, params, 2.0 * image.numpy() / image.numpy().size, integrator=ROOM, spp=32)
    np.testing.assert_allclose(taped, params["lamp.position"].grad.numpy(), rtol=1e-5)
    assert np.abs(taped).max() > 0.0


def test_what_has_no_derivative_is_refused() -> None:
    scene = timed.room(**timed.ROOM_BINS)

    def plan(scene, *names, **options):
        return psdr.plan(scene, names=list(names), integrator=psdr.PathIntegrator(boundary=None, **options))

    with pytest.raises(ValueError, match="max_depth is -1"):
        plan(scene, "lamp.position")
    with pytest.raises(ValueError, match=r"interior.Textbook\(\)"):
        plan(scene, "lamp.position", max_depth=3, interior=psdr.interior.Textbook())
    jumping = timed.room(**{**timed.ROOM_BINS, "pulse_width_opl": 0.0})
    with pytest.raises(ValueError, match="pulse_width_opl of more than 0"):
        plan(jumping, "lamp.position", max_depth=3)
    plan(jumping, "wall20.bsdf.reflectance.value", max_depth=3)  # light changes, but not its length
