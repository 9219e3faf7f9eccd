"""Record and sweep: equal to textbook replay and to the taped oracle, for any K and depth, in constant memory."""

import resource
from types import SimpleNamespace

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import scenes, tape_oracle
from tests.gradients.measure import NO_ROULETTE, integrator
from warp_psdr.estimate.passes import STREAM_INTERIOR
from warp_psdr.kernels.rng import mix_seed

#: The same terms, recomputed from the same random numbers: float32 rounding of sums in another order.
ROUNDING = 1e-5
#: Textbook replay subtracts and divides: what its remaining radiance loses to cancellation.
CANCELLATION = 2e-3


def backward(scene, params, depth, block, *, spp=4, seed=7, **options):
    """Gradients of all requested parameters for a fixed random adjoint, name -> float64 array."""
    camera = scene.camera(0)
    w = np.random.default_rng(3).normal(size=(camera.crop_height, camera.crop_width, 3)).astype(np.float32)
    params.zero_grad()
    psdr.render_backward(scene, params, w, integrator=integrator(depth, block, **options), spp=spp, seed=seed)
    return {n: params[n].grad.numpy().astype(np.float64) for n in params.requested}


def assert_same(a, b, tolerance):
    assert a.keys() == b.keys() and a
    for name in a:
        scale = np.abs(b[name]).max()
        assert scale > 0.0, f"{name}: no gradient"
        np.testing.assert_allclose(a[name], b[name], rtol=0.0, atol=tolerance * scale, err_msg=name)


FURNACE_ALBEDO, FURNACE_RADIANCE = 0.6, 0.5


def furnace():
    """A closed ball of one reflectance that shines equally everywhere: L = E (1 + a + a^2 + ...)."""
    room = scenes.ball(True, face_normals=True)
    room["bsdf"] = {"type": "diffuse", "reflectance": scenes.rgb(*3 * [FURNACE_ALBEDO])}
    room["emitter"] = {"type": "area", "radiance": scenes.rgb(*3 * [FURNACE_RADIANCE])}
    return {"type": "scene", "sensor": scenes.camera([0.1, 0.2, 0.0], [1, 0, 0], size=8), "room": room}


