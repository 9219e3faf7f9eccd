"""Several renderings on one tape, of values that change in between: simulate, render, simulate again."""

import gc
import warnings

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import measure
from warp_psdr.scene.frames import bytes_of_frame, frames_of

SIZE, FRAMES, STEP = 12, 3, 0.1
SHEET, FLOOR = "sheet.vertex_positions", "floor.bsdf.reflectance.value"
INTEGRATOR = measure.integrator(3)
OPTIONS = {"integrator": INTEGRATOR, "spp": 16}
WHOLE = psdr.PathIntegrator(max_depth=3, rr_depth=measure.NO_ROULETTE)
PLACES = np.float32([[-0.3, 1.0, -0.3], [0.3, 1.0, -0.3], [0.3, 1.0, 0.3], [-0.3, 1.0, 0.3]])
T = psdr.Transform


@wp.kernel
def fall(start: wp.array(dtype=wp.vec3), gravity: wp.array(dtype=float), t: float, out: wp.array(dtype=wp.vec3)):
    """A user's simulation: free fall."""
    i = wp.tid()
    out[i] = start[i] - wp.vec3(0.0, 0.5 * gravity[0] * t * t, 0.0)


@wp.kernel
def turn(spin: wp.array(dtype=float), t: float, out: wp.array(dtype=wp.transform)):
    """Bodies that turn about the upright axis while they rise."""
    i = wp.tid()
    angle = spin[0] * t * (1.0 + wp.float32(i))
    out[i] = wp.transform(
        wp.vec3(0.5 * wp.float32(i), 0.6 + 0.2 * angle, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), angle)
    )


def node(**more):
    """A sheet above a floor, under a lamp."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = T.look_at([0.0, 3.0, 3.0], [0.0, 0.4, 0.0], [0.0, 1.0, 0.0])
    lying = T.rotate([1.0, 0.0, 0.0], -90.0)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 50.0, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": lying @ T.scale(4.0), "bsdf": {"type": "diffuse"}},
        "sheet": {
            "type": "mesh",
            "vertices": PLACES,
            "faces": np.int32([[0, 2, 1], [0, 3, 2]]),
            "face_normals": True,
            "bsdf": {"type": "twosided", "inner": {"type": "diffuse"}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T.translate([0.5, 4.0, 0.0]) @ T.rotate([1.0, 0.0, 0.0], 90.0) @ T.scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [30.0, 20.0, 10.0]}},
        },
        **more,
    }


def weights(seed=0):
    values = np.random.default_rng(seed).uniform(0.5, 1.5, (SIZE, SIZE, 3)).astype(np.float32)
    return wp.array(values, dtype=wp.vec3, device="cpu")


def gravity_of(value):
    return wp.array([value], dtype=wp.float32, device="cpu", requires_grad=True)


def film_of_a_fall(scene, params, gravity, way, frames=range(FRAMES)):
    """Return the tape and the images of a falling sheet; ``way``: its places are written, copied or bound."""
    start = wp.array(PLACES, dtype=wp.vec3, device="cpu")
    tape, images = wp.Tape(), []
    with tape:
        for k in frames:
            own = wp.zeros(len(PLACES), dtype=wp.vec3, device="cpu", requires_grad=True)
            out = params[SHEET] if way == "written" else own
            wp.launch(fall, len(PLACES), [start, gravity, STEP * (k + 1)], [out], device="cpu")
            if way == "copied":
                wp.copy(params[SHEET], own)
            if way == "bound":
                params.bind(SHEET, own)
            images.append(psdr.render(scene, params, seed=k, **OPTIONS))
    return tape, images


def slopes(way, frames=range(FRAMES), **more):
    """Return the derivatives of the weighted frames by the gravity and by the floor's colour."""
    scene = psdr.load_dict(node(**more))
    params = psdr.traverse(scene)
    params.requires_grad(SHEET, FLOOR)
    gravity = gravity_of(9.8)
    tape, images = film_of_a_fall(scene, params, gravity, way, frames)
    tape.backward(grads={image: weights(k) for k, image in zip(frames, images, strict=True)})
    return np.concatenate([gravity.grad.numpy(), params[FLOOR].grad.numpy()])


@pytest.mark.parametrize("way", ["written", "copied", "bound"])
def test_frames_add_up(way):
    """Each frame is differentiated by its own values, whatever the simulation wrote later."""
    single = sum(slopes(way, [k]) for k in range(FRAMES))
    together = slopes(way)
    assert np.abs(single).min() > 1e-3
    np.testing.assert_allclose(together, single, rtol=1e-5)
    np.testing.assert_allclose(slopes(way, [1, 1]), 2.0 * slopes(way, [1]), rtol=1e-6)


