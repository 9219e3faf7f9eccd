"""Paths that are traced side by side: the bits of single ones, and loops that the compiler turns into SIMD."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import scenes
from warp_psdr.kernels import primal, splat
from warp_psdr.kernels.interior import forward, replay
from warp_psdr.kernels.lanes.lanes import QUEUE_ROOM, ROOM, make_number, make_record, stack_rows, words
from warp_psdr.kernels.lanes.path_lanes import LaneSample, make_lane_paths, side_by_side
from warp_psdr.kernels.lanes.waiting_lanes import Staying, make_queue
from warp_psdr.kernels.scattering import ScatterSample
from warp_psdr.scene import acceleration

ROOT = Path(__file__).resolve().parents[2]
BOX = ROOT / "scenes" / "cornell_box.xml"
KERNELS = (
    primal.make_image_paths,
    primal.make_primal_kernel,
    splat.make_splat_kernel,
    replay.make_replay_kernel,
    forward.make_forward_kernel,
)
#: What float32 sums in another order differ by, relative to the largest entry of a gradient.
SUMMED = 1.0e-5
#: Share of the largest gradient below which a gradient may be rounding.
CANCELLED = 1.0e-3


def forget_kernels():
    for make in KERNELS:
        make.cache_clear()


@pytest.fixture
def alone(monkeypatch):
    """Return a function after whose call every path is traced by itself."""

    def switch():
        for module in (primal, replay, forward):
            monkeypatch.setattr(module, "side_by_side", lambda config: False)
        forget_kernels()

    yield switch
    monkeypatch.undo()
    forget_kernels()


def with_sensor(scene, **changes):
    return {"type": "scene", **scene, "sensor": {**scene["sensor"], **changes}}


def hidden_light():
    scene = scenes.gap_scene()
    return {"type": "scene", "integrator": {"type": "path", "hide_emitters": True}, **scene}


def blurred():
    return with_sensor(scenes.plane_scene(), type="thinlens", aperture_radius=0.1, focus_distance=2.0)


def distorted():
    return with_sensor(scenes.plane_scene(), k1=-0.1, p1=0.02, skew=0.1)


def wide_filter():
    scene = scenes.gap_scene()
    film = {**scene["sensor"]["film"], "rfilter": {"type": "gaussian"}}
    return with_sensor(scene, film=film)


def sky_and_lamps():
    """A sky, a lamp of many triangles, and one of two; few enough triangles for rays in rows."""
    square = {"type": "rectangle", "emitter": {"type": "area", "radiance": scenes.rgb(3.0, 2.0, 1.0)}}
    down = psdr.Transform.look_at([0.8, 0.2, 0.9], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]) @ psdr.Transform.scale(0.1)
    cube = {"type": "cube", "emitter": {"type": "area", "radiance": scenes.rgb(0.5, 1.0, 0.7)}}
    aside = psdr.Transform.translate([-0.6, 0.2, 0.3]) @ psdr.Transform.scale(0.1)
    return {
        "type": "scene",
        "sensor": scenes.gap_scene()["sensor"],
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": scenes.rgb(0.6, 0.7, 0.5)}},
        "lamp": {**square, "to_world": down},
        "cube": {**cube, "to_world": aside},
        "sky": {"type": "constant", "radiance": scenes.rgb(0.2, 0.3, 0.4)},
    }


def sky_map_and_models():
    """An image sky with a small sun beside a lamp, and spheres of metal, glass, a mirror and coats on a floor."""
    texels = np.random.default_rng(3).random((5, 8, 3)).astype(np.float32)
    texels[1, 2] = 20.0
    models = {
        "gold": {"type": "roughconductor", "material": "Au", "distribution": "ggx", "alpha": 0.2},
        "rough": {"type": "roughconductor", "material": "Cu", "alpha_u": 0.3, "alpha_v": 0.1},
        "glass": {"type": "dielectric"},
        "mirror": {"type": "conductor", "material": "Ag"},
        "coat": {"type": "plastic"},
        "rough coat": {"type": "roughplastic"},
    }
    balls = {
        name: {"type": "sphere", "center": [0.4 * i - 0.8, 0.0, 0.15], "radius": 0.15, "resolution": 8, "bsdf": bsdf}
        for i, (name, bsdf) in enumerate(models.items())
    }
    base = sky_and_lamps()
    return {
        **{name: base[name] for name in ("type", "sensor", "floor", "lamp")},
        **balls,
        "sky": {"type": "envmap", "bitmap": texels},
    }


def coats():
    """A floor with a rough coat under a map of normals, and a ball with a smooth one: models that do not branch."""
    normals = np.random.default_rng(4).random((6, 4, 3)).astype(np.float32)
    normals[..., 2] = 1.0
    waves = {"type": "normalmap", "normalmap": {"type": "bitmap", "data": normals, "raw": True}}
    base = sky_map_and_models()
    return {
        **{name: base[name] for name in ("type", "sensor", "lamp", "sky")},
        "floor": {"type": "rectangle", "bsdf": {**waves, "bsdf": {"type": "roughplastic", "nonlinear": True}}},
        "ball": {"type": "sphere", "center": [0.0, 0.0, 0.2], "radius": 0.2, "bsdf": {"type": "plastic"}},
    }


def exact_shapes():
    """An exact ball, disk and tube on a floor, two of which shine and are hidden from the camera."""
    base = sky_and_lamps()
    lamp = {"type": "area", "radiance": scenes.rgb(2.0, 3.0, 1.0)}
    texels = np.random.default_rng(5).random((4, 6, 3)).astype(np.float32)
    wheel = psdr.Transform.look_at([-0.3, 0.5, 0.6], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]) @ psdr.Transform.scale(0.2)
    return {
        **{name: base[name] for name in ("type", "sensor", "floor", "lamp", "sky")},
        "integrator": {"type": "path", "hide_emitters": True},
        "ball": {
            "type": "sphere",
            "exact": True,
            "center": [0.0, 0.0, 0.2],
            "radius": 0.2,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "data": texels}},
            "emitter": lamp,
        },
        "disk": {"type": "disk", "exact": True, "to_world": wheel, "emitter": lamp},
        "tube": {"type": "cylinder", "exact": True, "p0": [0.5, 0.3, 0.1], "p1": [0.3, -0.4, 0.3], "radius": 0.1},
    }


def grid_and_curves():
    """A grid, curves and an exact ball, without a mesh."""
    at = np.linspace(-1.0, 1.0, 6, dtype=np.float32)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    points = np.random.default_rng(6).uniform(-0.5, 0.5, (6, 4)).astype(np.float32)
    points[:, 2:] = 0.3, 0.05
    corner = psdr.Transform.translate([-0.4, -0.4, -0.2]) @ psdr.Transform.scale(0.8)
    base = sky_and_lamps()
    return {
        **{name: base[name] for name in ("type", "sensor", "sky")},
        "body": {"type": "sdfgrid", "grid": np.sqrt(x * x + y * y + z * z) - 0.7, "to_world": corner},
        "hair": {"type": "bsplinecurve", "control_points": points},
        "ball": {"type": "sphere", "exact": True, "center": [0.4, 0.4, 0.2], "radius": 0.2},
    }


def principled_and_leaves():
    """A leaf of a hundred holes above principled, rough glass, a blend and a smooth mirror: shadow rays pass it."""
    holes = np.random.default_rng(6).random((10, 10)).astype(np.float32).round()
    opacity = {"type": "bitmap", "data": holes[..., None], "raw": True, "filter_type": "nearest"}
    gold = {"type": "roughconductor", "material": "Au"}
    above = psdr.Transform.translate([0.0, 0.0, 0.6]) @ psdr.Transform.scale(0.6)
    models = {
        "car": {"type": "principled", "metallic": 0.4, "roughness": 0.3, "clearcoat": 0.7, "anisotropic": 0.5},
        "frost": {"type": "roughdielectric", "alpha": 0.2},
        "blend": {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": gold},
        "mirror": {"type": "conductor", "material": "Ag"},
    }
    base = sky_map_and_models()
    balls = {
        name: {"type": "sphere", "center": [0.4 * i - 0.6, 0.0, 0.15], "radius": 0.15, "resolution": 8, "bsdf": bsdf}
        for i, (name, bsdf) in enumerate(models.items())
    }
    leaf = {"type": "mask", "opacity": opacity, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    return {
        **{name: base[name] for name in ("type", "sensor", "floor", "lamp", "sky")},
        **balls,
        "leaf": {"type": "rectangle", "to_world": above, "bsdf": leaf},
    }


SCENES = {
    "exact ball and disk that shine hidden, tube": exact_shapes,
    "grid, curve and ball, no mesh": grid_and_curves,
    "principled, rough glass, blend and mirror under a leaf": principled_and_leaves,
    "smooth coat, rough coat under a map of normals": coats,
    "image sky, lamp, metal, glass, mirror and coat": sky_map_and_models,
    "sky and two lamps": sky_and_lamps,
    "area light, two-sided, textured by vertices": lambda: {"type": "scene", **scenes.gap_scene()},
    "sky, point, spot and sun, a bitmap": lambda: {"type": "scene", **scenes.plane_scene()},
    "constant sky, textured by faces": lambda: {"type": "scene", **scenes.dome_scene()},
    "hidden light": hidden_light,
    "thin lens": blurred,
    "distortion": distorted,
    "gaussian filter": wide_filter,
}
#: Scene, parameters and samples of the row that is not slow.
QUICK = ("sky and two lamps", "values", 3)


def images_and_gradients(scene, spp, sampler, depth, names):
    """Return the image, the gradient of a weighted image by the parameters, and a derivative image along them all."""
    integrator = psdr.PathIntegrator(max_depth=depth, rr_depth=3, sampler=sampler, boundary=None)
    image = psdr.render(scene, integrator=integrator, spp=spp, seed=5).numpy()
    params = psdr.traverse(scene)
    params.requires_grad(*names)
    adjoint = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    adjoint[::3, 1::2] = 0.0  # pixels without a weight are left out
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=6)
    gradients = {name: params[name].grad.numpy().copy() for name in names}
    tangents = {name: np.cos(np.arange(g.size, dtype=np.float32)).reshape(g.shape) for name, g in gradients.items()}
    derivative = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=6).numpy()
    return image, gradients, derivative


def cases():
    """Every scene with few samples, some and more than there are lanes; one is quick: each compiles four kernels."""
    for name, what in itertools.product(SCENES, ("values", "all")):
        for spp, sampler in ((1, "independent"), (3, "sobol"), (19, "independent")):
            marks = () if (name, what, spp) == QUICK else pytest.mark.slow
            yield pytest.param(name, spp, sampler, what, marks=marks, id=f"{name}-{spp}-{what}")


@pytest.mark.parametrize(("name", "spp", "sampler", "what"), list(cases()))
def test_paths_have_the_bits_of_single_ones(name, spp, sampler, what, alone):
    """Images have; gradients but for sums, and for the light of a vertex, which lanes keep and others look up again."""
    scene = psdr.load_dict(SCENES[name]())
    assert side_by_side(psdr.plan(scene).config)
    names = [name for name in scene.parameters if what == "all" or name.endswith((".data", ".value", "color"))]
    image, gradients, derivative = images_and_gradients(scene, spp, sampler, 4, names)
    alone()
    single, singles, alone_derivative = images_and_gradients(scene, spp, sampler, 4, names)
    assert image.mean() > 1.0e-3
    np.testing.assert_array_equal(image, single)
    assert derivative.any()
    np.testing.assert_allclose(derivative, alone_derivative, rtol=0.0, atol=SUMMED * np.abs(alone_derivative).max())
    largest = max(np.abs(single).max() for single in singles.values())
    for key, gradient in gradients.items():
        assert np.isfinite(gradient).all()
        # What cancels, texture coordinates that turn frames of isotropic models for example, is rounding alone.
        tolerance = SUMMED * max(np.abs(singles[key]).max(), CANCELLED * largest)
        np.testing.assert_allclose(gradient, singles[key], rtol=0.0, atol=tolerance)
    moved = [g for key, g in gradients.items() if key.endswith(("positions", "to_world"))]
    for of_kind in [list(gradients.values())] + [moved] * (what == "all"):
        assert any(np.abs(gradient).max() > 0.0 for gradient in of_kind)


@pytest.mark.slow
def test_numbers_of_materials_are_differentiated_side_by_side(alone):
    """Adjoints of all models over all lanes, those of delta lobes lane by lane, against single paths; in both modes."""
    base = sky_and_lamps()
    number = {"metallic": 0.4, "roughness": 0.3, "clearcoat": 0.7, "anisotropic": 0.5, "sheen": 0.2}
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.2], "radius": 0.2, "resolution": 8, "bsdf": {"type": "plastic"}}
    paint = {"type": "principled", "base_color": scenes.rgb(0.7, 0.4, 0.2), **number}
    floor = {"type": "rectangle", "bsdf": paint}
    others = {
        "glossy": {"type": "ashikhminshirley"},
        "frost": {"type": "roughdielectric", "alpha": 0.2},
        "grooves": {"type": "orennayar", "sigma": 0.4},
        "waves": coats()["floor"]["bsdf"],
    }
    balls = {
        name: {**ball, "center": [0.4 * i - 0.6, 0.5, 0.2], "bsdf": bsdf}
        for i, (name, bsdf) in enumerate(others.items())
    }
    shown = {"floor": floor, "ball": ball, **balls}
    scene = psdr.load_dict({**{name: base[name] for name in ("type", "sensor", "lamp")}, **shown})
    params = psdr.traverse(scene)
    names = [n for n in scene.parameters if n.split(".")[0] in shown and ".bsdf." in n and not n.endswith("to_uv")]
    params.requires_grad(*names)
    film = scenes.gap_scene()["sensor"]["film"]
    adjoint = np.random.default_rng(1).normal(size=(film["height"], film["width"], 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=4, sampler="independent", boundary=None)
    found = []
    for switch in (lambda: None, alone):
        switch()
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=5, seed=6)
        found.append({name: params[name].grad.numpy().copy() for name in names})
        for name in names:
            along = dict.fromkeys(names, 0.0) | {name: 1.0}  # of all: one kernel
            image = psdr.render_forward(scene, params, along, integrator=integrator, spp=5, seed=6)
            found[-1][f"along {name}"] = image.numpy()
    for name in found[0]:
        together, single = found[0][name], found[1][name]
        assert np.abs(single).max() > 0.0, name
        np.testing.assert_allclose(together, single, rtol=0.0, atol=SUMMED * np.abs(single).max())


@pytest.mark.slow
def test_contacts_are_weighed_side_by_side(alone):
    """Boxes that stand on a floor: connections along contacts are looked at one by one."""
    scene = psdr.load_file(BOX, resolution=16)
    names = [name for name in scene.parameters if name.endswith("vertex_positions")]
    ratio = scene.contact_ratio
    gradients = []
    for weighed in (ratio, 0.0):
        scene.contact_ratio = weighed
        gradients.append(images_and_gradients(scene, 8, "independent", 6, names)[1])
    scene.contact_ratio = ratio
    alone()
    singles = images_and_gradients(scene, 8, "independent", 6, names)[1]
    for key, single in singles.items():
        np.testing.assert_allclose(gradients[0][key], single, rtol=0.0, atol=SUMMED * np.abs(single).max())
    assert any(np.abs(gradients[1][key] - single).max() > 0.01 for key, single in singles.items())


@pytest.mark.slow
@pytest.mark.parametrize("width", [pytest.param(4, marks=pytest.mark.slow), 16])
def test_other_widths_have_the_same_bits(width, monkeypatch):
    images = []
    for lanes in (acceleration.host_width(), width):
        monkeypatch.setattr(acceleration, "host_width", lambda lanes=lanes: lanes)
        scene = psdr.load_file(BOX, resolution=24)
        assert psdr.plan(scene).config.rays.width == lanes
        images.append(psdr.render(scene, spp=5, seed=2).numpy())
    np.testing.assert_allclose(images[0], images[1], rtol=0, atol=1.0e-6 * images[0].mean())


@pytest.mark.slow
def test_lanes_without_a_vertex_read_no_table():
    """What rows hold of lanes whose ray meets nothing is anything, addresses of tables among it."""
    coat = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.2}
    down = psdr.Transform.translate([0.0, -2.0, 4.0]) @ psdr.Transform.rotate([1, 0, 0], 180.0)
    lamp = {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": scenes.rgb(9.0, 9.0, 9.0)}}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": scenes.camera([0.0, -8.0, 1.0], [0.0, 0.0, 0.0], size=8),
            "ball": {"type": "sphere", "bsdf": coat},
            "lamp": lamp,
        }
    )
    images = []
    for word in (0, 0x3F4CCCCD, 0xFFFFFFFF):  # 0, 0.8 and NaN; no address
        scene._rows.fill_(word)
        images.append(psdr.render(scene, spp=16, seed=1).numpy())
    assert (images[0] == images[1]).all() and (images[0] == images[2]).all() and images[0].max() > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ceiling.bsdf.reflectance.value", "ceiling.vertex_positions"])
def test_paths_whose_vertices_have_no_room_are_traced_alone(name):
    """Of vertices that move more is kept: for some numbers of them, paths are traced together but swept alone."""
    scene = psdr.load_dict({"type": "scene", **scenes.gap_scene()})
    config = psdr.plan(scene).config
    whole = [make_lane_paths(config, True, True, kept=kept, whole=True).end for kept in (8, 16)]
    alone = [make_lane_paths(config, True, True, kept=kept).end for kept in (16, 40)]
    assert max(whole[0], alone[0]) < ROOM < min(whole[1], alone[1])
    params = psdr.traverse(scene)
    params.requires_grad(name)
    adjoint = np.ones(psdr.render(scene, spp=1).numpy().shape, np.float32)
    for depth, block in ((40, 40), (16, 16)):
        gradients = []
        for kept in (block, 8):
            integrator = psdr.PathIntegrator(max_depth=depth, boundary=None, interior=psdr.interior.Replay(block=kept))
            params[name].grad.zero_()
            psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=4)
            gradients.append(params[name].grad.numpy().copy())
        assert np.abs(gradients[0]).max() > 0.0
        np.testing.assert_array_equal(*gradients)


@pytest.mark.slow_rows("4", "16")
@pytest.mark.parametrize("width", [4, 8, 16])
def test_records_come_back_from_their_rows(width):
    get, put = make_record(ScatterSample, width)
    get_number, put_number = make_number(width)
    get_aside, put_aside = make_record(ScatterSample, width, aside=True)
    count = words(ScatterSample)
    size = (2 * count + 1) * width

    @wp.kernel(module="unique", enable_backward=False)
    def there_and_back(
        values: wp.array(dtype=ScatterSample), out: wp.array(dtype=ScatterSample), numbers: wp.array(dtype=float)
    ):
        rows = wp.zeros(shape=(wp.static(size),), dtype=wp.uint32)
        for j in range(wp.static(width)):
            put(rows, 1, j, values[j])
            put_number(rows, 0, j, 0.125 * wp.float32(j))
        for j in range(wp.static(width)):
            put_aside(rows, wp.static(1 + count), j, get(rows, 1, j, ScatterSample()))
        for j in range(wp.static(width)):
            out[j] = get_aside(rows, wp.static(1 + count), j, ScatterSample())
            numbers[j] = get_number(rows, 0, j)

    rng = np.random.default_rng(2)
    raw = rng.integers(-(2**31), 2**31, size=(width, count)).astype(np.int32)
    values = wp.array(raw.view(ScatterSample.numpy_dtype()).reshape(width), dtype=ScatterSample, device="cpu")
    out = wp.zeros(width, dtype=ScatterSample, device="cpu")
    numbers = wp.zeros(width, dtype=float, device="cpu")
    wp.launch(there_and_back, 1, [values], [out, numbers], device="cpu")
    np.testing.assert_array_equal(out.numpy().view(np.int32).reshape(width, count), raw)
    np.testing.assert_array_equal(numbers.numpy(), 0.125 * np.arange(width))


@pytest.mark.parametrize("width", [4, 8, 16])
def test_paths_wait_in_their_order(width):
    """A queue that is emptied as it is filled, each time by every other path."""
    waits, aside, samples = stack_rows(width, 0, Staying, Staying, LaneSample)
    queue = make_queue(width, (waits, samples))

    @wp.func
    def put_path(rows: wp.array(dtype=wp.uint32), j: wp.int32, number: wp.int32):
        sample = LaneSample()
        sample.number = number
        waits.put(rows, j, Staying(1))
        samples.put(rows, j, sample)

    @wp.kernel(module="unique", enable_backward=False)
    def halve(rows: wp.array(dtype=wp.uint32), out: wp.array(dtype=int)):
        length = wp.int32(0)
        while length < wp.static(queue.room):
            for j in range(wp.static(width)):
                put_path(rows, j, length + j)
            length = queue.append(rows, 0, length)
        rounds = wp.int32(0)
        while rounds < 2:
            front = wp.int32(0)
            left = wp.int32(0)
            while front < length:
                queue.take(rows, front)
                for j in range(wp.static(width)):
                    keeps = wp.where(front + j < length, (front + j + 1) % 2, 0)
                    aside.put(rows, j, Staying(keeps))
                left = queue.append(rows, 1, left)
                front += width
            length = left
            rounds += 1
        for i in range(length):
            if i % width == 0:
                queue.take(rows, i)
            out[i] = samples.get(rows, i % width).number

    rows = wp.empty((ROOM + QUEUE_ROOM) * width, dtype=wp.uint32, device="cpu")
    out = wp.full(queue.room, -1, dtype=int, device="cpu")
    wp.launch(halve, 1, [rows], [out], device="cpu")
    kept = np.arange(0, queue.room, 4)
    np.testing.assert_array_equal(out.numpy()[: len(kept)], kept)
    assert (out.numpy()[len(kept) :] == -1).all() and queue.room % width == 0 and queue.room > 8 * width
