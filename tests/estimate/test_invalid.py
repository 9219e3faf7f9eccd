"""Samples that are not finite are dropped, counted by kind, reported, and can be drawn again.

One texel of the floor is NaN, written past every check of the library: what meets it is not finite, and nothing else.
"""

import sys
import warnings

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.estimate.boundary.terms import TERMS
from warp_psdr.invalid import KINDS
from warp_psdr.kernels.invalid import finite, inverse_pdf, vanishes

SIZE, SPP = 12, 8
FLOOR = "floor.bsdf.reflectance.data"


def scene_dict(rfilter: str = "box", emission=None, lookup: str = "nearest") -> dict:
    texture = {"type": "bitmap", "bitmap": np.full((4, 4, 3), 0.5, np.float32), "filter_type": lookup}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    if emission is not None:
        texture = {"type": "bitmap", "bitmap": emission, "filter_type": "nearest"}
        floor = {"type": "rectangle", "emitter": {"type": "area", "radiance": texture}}
    look = psdr.Transform.look_at([0.3, 0.2, 3.0], [0.0, 0.0, 0.0], [0, 1, 0])
    lamp = psdr.Transform.look_at([0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0, 1, 0]) @ psdr.Transform.scale(0.1)
    blocker = psdr.Transform.translate([0.4, 0.0, 0.7]) @ psdr.Transform.scale(0.3)
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 40.0,
            "to_world": look,
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}},
        },
        "floor": floor,
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": 5.0 if emission is None else 0.0},
        },
        "blocker": {"type": "rectangle", "to_world": blocker},
    }


def integrator(**options) -> psdr.PathIntegrator:
    return psdr.PathIntegrator(**{"max_depth": 2, "boundary": None, "sampler": "independent", **options})


def broken(rfilter: str = "box", lookup: str = "nearest"):
    """Return a scene with one NaN texel, its row and column."""
    scene = psdr.load_dict(scene_dict(rfilter, lookup=lookup))
    values = scene.values.numpy()
    texel = scene.parameters[FLOOR].offset + 3 * (4 * 1 + 2) + 1
    values[texel] = np.nan
    scene.values.assign(values)
    return scene


def hits() -> np.ndarray:
    """(SIZE, SIZE) how many samples of every pixel meet the texel: it shines in this scene, and nothing else does."""
    emission = np.zeros((4, 4, 3), np.float32)
    emission[1, 2] = 1.0
    scene = psdr.load_dict(scene_dict(emission=emission))
    image = psdr.render(scene, integrator=integrator(max_depth=1), spp=SPP).numpy()[..., 0]
    return np.rint(image * SPP).astype(int)


def test_what_is_not_finite_is_dropped_counted_and_reported() -> None:
    expected = hits()
    assert 0 < expected.sum() < SPP * SIZE * SIZE
    scene = broken()
    with pytest.warns(RuntimeWarning, match=rf"image: {expected.sum()} of {SPP * SIZE**2} .*trace_sample"):
        image = psdr.render(scene, integrator=integrator(), spp=SPP).numpy()
    assert psdr.invalid_samples(scene)["image"] == expected.sum()
    assert sum(psdr.invalid_samples(scene).values()) == expected.sum()
    assert np.isfinite(image).all()
    # Dropped samples count as black; the others are those of the sound scene.
    sound = psdr.render(psdr.load_dict(scene_dict()), integrator=integrator(), spp=SPP).numpy()
    np.testing.assert_array_equal(image[expected == 0], sound[expected == 0])
    assert not image[expected == SPP].any()


def test_a_sound_scene_has_none_and_counts_start_anew() -> None:
    scene = psdr.load_dict(scene_dict())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        psdr.render(scene, integrator=integrator(), spp=1)
    assert set(psdr.invalid_samples(scene).values()) == {0}
    scene = broken()
    for _ in range(2):
        with pytest.warns(RuntimeWarning):
            psdr.render(scene, integrator=integrator(), spp=SPP)
    first = psdr.invalid_samples(scene, reset=True)["image"]
    assert first == 2 * hits().sum()
    assert psdr.invalid_samples(scene)["image"] == 0


