"""Normal and bump maps, and blends: closed forms under a directional light, and images against Mitsuba's ``path``."""

import numpy as np
import pytest

import warp_psdr as psdr

T = psdr.Transform
PAINT = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}}
COPPER = {"type": "roughconductor", "material": "Cu", "alpha": 0.3}
LIGHT = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
PLAIN = {"use_shadowing_function": False}
#: Rounding of a lit pixel, relative.
FLOAT32 = 1e-5


def plane(bsdf: dict) -> psdr.Scene:
    """A plane under a directional light, seen from above."""
    return psdr.load_dict({
        "type": "scene",
        "camera": {
            "type": "perspective", "fov": 20.0, "to_world": T.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        },
        "plane": {"type": "rectangle", "bsdf": bsdf},
        "sun": {"type": "directional", "direction": (-LIGHT).tolist(), "irradiance": 2.0},
    })  # fmt: skip


def lit_plane(bsdf: dict) -> np.ndarray:
    """Pixels (16, 3) of such a plane."""
    return psdr.render(plane(bsdf), integrator=psdr.PathIntegrator(max_depth=2), spp=4).numpy().reshape(-1, 3)


def normal_map(n, nested=PAINT, **more) -> dict:
    color = {"type": "rgb", "value": (0.5 + 0.5 * np.asarray(n) / np.linalg.norm(n)).tolist()}
    return {"type": "normalmap", "normalmap": color, "nested": nested, **more}


def ramp(slope_x: float, slope_y: float, nested=PAINT, **more) -> dict:
    """Heights slope_x x + slope_y y over the unit rectangle, -1 <= x, y <= 1, whose v goes up with y."""
    x, y = np.meshgrid((np.arange(16) + 0.5) / 8.0 - 1.0, (np.arange(16) + 0.5) / 8.0 - 1.0)
    heights = (slope_x * x + slope_y * y)[..., None].astype(np.float32)
    return {"type": "bumpmap", "any": {"type": "bitmap", "bitmap": heights, "raw": True}, "nested": nested, **more}


def expected(n) -> np.ndarray:
    """Radiance of paint with the normal n."""
    return np.array([0.7, 0.5, 0.3]) / np.pi * 2.0 * max(0.0, n @ LIGHT / np.linalg.norm(n))


@pytest.mark.slow
def test_a_flat_map_changes_nothing() -> None:
    plain = lit_plane(COPPER)
    assert np.std(plain[:, 0]) > 0.0
    for flat in (normal_map([0.0, 0.0, 1.0], COPPER), ramp(0.0, 0.0, COPPER, flip_invalid_normals=False, **PLAIN)):
        np.testing.assert_allclose(lit_plane(flat), plain, rtol=FLOAT32)


@pytest.mark.slow
def test_a_tilted_map_is_a_turned_plane() -> None:
    n = np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    np.testing.assert_allclose(lit_plane(normal_map(n, **PLAIN)), np.tile(expected(n), (16, 1)), rtol=FLOAT32)


@pytest.mark.slow
def test_the_bump_map_of_a_ramp_tilts_by_the_angle_of_its_slope() -> None:
    for slope_x, slope_y, scale in ((0.3, 0.0, 1.0), (0.0, -0.5, 1.0), (0.2, 0.1, 2.0)):
        n = np.array([-scale * slope_x, -scale * slope_y, 1.0])
        image = lit_plane(ramp(slope_x, slope_y, scale=scale, **PLAIN))
        np.testing.assert_allclose(image, np.tile(expected(n), (16, 1)), rtol=1e-4)


