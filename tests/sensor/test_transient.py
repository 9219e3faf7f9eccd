"""Images of transient films: closed forms, a histogram of traced paths, the steady image, and what is refused."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.sensor import timed

DIRECT = psdr.PathIntegrator(max_depth=2, boundary=None)
ROOM = psdr.PathIntegrator(max_depth=3, boundary=None)
#: Roundings of float32 lengths over the width of a bin, and of sums in another order.
ROUNDING = 2e-5


def trapezoid(length, low, high, pulse):
    """Share of a box pulse between two times, float64."""

    def passed(x):
        return np.clip(x / pulse + 0.5, 0.0, 1.0)

    return passed(high - length) - passed(low - length)


#: Films of one bin, and the share of light that their gate lets pass at a path length.
BOX = (timed.GATE, lambda x: trapezoid(x, 2.02, 2.10, 0.03))
GAUSSIAN = (
    {
        "temporal_bins": 1,
        "bin_width_opl": 0.002,
        "start_opl": 2.059,
        "pulse": "gaussian",
        "pulse_stddev_opl": 0.02,
    },
    lambda x: 0.002 / (0.02 * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((x - 2.06) / 0.02) ** 2),
)


def seen_plane(gate, height=1.0, count=1001):
    """Radiance of ``timed.plane`` through a gate, the mean over the film, by quadrature; and its derivative."""
    g = np.linspace(-0.3, 0.3, count)
    g = 0.5 * (g[1:] + g[:-1])
    u, v = np.meshgrid(g, g)

    def at(h):
        t = h * np.sqrt(1.0 + u * u + v * v)
        return (0.8 / np.pi * (h / t) / t**2 * gate(2.0 * t)).mean()

    return at(height), (at(height + 1e-4) - at(height - 1e-4)) / 2e-4


@pytest.mark.parametrize(
    ("film", "gate"),
    [
        pytest.param(*BOX, id="box"),
        pytest.param(
            *GAUSSIAN,
            id="gaussian",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"temporal_bins": 1, "bin_width_opl": 0.08, "start_opl": 2.02, "pulse_width_opl": 0.0},
            lambda x: ((x >= 2.02) & (x < 2.10)).astype(float),
            id="none",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_plane_has_its_closed_form(film, gate) -> None:
    found = [psdr.render(timed.plane(**film), integrator=DIRECT, spp=256, seed=s).numpy().mean() for s in range(6)]
    expected, _slope = seen_plane(gate)
    assert abs(np.mean(found) - expected) < 4.0 * np.std(found, ddof=1) / np.sqrt(6) + 1e-4 * expected


@pytest.mark.slow
def test_the_bins_add_up_to_the_steady_image() -> None:
    image = psdr.render(timed.room(**timed.ROOM_BINS), integrator=ROOM, spp=32)
    assert image.shape == (timed.SIZE, timed.SIZE, 40) and image.dtype is wp.vec3
    steady = psdr.render(timed.room(), integrator=ROOM, spp=32).numpy()
    np.testing.assert_allclose(image.numpy().sum(axis=2), steady, rtol=ROUNDING)
    assert (image.numpy().sum(axis=(0, 1, 3)) > 0.0).sum() > 10  # not all in a few bins


@pytest.mark.slow
def test_every_bin_is_what_traced_paths_leave_in_it() -> None:
    film = {**timed.ROOM_BINS, "pulse_width_opl": 0.3}
    scene, lamp, spp = timed.room(size=2, **film), np.array([0.3, 0.5, 0.2]), 16
    image = psdr.render(scene, integrator=ROOM, spp=spp, seed=3).numpy()
    expected = np.zeros(image.shape)
    edges = 0.25 * np.arange(41)
    for y in range(2):
        for x in range(2):
            for n in range(spp):
                path = psdr.trace_sample(scene, sample=n, pixel=(x, y), seed=3, integrator=ROOM)
                before, length = np.array([0.1, 0.0, 0.7]), 0.0
                for vertex in path.vertices:
                    length += np.linalg.norm(vertex.position - before)
                    before = vertex.position
                    share = trapezoid(length + np.linalg.norm(lamp - before), edges[:-1], edges[1:], 0.3)
                    expected[y, x] += share[:, None] * (vertex.throughput * vertex.direct / spp)
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5 * image.max())


@pytest.mark.slow
def test_camera_unwarp_leaves_out_the_way_to_the_first_surface() -> None:
    """At depth 1 the camera sees a lamp, whose light is then there at once."""
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 2.0}}
    film = {"temporal_bins": 10, "bin_width_opl": 0.5, "pulse_width_opl": 0.1, "start_opl": -0.25}
    integrator = psdr.PathIntegrator(max_depth=1)
    for unwarp, bins in ((False, {6}), (True, {0})):
        view = timed.camera((0, 0, 3), (0, 0, 0), 5.0, camera_unwarp=unwarp, **film)
        image = psdr.render(
            psdr.load_dict({"type": "scene", "camera": view, "lamp": lamp}), integrator=integrator, spp=4
        )
        assert set(np.flatnonzero(image.numpy().sum(axis=(0, 1, 3)))) == bins


@pytest.mark.slow
def test_glass_delays_light_by_its_index_of_refraction() -> None:
    """Straight through a slab 1 thick of index 1.5, light from a lamp behind it is late by 0.5, whatever reflects in
    it later still."""
    film = {"temporal_bins": 40, "bin_width_opl": 0.1, "start_opl": 3.0, "pulse_width_opl": 0.01}
    slab = {
        "type": "cube",
        "to_world": psdr.Transform.scale((2, 2, 0.5)),
        "bsdf": {"type": "dielectric", "int_ior": 1.5},
    }
    lamp = {"type": "rectangle", "to_world": psdr.Transform.translate((0, 0, -1.02)), "emitter": {"type": "area"}}
    view = timed.camera((0, 0, 2.02), (0, 0, 0), 0.5, **film)
    scene = psdr.load_dict({"type": "scene", "camera": view, "slab": slab, "lamp": lamp})
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=6), spp=64).numpy().sum(axis=(0, 1, 3))
    # 1.52 + 1.5 + 0.52 = 3.54, and with two reflections inside 3 more; the lamp scatters nothing.
    assert set(np.flatnonzero(image)) == {5, 35}
    inside = ((1.5 - 1.0) / (1.5 + 1.0)) ** 2
    assert image[35] / image[5] == pytest.approx(inside**2, rel=0.5)


def test_losses_take_transient_images_and_pictures_take_bins(tmp_path) -> None:
    image = wp.array(np.random.default_rng(0).random((2, 3, 4, 3), np.float32), dtype=wp.vec3, requires_grad=True)
    target = np.zeros((2, 3, 4, 3), np.float32)
    with wp.Tape() as tape:
        loss = psdr.losses.l2(image, target)
    tape.backward(loss)
    assert loss.numpy()[0] == pytest.approx((image.numpy() ** 2).mean(), rel=1e-5)
    np.testing.assert_allclose(image.grad.numpy(), 2.0 * image.numpy() / image.numpy().size, rtol=1e-5)
    psdr.write_image(tmp_path / "bin.exr", image.numpy()[:, :, 1])
    with pytest.raises(ValueError, match="give one bin"):
        psdr.write_image(tmp_path / "bin.exr", image)


@pytest.mark.parametrize(
    ("film", "match"),
    [
        ({"temporal_bins": 0}, "at least 1"),
        ({"temporal_bins": 4, "bin_width_opl": 0.0}, "bin_width_opl"),
        ({"temporal_bins": 4, "pulse": "sine"}, "box, gaussian"),
        ({"temporal_bins": 4, "pulse": "gaussian", "pulse_width_opl": 0.1}, "give 'pulse_stddev_opl' instead"),
        ({"temporal_bins": 1 << 26}, "altogether"),
    ],
)
def test_films_out_of_range_are_refused(film, match) -> None:
    with pytest.raises(ValueError, match=match):
        timed.plane(**film)


def test_batches_and_meters_take_no_transient_film() -> None:
    film = {"type": "transient_hdr_film", "width": 2, "height": 1, "temporal_bins": 2}
    pair = {"type": "batch", "film": film, "a": {"type": "perspective"}, "b": {"type": "perspective"}}
    with pytest.raises(ValueError, match="in a 'batch'"):
        psdr.load_dict({"type": "scene", "rig": pair})
    with pytest.raises(ValueError, match="of a 'radiancemeter'"):
        psdr.load_dict({"type": "scene", "probe": {"type": "radiancemeter", "film": {**film, "width": 1}}})


def test_what_has_no_path_length_is_refused() -> None:
    with pytest.raises(ValueError, match="comes from infinity"):
        psdr.plan(timed.room({"type": "constant"}, **timed.ROOM_BINS))
    glass = {"type": "rectangle", "bsdf": {"type": "roughdielectric"}}
    view = timed.camera((0, 0, 3), (0, 0, 0), 40.0, **timed.ROOM_BINS)
    with pytest.raises(ValueError, match="surface of a 'roughdielectric' are not known"):
        psdr.plan(psdr.load_dict({"type": "scene", "camera": view, "lamp": {"type": "point"}, "a": glass}))
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    with pytest.raises(ValueError, match="participating media are not known together"):
        psdr.plan(psdr.load_dict({"type": "scene", "camera": view, "lamp": {"type": "point"}, "a": fog}))
    with pytest.raises(ValueError, match="does not know the time bins"):
        psdr.plan(timed.room(**timed.ROOM_BINS), integrator=psdr.PathIntegrator(interior=psdr.interior.LightTracing()))


def test_what_does_not_take_bins_says_so() -> None:
    scene = timed.room(**timed.ROOM_BINS)
    params = psdr.traverse(scene)
    with pytest.raises(ValueError, match="transient_hdr_film"):
        psdr.render(scene, time_budget=1.0)
    with pytest.raises(ValueError, match="render_moment does not take"):
        psdr.render_moment(scene, spp=1)
    with pytest.raises(ValueError, match="render_parts does not take"):
        psdr.render_parts(scene, params, {"lamp.position": 1.0}, spp=1)
    with pytest.raises(ValueError, match=r"expected the image's \(6, 6, 40, 3\)"):
        params.requires_grad("lamp.intensity.value")
        psdr.render_backward(scene, params, np.ones((6, 6, 3)), spp=1)


def test_the_plan_names_the_bins() -> None:
    lines = {line[0]: line for line in psdr.plan(timed.room(**timed.ROOM_BINS)).lines}
    assert lines["film"][1] == "40 bins of 0.25" and "box pulse of 0.25" in lines["film"][2]