def glass_ball_and_sky():
    """A ball of glass with interpolated normals, an environment map and a bitmap."""
    rng = np.random.default_rng(0)
    paint = {"type": "bitmap", "data": rng.random((8, 8, 3)).astype(np.float32), "raw": True}
    glass = {"type": "dielectric"}
    return {
        "ball": {"type": "sphere", "center": [0.8, 0.5, 0.3], "radius": 0.3, "resolution": 12, "bsdf": glass},
        "sky": {"type": "envmap", "bitmap": rng.random((6, 12, 3)).astype(np.float32)},
        "wall": {
            "type": "rectangle",
            "to_world": T.translate([0.0, 1.0, -2.0]) @ T.scale(2.0),
            "bsdf": {"type": "diffuse", "reflectance": paint},
        },
    }


def fog():
    """A homogeneous medium around the sheet."""
    inside = {"type": "homogeneous", "albedo": 0.6, "sigma_t": 0.3}
    to_world = T.translate([0.0, 0.9, 0.0]) @ T.scale(2.5)
    return {"fog": {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": inside}}


@pytest.mark.slow
@pytest.mark.parametrize("more", [glass_ball_and_sky, fog])
def test_frames_add_up_beside(more):
    single = sum(slopes("bound", [k], **more()) for k in range(FRAMES))
    assert np.abs(single).min() > 1e-3
    np.testing.assert_allclose(slopes("bound", **more()), single, rtol=1e-5)


@pytest.mark.slow
def test_frames_are_differentiated_rightly():
    """Against differences with equal random numbers, of two steps."""

    scene = psdr.load_dict(node())
    params = psdr.traverse(scene)
    params.requires_grad(SHEET)
    start = wp.array(PLACES, dtype=wp.vec3, device="cpu")

    def measured(value):
        total, slope = [], []
        for seed in range(8):
            gravity, tape, images = gravity_of(value), wp.Tape(), []
            with tape:
                for k in range(FRAMES):
                    wp.launch(fall, len(PLACES), [start, gravity, STEP * (k + 1)], [params[SHEET]], device="cpu")
                    images.append(psdr.render(scene, params, integrator=WHOLE, spp=1024, seed=10 * seed + k))
            total.append(sum((i.numpy().astype(float) * weights(k).numpy()).sum() for k, i in enumerate(images)))
            tape.backward(grads={image: weights(k) for k, image in enumerate(images)})
            slope.append(float(gravity.grad.numpy()[0]))
        return np.array(total), np.array(slope)

    with measure.shared_random_numbers():
        slope = measured(9.8)[1]
        for step in (0.4, 0.8):
            difference = (measured(9.8 + step)[0] - measured(9.8 - step)[0]) / (2.0 * step)
            gap = slope - difference
            error = gap.std(ddof=1) / np.sqrt(gap.size)
            assert abs(slope.mean()) > 10.0 * slope.std(ddof=1) / np.sqrt(slope.size)
            assert abs(gap.mean()) < 4.0 * error + 0.01 * abs(slope.mean())


def test_scenes_and_sensors_take_turns_on_a_tape():
    def gradient(turns):
        scenes = [psdr.load_dict(node()), psdr.load_dict(node())]
        both = [psdr.traverse(scene) for scene in scenes]
        tape, images = wp.Tape(), []
        for params in both:
            params.requires_grad(FLOOR)
        for i, value in turns:
            both[i][FLOOR] = value
            images.append(psdr.render(scenes[i], both[i], tape=tape, seed=int(10 * value), **OPTIONS))
        tape.backward(grads={image: weights(k) for k, image in enumerate(images)})
        return np.concatenate([params[FLOOR].grad.numpy() for params in both])

    in_turns = gradient([(0, 0.2), (1, 0.3), (0, 0.4), (1, 0.6)])
    assert in_turns.all()

    def alone(i, value, k):
        scene = psdr.load_dict(node())
        params = psdr.traverse(scene)
        params.requires_grad(FLOOR)
        params[FLOOR] = value
        psdr.render_backward(scene, params, weights(k), seed=int(10 * value), **OPTIONS)
        return params[FLOOR].grad.numpy()

    first = alone(0, 0.2, 0) + alone(0, 0.4, 2)
    second = alone(1, 0.3, 1) + alone(1, 0.6, 3)
    np.testing.assert_allclose(in_turns, np.concatenate([first, second]), rtol=1e-6)


def test_a_frame_keeps_what_has_changed():
    texels = np.random.default_rng(1).random((256, 256, 3)).astype(np.float32)
    paint = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": texels, "raw": True}}
    scene = psdr.load_dict(node(wall={"type": "rectangle", "bsdf": paint}))
    params = psdr.traverse(scene)
    params.requires_grad(SHEET)
    tape, _images = film_of_a_fall(scene, params, gravity_of(9.8), "written")
    frames = frames_of(tape, scene)
    assert frames.count == FRAMES and frames.first.nbytes > texels.nbytes
    assert frames.take().nbytes < 0.02 * texels.nbytes
    assert "a frame on a tape" not in str(psdr.plan(scene, params, integrator=INTEGRATOR))
    params.bind(SHEET, wp.array(PLACES, dtype=wp.vec3, device="cpu"))
    assert frames.take().nbytes <= bytes_of_frame(scene) < 0.02 * texels.nbytes
    assert f"bound arrays change {SHEET}" in str(psdr.plan(scene, params, integrator=INTEGRATOR))
    del frames
    tape.reset()
    gc.collect()
    assert frames_of(tape, scene).count == 0


def test_bound_arrays_are_the_parameters():
    scene = psdr.load_dict(node())
    params = psdr.traverse(scene)
    own = wp.array(PLACES + np.float32([0.0, 0.1, 0.0]), dtype=wp.vec3, device="cpu", requires_grad=True)
    before = params[SHEET].numpy().copy()
    params.bind(SHEET, own)
    assert params[SHEET] is own and params.requested == [SHEET]
    image = psdr.render(scene, seed=1, **OPTIONS).numpy()
    psdr.render_backward(scene, params, weights(), seed=1, **OPTIONS)
    assert own.grad.numpy().any()
    params[SHEET] = before
    np.testing.assert_array_equal(own.numpy(), before)
    assert np.abs(psdr.render(scene, seed=1, **OPTIONS).numpy() - image).max() > 1e-2
    own.assign(PLACES + np.float32([0.0, 0.1, 0.0]))
    np.testing.assert_array_equal(psdr.render(scene, seed=1, **OPTIONS).numpy(), image)
    params.bind(SHEET, None)
    assert params[SHEET] is not own
    np.testing.assert_array_equal(params[SHEET].numpy(), own.numpy())
    own.zero_()
    np.testing.assert_array_equal(psdr.render(scene, seed=1, **OPTIONS).numpy(), image)


BOXES = {f"box{i}": {"type": "cube", "bsdf": {"type": "diffuse"}} for i in range(2)}
POSES = tuple(f"{name}.to_world" for name in BOXES)
SIZES = {name: np.diag([0.2, 0.1, 0.15, 1.0]) for name in POSES}


def bodies_at(value, t, spin=None):
    spin = wp.array([value], dtype=wp.float32, device="cpu") if spin is None else spin
    bodies = wp.zeros(2, dtype=wp.transform, device="cpu", requires_grad=bool(spin.requires_grad))
    wp.launch(turn, 2, [spin, t], [bodies], device="cpu")
    return bodies


def poses_at(value, t):
    """Return the poses of both boxes, float64."""
    found = [np.array(wp.transform_to_matrix(wp.transform(*at))).reshape(4, 4) for at in bodies_at(value, t).numpy()]
    return {name: pose @ SIZES[name] for name, pose in zip(POSES, found, strict=True)}


def test_bodies_keep_the_size_that_they_were_loaded_with():
    """Turned and stretched boxes, a ball of a radius, and a mirror image."""
    turned = T.rotate([0.3, 1.0, 0.2], 50.0)
    shapes = {
        "box": {"type": "cube", "to_world": T.translate([1.0, 2.0, 3.0]) @ turned @ T.scale([0.2, 0.3, 0.4])},
        "ball": {"type": "sphere", "center": [0.5, 0.0, 0.0], "radius": 0.25},
        "mirrored": {"type": "cube", "to_world": T.scale([-0.2, 0.3, 0.4])},
    }
    params = psdr.traverse(psdr.load_dict(node(**shapes)))
    sizes = {"box": 8 * 0.2 * 0.3 * 0.4, "ball": 4.0 / 3.0 * np.pi * 0.25**3, "mirrored": -8 * 0.2 * 0.3 * 0.4}
    at = wp.array([(0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)], dtype=wp.transform, device="cpu")
    for name, volume in sizes.items():
        pose = f"{name}.to_world"
        unit = volume / np.linalg.det(params[pose].numpy())
        psdr.bind(params, {pose: at})
        linear = params[pose].numpy()[:3, :3]
        np.testing.assert_allclose(linear, linear.T, atol=1e-6)
        assert np.linalg.det(linear) * unit == pytest.approx(volume, rel=1e-5)
    params.update()
    ball = params["ball.vertex_positions"].numpy()
    np.testing.assert_allclose(0.5 * (ball.min(axis=0) + ball.max(axis=0)), [0.1, 0.2, 0.3], atol=1e-3)
    assert np.ptp(ball, axis=0).max() == pytest.approx(0.5, rel=1e-2)


def film_of_boxes(scene, params, value, **options):
    """Return the spin, the images of two frames, and the tape."""
    spin, tape, images = gravity_of(value), wp.Tape(), []
    with tape:
        for k in range(2):
            psdr.bind(params, {POSES: bodies_at(value, 0.3 * (k + 1), spin)}, local=SIZES)
            images.append(psdr.render(scene, params, **options))
    return spin, images, tape


def test_bodies_are_poses():
    """Two boxes by one array of transforms; gradients reach the simulation's number, also through their sizes."""
    scene = psdr.load_dict(node(**BOXES))
    params = psdr.traverse(scene)
    spin, images, tape = film_of_boxes(scene, params, 1.0, seed=1, **OPTIONS)
    for name, pose in poses_at(1.0, 0.6).items():
        np.testing.assert_allclose(params[name].numpy(), pose, atol=1e-6)
    tape.backward(grads={image: weights(k) for k, image in enumerate(images)})
    expected, e = 0.0, 1.0e-3
    for name in POSES:
        params.bind(name, None)
    for k, t in enumerate((0.3, 0.6)):
        now, ahead, behind = (poses_at(1.0 + s * e, t) for s in (0.0, 1.0, -1.0))
        for name in POSES:
            params[name] = now[name]
        params.zero_grad()
        psdr.render_backward(scene, params, weights(k), seed=1, **OPTIONS)
        expected += sum((params[n].grad.numpy() * (ahead[n] - behind[n])).sum() / (2.0 * e) for n in POSES)
    assert abs(expected) > 1e-2
    assert float(spin.grad.numpy()[0]) == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
def test_moving_bodies_are_differentiated_rightly():
    """Silhouettes and shadows included, against differences with equal random numbers."""
    scene = psdr.load_dict(node(**BOXES))
    params = psdr.traverse(scene)
    options = {"integrator": WHOLE, "spp": 1024}

    def total(images):
        return sum((image.numpy().astype(float) * weights(k).numpy()).sum() for k, image in enumerate(images))

    slopes, gaps, h = [], [], 0.05
    with measure.shared_random_numbers():
        for seed in range(12):
            spin, images, tape = film_of_boxes(scene, params, 1.0, seed=seed, **options)
            tape.backward(grads={image: weights(k) for k, image in enumerate(images)})
            slopes.append(float(spin.grad.numpy()[0]))
            ends = [total(film_of_boxes(scene, params, 1.0 + s * h, seed=seed, **options)[1]) for s in (1.0, -1.0)]
            gaps.append(slopes[-1] - (ends[0] - ends[1]) / (2.0 * h))
    slope, gap = np.mean(slopes), np.mean(gaps)
    error = np.std(gaps, ddof=1) / np.sqrt(len(gaps))
    assert abs(slope) > 10.0 * error and abs(gap) < 4.0 * error


@pytest.mark.parametrize(
    ("array", "error", "message"),
    [
        (PLACES, TypeError, "expected a contiguous wp.array of vec3"),
        (wp.zeros(4, dtype=wp.float32, device="cpu"), TypeError, "wp.array of float32"),
        (wp.zeros(5, dtype=wp.vec3, device="cpu"), ValueError, "number of vertices"),
        (wp.zeros(1, dtype=wp.transform, device="cpu"), TypeError, "transforms are poses"),
    ],
)
def test_bad_bindings_are_refused(array, error, message):
    params = psdr.traverse(psdr.load_dict(node()))
    with pytest.raises(error, match=message):
        psdr.bind(params, {SHEET: array})
    with pytest.raises(ValueError, match="need transforms up to number 1"):
        psdr.bind(params, {("floor.to_world", "lamp.to_world"): wp.zeros(1, dtype=wp.transform, device="cpu")})


def test_a_simulation_that_fails_is_told():
    """Particles that are no numbers, and those that fly away: which rendering it was, and why it may be."""
    scene = psdr.load_dict(node())
    params = psdr.traverse(scene)
    tape = wp.Tape()
    for value in (1.0, np.nan):
        own = wp.full(len(PLACES), wp.vec3(value), dtype=wp.vec3, device="cpu", requires_grad=True)
        params.bind(SHEET, own)
        if np.isfinite(value):
            psdr.render(scene, params, tape=tape, **OPTIONS)
            continue
        with pytest.raises(ValueError, match="NaN or infinity") as caught:
            psdr.render(scene, params, tape=tape, **OPTIONS)
        assert any("rendering number 2" in note for note in caught.value.__notes__)
    params.bind(SHEET, wp.array(PLACES * np.float32(400.0), dtype=wp.vec3, device="cpu"))
    with pytest.warns(RuntimeWarning, match="may have been unstable"):
        params.update()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        params.update()