@pytest.mark.slow
def test_the_count_does_not_depend_on_the_workers() -> None:
    counts = []
    for n in (1, 2):
        psdr.set_workers(n)
        scene = broken("gaussian")
        with pytest.warns(RuntimeWarning, match="image: "):
            image = psdr.render(scene, integrator=integrator(), spp=SPP).numpy()
        assert np.isfinite(image).all()
        counts.append(psdr.invalid_samples(scene)["image"])
    psdr.set_workers(None)
    assert counts[0] == counts[1] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "interior"),
    [
        pytest.param("reverse", psdr.interior.Replay(), id="reverse-replay"),
        pytest.param("reverse", psdr.interior.Textbook(), id="reverse-textbook", marks=pytest.mark.slow),
        pytest.param("forward", psdr.interior.Replay(), id="forward-replay", marks=pytest.mark.slow),
        pytest.param("forward", psdr.interior.Textbook(), id="forward-textbook", marks=pytest.mark.slow),
    ],
)
def test_the_interior_term(mode: str, interior, monkeypatch) -> None:
    scene = broken()
    params = psdr.traverse(scene)
    options = {"integrator": integrator(interior=interior), "spp": SPP}
    with pytest.warns(RuntimeWarning, match="interior: "):
        if mode == "reverse":
            params.requires_grad(FLOOR)
            psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3)), **options)
            derivative = params[FLOOR].grad.numpy()
        else:
            derivative = psdr.render_forward(scene, params, {FLOOR: 1.0}, **options).numpy()
    assert np.isfinite(derivative).all() and derivative.any()
    monkeypatch.setattr(sys.modules["warp_psdr.estimate.calls"], "STREAM_PRIMAL", 1)  # the random numbers of gradients
    assert psdr.invalid_samples(scene)["interior"] == hits().sum()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_the_boundary_term_and_its_guiding(mode: str) -> None:
    scene = broken(lookup="bilinear")
    params = psdr.traverse(scene)
    name = "blocker.to_world"
    boundary = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())
    options = {"integrator": integrator(boundary=boundary), "spp": SPP}
    with pytest.warns(RuntimeWarning, match="secondary: .* guiding: "):
        if mode == "reverse":
            params.requires_grad(name)
            psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3)), **options)
            derivative = params[name].grad.numpy()
        else:
            tangent = np.zeros((4, 4), np.float32)
            tangent[0, 3] = 1.0
            derivative = psdr.render_forward(scene, params, {name: tangent}, **options).numpy()
    assert np.isfinite(derivative).all() and derivative.any()
    counts = psdr.invalid_samples(scene)
    assert all(counts[kind] > 0 for kind in ("primary", "secondary", "guiding"))


@pytest.mark.slow_rows("box-interior", "gaussian-image")
@pytest.mark.parametrize(("rfilter", "kind"), [("box", "image"), ("gaussian", "image"), ("box", "interior")])
def test_the_path_of_the_first_can_be_drawn_again(rfilter: str, kind: str) -> None:
    scene = broken(rfilter)
    options = {"integrator": integrator(), "seed": 5}
    with pytest.warns(RuntimeWarning, match=r"seed=5, kind='" + kind):
        if kind == "image":
            psdr.render(scene, spp=SPP, **options)
        else:
            params = psdr.traverse(scene)
            params.requires_grad(FLOOR)
            psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3)), spp=SPP, **options)
    x, y, index = scene.invalid.counts[kind].first
    trace = psdr.trace_sample(scene, pixel=(x, y), sample=index, kind=kind, **options)
    assert np.isnan(trace.radiance).any()
    first = trace.vertices[0]
    assert (first.shape, first.bsdf) == ("floor", "diffuse")
    # The texel in column 2 and row 1 of the floor, which spans [-1, 1]^2.
    assert 0.0 < first.position[0] < 0.5 and abs(first.position[2]) < 1e-6
    assert "floor (diffuse)" in str(trace) and "nan" in str(trace)
    sound = psdr.trace_sample(psdr.load_dict(scene_dict(rfilter)), pixel=(x, y), sample=index, kind=kind, **options)
    np.testing.assert_array_equal(sound.vertices[0].position, first.position)
    assert np.isfinite(sound.radiance).all()