@pytest.mark.slow
def test_shadowing_takes_light_from_tilted_normals() -> None:
    n = np.array([0.6, 0.0, 0.8])
    a2 = min((0.6 / 0.8) ** 2 / 8.0, 1.0)
    tan2 = (LIGHT[0] ** 2 + LIGHT[1] ** 2) / LIGHT[2] ** 2
    shadowed = expected(n) * 2.0 / (1.0 + np.sqrt(1.0 + a2 * tan2))
    np.testing.assert_allclose(lit_plane(normal_map(n)), np.tile(shadowed, (16, 1)), rtol=FLOAT32)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_texels_of_a_bump_map_have_exact_derivatives(mode: str) -> None:
    """Light from one direction on paint leaves nothing to chance but the place in the pixel, which stays."""
    heights = (0.2 * np.random.default_rng(1).random((6, 6, 1))).astype(np.float32)
    to_uv = np.array([[1.1, 0.2, 0.1], [-0.1, 0.9, 0.3], [0.0, 0.0, 1.0]])
    texture = {"type": "bitmap", "bitmap": heights, "raw": True, "to_uv": to_uv}
    scene = plane({"type": "bumpmap", "any": texture, "nested": PAINT, "scale": 0.7})
    params, name = psdr.traverse(scene), "plane.bsdf.nested_texture.data"
    integrator, weights = psdr.PathIntegrator(max_depth=2), np.random.default_rng(2).random((4, 4, 3))
    direction = np.random.default_rng(3).uniform(-1.0, 1.0, heights.shape)

    def loss(name: str, values) -> float:
        params[name] = np.asarray(values, np.float32)
        params.update()
        return float(np.sum(psdr.render(scene, params, integrator=integrator, spp=4096, seed=1).numpy() * weights))

    def difference(name: str, values, direction, step: float) -> float:
        found = (loss(name, values + step * direction) - loss(name, values - step * direction)) / (2.0 * step)
        loss(name, values)
        return found

    expected = difference(name, heights, direction, 1e-2)
    params.requires_grad(name, "plane.bsdf.scale")
    if mode == "forward":
        image = psdr.render_forward(scene, params, {name: direction}, integrator=integrator, spp=4096)
        found = np.sum(image.numpy() * weights)
    else:
        psdr.render_backward(scene, params, weights, integrator=integrator, spp=4096)
        found = np.sum(params[name].grad.numpy() * direction)
        by_scale = difference("plane.bsdf.scale", np.full(1, 0.7), 1.0, 2e-2)
        assert float(params["plane.bsdf.scale"].grad.numpy()[0]) == pytest.approx(by_scale, rel=1e-2)
    assert found == pytest.approx(expected, rel=1e-2)


def _scene(kind: str, lib, pose) -> dict:
    """A tilted rectangle beside a wall, for Mitsuba or us; ``pose(steps)`` puts a matrix together."""
    rng = np.random.default_rng(5)
    normals = (0.5 + 0.25 * (rng.random((8, 8, 3)) - 0.5)).astype(np.float32)
    normals[..., 2] = 0.9
    heights = (0.15 * rng.random((8, 8, 1))).astype(np.float32)

    def bitmap(a):
        return {"type": "bitmap", "raw": True, "bitmap": a if lib is psdr else lib.Bitmap(a)}

    def sided(bsdf):
        return {"type": "twosided", "inner": bsdf}

    mapped = {"type": "normalmap", "normalmap": bitmap(normals)}
    bumped = {"type": "bumpmap", "heights": bitmap(heights)}
    bsdf = {
        "blend": {"type": "blendbsdf", "weight": 0.3, "a": PAINT, "b": COPPER},
        "normal map": mapped | {"a": COPPER},
        "normal map of a mirror": mapped | {"a": {"type": "conductor", "material": "Cu"}},
        "back of a normal map": sided(mapped | {"a": PAINT}),
        "back in a normal map": mapped | {"a": sided(PAINT)},
        "bump map": bumped | {"a": PAINT},
        "back in a bump map": bumped | {"a": sided(PAINT), "scale": 2.0},
    }[kind]
    white = sided({"type": "diffuse", "reflectance": 0.8})
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "plane": {"type": "rectangle", "bsdf": bsdf, "to_world": pose(turn=20 + 180 * kind.startswith("back"))},
        "wall": {"type": "rectangle", "bsdf": white, "to_world": pose(turn=90, move=[0, 1, 0.5])},
        "sky": {"type": "constant", "radiance": 0.3},
        "point": {"type": "point", "position": [1.0, 1.5, 2.0], "intensity": 6.0},
        "camera": {"type": "perspective", "fov": 40.0, "to_world": pose(move=[0, 0, 3.5], turn=180), "film": film},
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", [
    "blend", "normal map", "normal map of a mirror", "back of a normal map", "back in a normal map", "bump map",
    "back in a bump map",
])  # fmt: skip
def test_images_are_mitsubas(kind: str) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def pose(turn=0.0, move=(0, 0, 0)):
        return T.translate(move) @ T.rotate([1, 0, 0], turn)

    ours = psdr.load_dict(_scene(kind, psdr, pose))
    theirs = mi.load_dict(_scene(kind, mi, lambda **steps: mi.ScalarTransform4f(pose(**steps).matrix)))

    def blocks(image) -> np.ndarray:
        return np.array(image).reshape(8, 4, 8, 4, 3).mean(axis=(1, 3))

    a = np.array([blocks(psdr.render(ours, spp=64, seed=seed).numpy()) for seed in range(8)])
    b = np.array([blocks(mi.render(theirs, spp=64, seed=seed)) for seed in range(8)])
    z = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 8 + 1e-12)
    # Student's t with 7 to 14 degrees of freedom, of a root mean square of up to 1.2: 64 of them in three colours.
    assert np.sqrt(np.mean(z**2)) < 1.7 and np.abs(z).max() < 7.0
    assert a.mean() == pytest.approx(b.mean(), rel=2e-3)