@pytest.fixture(scope="module")
def closed():
    scene = psdr.load_dict(furnace())
    params = psdr.traverse(scene)
    params.requires_grad("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    return scene, params


KS = (1, 2, 3, 8, 16)
FAST_PAIRS = {(1, 8), (2, 1), (5, 1), (5, 2), (16, 8), (64, 8)}


@pytest.mark.slow
@pytest.mark.slow_rows("1-8", "5-1", "5-2", "16-8", "64-8")
@pytest.mark.parametrize(
    ("depth", "block"),
    [pytest.param(d, k, marks=() if (d, k) in FAST_PAIRS else pytest.mark.slow) for d in (1, 2, 5, 16, 64) for k in KS],
)
def test_every_block_size_gives_the_textbook_gradient(closed, depth, block):
    scene, params = closed
    if depth == 1:
        params.requires_grad_only("room.emitter.radiance.value")
    else:
        params.requires_grad_only("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    assert_same(backward(scene, params, depth, block), backward(scene, params, depth, 0), CANCELLATION)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [2, 5, 16, 64])
def test_block_sizes_agree_to_rounding(closed, depth):
    scene, params = closed
    params.requires_grad_only("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    whole = backward(scene, params, depth, 64)
    for block in KS:
        assert_same(backward(scene, params, depth, block), whole, ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2, 5, 16, 64])
def test_gradient_of_the_furnace_has_its_closed_form(closed, depth):
    scene, params = closed
    params.requires_grad_only("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    options = {"integrator": integrator(depth), "spp": 64}
    k = np.arange(depth)
    slopes = {
        "room.bsdf.reflectance.value": FURNACE_RADIANCE * (k * FURNACE_ALBEDO ** np.maximum(k - 1, 0)).sum(),
        "room.emitter.radiance.value": (FURNACE_ALBEDO**k).sum(),
    }
    names = list(slopes)
    for name, expected in slopes.items():
        batches = [
            psdr.render_forward(
                scene, params, dict.fromkeys(names, 0.0) | {name: 1.0}, seed=seed, **options
            ).numpy().mean()
            for seed in range(6)
        ]  # fmt: skip
        # Five standard errors of six batches, and float32's rounding of 10^4 sums.
        tolerance = 5.0 * np.std(batches, ddof=1) / np.sqrt(len(batches)) + 1e-4 * expected
        assert np.mean(batches) == pytest.approx(expected, abs=tolerance)
        assert tolerance < 0.02 * expected + 1e-12


@pytest.mark.slow
def test_unbounded_paths_end_by_roulette_only(closed):
    scene, params = closed
    params.requires_grad_only("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    endless = backward(scene, params, -1, 8, spp=16, rr_depth=3)
    # The plan cuts unbounded paths after 512 vertices; no path of this seed comes near.
    assert_same(endless, backward(scene, params, 512, 8, spp=16, rr_depth=3), 0.0)
    cut = backward(scene, params, 4, 8, spp=16, rr_depth=3)
    for name, values in endless.items():
        assert (values.sum() - cut[name].sum()) ** 2 > 0.0
    primal = psdr.render(scene, integrator=integrator(-1, rr_depth=3), spp=256).numpy()
    assert primal.mean() == pytest.approx(FURNACE_RADIANCE / (1.0 - FURNACE_ALBEDO), rel=0.02)


@pytest.mark.slow
def test_unbounded_paths_are_as_long_in_small_blocks(closed):
    scene, params = closed
    params.requires_grad_only("room.bsdf.reflectance.value")
    long = {k: backward(scene, params, -1, k, spp=4, rr_depth=150) for k in (2, 64)}
    assert_same(long[2], long[64], 0.0)
    with pytest.raises(ValueError, match=r"rr_depth: paths without a depth limit .* give max_depth"):
        backward(scene, params, -1, 8, spp=4, rr_depth=100_000)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "block"),
    [
        ("mirror", 1),
        pytest.param("mirror", 2, marks=pytest.mark.slow),
        pytest.param("glass", 2, marks=pytest.mark.slow),
        pytest.param("glass", 1, marks=pytest.mark.slow),
        pytest.param("glass", 3, marks=pytest.mark.slow),
    ],
)
def test_chains_through_mirrors_and_glass_cross_block_boundaries(name, block):
    scene, params = scenes.load(name)
    params.requires_grad_only("*")
    params.requires_grad_only(*(n for n in params if n not in ("room.vertex_texcoords", "ball.vertex_texcoords")))
    assert_same(backward(scene, params, 5, block), backward(scene, params, 5, 16), ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", "gap", "rough"])
def test_textbook_replay_agrees_on_moving_vertices(name):
    scene, params = scenes.load(name)
    params.requires_grad_only("*")
    for n, g in backward(scene, params, 4, 0, spp=16).items():
        expected = backward(scene, params, 4, 8, spp=16)[n]
        np.testing.assert_allclose(g, expected, rtol=0.0, atol=CANCELLATION * max(np.abs(expected).max(), 1e-6))


@pytest.mark.slow
def test_memory_depends_neither_on_depth_nor_on_samples(closed):
    scene, params = closed
    params.requires_grad_only("room.bsdf.reflectance.value", "room.emitter.radiance.value")
    backward(scene, params, 64, 8, spp=1)  # compiled, pools allocated
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    backward(scene, params, 64, 8, spp=256)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before  # KiB
    vertices = 8 * 8 * 256 * 64
    # Records of all vertices at 160 bytes each would take 164 MB; allow the allocator 8 MB.
    assert vertices * 160 > 20 * 8e6
    assert grown < 8 * 1024


# -- the oracle --------------------------------------------------------------------------------------------------------


def box():
    """A small closed room of three flat shapes, one of which shines."""
    t = psdr.Transform

    def part(to_world, color, **more):
        bsdf = {"type": "diffuse", "reflectance": scenes.rgb(*color)}
        return {"type": "rectangle", "face_normals": True, "to_world": to_world, "bsdf": bsdf, **more}

    light = {"type": "area", "radiance": scenes.rgb(3.0, 2.0, 2.5)}
    return {
        "type": "scene",
        "sensor": scenes.camera([0.1, 0.0, 2.4], [0.0, -0.3, 0.0], fov=50, size=6),
        "floor": part(t.translate([0, -1, 0]) @ t.rotate([1, 0, 0], -90), (0.7, 0.5, 0.3)),
        "back": part(t.translate([0, 0, -1]), (0.4, 0.6, 0.8)),
        "light": part(t.translate([0, 1, 0]) @ t.rotate([1, 0, 0], 90) @ t.scale(0.5), (0.2, 0.3, 0.1), emitter=light),
    }


ORACLE_SPP, ORACLE_SEED = 16, 5


@pytest.fixture(scope="module")
def taped():
    """The box, its parameters, and the recorded paths with the random numbers of the gradient pass."""
    scene = psdr.load_dict(box())
    # The offset of a ray's origin is in the recorded directions and not in the oracle's connections.
    scene.ray_epsilon *= 0.1
    # Nor does the oracle know contacts (kernels/interior/factors/contact.py).
    scene.contact_ratio = 0.0
    params = psdr.traverse(scene)
    params.requires_grad("*.vertex_positions", "*.reflectance.value", "*.radiance.value")
    options = integrator(tape_oracle.DEPTH, block=tape_oracle.DEPTH)
    config = psdr.plan(scene, integrator=options).config
    seed = mix_seed(ORACLE_SEED, STREAM_INTERIOR)
    camera = scene.camera(0)
    vertices = tape_oracle.record_paths(config, scene, camera, seed, ORACLE_SPP, tape_oracle.DEPTH, NO_ROULETTE)
    shapes = ("floor", "back", "light")
    geometry = SimpleNamespace(
        positions_numpy=np.concatenate([params[f"{s}.vertex_positions"].numpy() for s in shapes]),
        faces_numpy=scene.indices.numpy().reshape(-1, 3),
        face_shape_numpy=np.repeat(np.arange(3, dtype=np.int32), 2),
    )
    albedo = np.array([params[f"{s}.bsdf.reflectance.value"].numpy() for s in shapes])
    radiance = np.zeros((3, 3), np.float32)
    radiance[2] = params["light.emitter.radiance.value"].numpy()

    def oracle(weights):
        """``weights``: (pixels, 3). Paths that leave at once add nothing and are left out."""
        per_path = np.repeat(weights[:, None] / ORACLE_SPP, ORACLE_SPP, axis=1).reshape(-1, 3)
        paths = vertices.reshape(-1, tape_oracle.DEPTH)
        seen = paths["face"][:, 0] >= 0
        position = params["sensor.to_world"].numpy()[:3, 3]
        p, a, r, _loss = tape_oracle.gradients(
            geometry, paths[seen], position, albedo, radiance, per_path[seen].astype(np.float32)
        )
        result = {f"{s}.bsdf.reflectance.value": a[i] for i, s in enumerate(shapes)}
        result |= {f"{s}.vertex_positions": p[4 * i : 4 * i + 4] for i, s in enumerate(shapes)}
        return result | {"light.emitter.radiance.value": r[2]}

    return SimpleNamespace(scene=scene, params=params, options=options, vertices=vertices, oracle=oracle)


def swept(taped, weights, block=tape_oracle.DEPTH):
    size = 6
    taped.params.zero_grad()
    options = integrator(tape_oracle.DEPTH, block)
    image = weights.reshape(size, size, 3).astype(np.float32)
    psdr.render_backward(taped.scene, taped.params, image, integrator=options, spp=ORACLE_SPP, seed=ORACLE_SEED)
    return {n: taped.params[n].grad.numpy() for n in taped.params.requested}


#: Two float32 evaluations of one formula, and the offset of a ray's origin (1e-6 of the scene), which turns the short
#: connections near a corner by some 1e-4.
ORACLE_TOLERANCE = 1e-3


def assert_equals_oracle(got, expected):
    assert got.keys() == expected.keys()
    largest = max(np.abs(e).max() for e in expected.values())
    assert largest > 0.0
    for name, e in expected.items():
        atol = ORACLE_TOLERANCE * max(np.abs(e).max(), 1e-3 * largest)
        np.testing.assert_allclose(got[name], e, rtol=0.0, atol=atol, err_msg=name)


def test_recorded_paths_reach_their_full_depth(taped):
    lobes = (taped.vertices["lobe"] > 0).mean(axis=(0, 1))
    assert lobes[0] > 0.5 and lobes[1] > 0.1
    assert (taped.vertices["light"] >= 0).mean() > 0.1


@pytest.mark.slow
def test_the_whole_image_equals_the_taped_oracle(taped):
    weights = np.random.default_rng(1).normal(size=(36, 3))
    assert_equals_oracle(swept(taped, weights), taped.oracle(weights))


@pytest.mark.parametrize("block", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow)])
def test_other_block_sizes_equal_the_taped_oracle(taped, block):
    weights = np.random.default_rng(2).normal(size=(36, 3))
    assert_equals_oracle(swept(taped, weights, block), taped.oracle(weights))


@pytest.mark.slow
def test_every_pixel_alone_equals_the_taped_oracle(taped):
    compared = 0
    for pixel in range(36):
        if not (taped.vertices["face"][pixel, :, 0] >= 0).any():
            continue
        weights = np.zeros((36, 3))
        weights[pixel] = (1.0, -0.5, 0.7)
        expected = taped.oracle(weights)
        if any(e.any() for e in expected.values()):
            assert_equals_oracle(swept(taped, weights), expected)
            compared += 1
    assert compared > 20