def test_a_trace_adds_up_to_its_pixel() -> None:
    scene = psdr.load_dict(scene_dict())
    path = integrator(max_depth=4)
    image = psdr.render(scene, integrator=path, spp=3, seed=2).numpy()
    traces = [psdr.trace_sample(scene, pixel=(7, 4), sample=i, seed=2, integrator=path).radiance for i in range(3)]
    np.testing.assert_allclose(image[4, 7], np.mean(traces, axis=0), rtol=1e-6)


def test_traces_that_do_not_exist_are_refused() -> None:
    scene = psdr.load_dict(scene_dict())
    with pytest.raises(ValueError, match="kind"):
        psdr.trace_sample(scene, pixel=(0, 0), sample=0, kind="tertiary")
    with pytest.raises(ValueError, match="pixel"):
        psdr.trace_sample(scene, pixel=(SIZE, 0), sample=0)


def test_an_adjoint_that_is_not_finite_is_refused_and_not_dropped() -> None:
    scene = psdr.load_dict(scene_dict())
    params = psdr.traverse(scene)
    params.requires_grad(FLOOR)
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    adjoint[3, 4, 1] = np.nan
    for value in (adjoint, wp.array(adjoint, dtype=wp.vec3)):
        with pytest.raises(ValueError, match="adjoint: holds NaN"):
            psdr.render_backward(scene, params, value, integrator=integrator(), spp=1)


@pytest.mark.slow
def test_a_light_without_a_brightness_is_counted_although_nothing_else_sees_it() -> None:
    # All channels are NaN: `max(value) > 0` is false for it, as for a light that is off.
    lamp = {"type": "point", "position": [0.0, 0.0, 1.5], "intensity": 1.0}
    dictionary = {**scene_dict(), "lamp": lamp}
    path = integrator()
    lit = (psdr.render(psdr.load_dict(dictionary), integrator=path, spp=1).numpy() > 0.0).all(axis=2)
    scene = psdr.load_dict(dictionary)
    values = scene.values.numpy()
    first = scene.parameters["lamp.intensity.value"].offset
    values[first : first + 3] = np.nan
    scene.values.assign(values)
    with pytest.warns(RuntimeWarning, match="image: "):
        image = psdr.render(scene, integrator=path, spp=1).numpy()
    assert 0 < lit.sum() < SIZE**2 and not image.any()
    assert psdr.invalid_samples(scene)["image"] == lit.sum()
    params = psdr.traverse(scene)
    params.requires_grad(FLOOR)
    with pytest.warns(RuntimeWarning, match="interior: "):
        psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3)), integrator=path, spp=1)
    assert np.isfinite(params[FLOOR].grad.numpy()).all()


@wp.kernel(module="unique", enable_backward=False)
def try_values(x: wp.array(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    i = wp.tid()
    v = wp.vec3(0.0, x[i], 0.0)
    out[i, 0] = wp.where(finite(v), 1.0, 0.0)
    out[i, 1] = wp.where(vanishes(v), 1.0, 0.0)
    out[i, 2] = inverse_pdf(x[i])


def test_what_counts_as_finite_and_as_nothing() -> None:
    x = np.array([0.0, 2.0, -1.0, 1e-37, np.inf, np.nan], np.float32)
    out = wp.empty((len(x), 3), dtype=wp.float32, device="cpu")
    wp.launch(try_values, len(x), [wp.array(x, device="cpu")], [out], device="cpu")
    is_finite, is_nothing, inverse = out.numpy().T
    np.testing.assert_array_equal(is_finite, [1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(is_nothing, [1, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(inverse[1:4], [0.5, -1.0, 1e37], rtol=1e-6)
    assert np.isnan(inverse[4:]).all()


def test_every_boundary_term_has_a_kind_and_counts() -> None:
    names = {term.name for method in TERMS.values() for term in method}
    assert names | {"image", "interior", "guiding", "light"} == set(KINDS)
