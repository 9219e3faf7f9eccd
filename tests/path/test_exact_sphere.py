"""Images of exact spheres and ellipsoids: closed forms, fine tessellations, and Mitsuba's sphere."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

from .helpers import ROUNDING, batches, blocks, largest_z, mean_and_variance, z_limit

T = psdr.Transform
TILES = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32)
POSE = T.translate([0.1, 0.0, 0.75]).rotate([0, 1, 1], 35.0).scale([0.5, 0.35, 0.45])
BSDFS = {
    "textured": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": TILES, "raw": True}},
    "glass": {"type": "dielectric"},
    "brushed": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.3},
    "two-sided": {"type": "twosided", "bsdf": {"type": "roughplastic"}},
}


def scene(bsdf: dict, *, depth: int = 5, **ball) -> dict:
    """An object above a floor, under a lamp and a sky."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    lamp = T.translate([1, -1, 3]).rotate([1, 0, 0], 180).scale(0.5)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth},
        "sensor": {
            "type": "perspective",
            "fov": 45.0,
            "to_world": T.look_at([0, -3, 1.5], [0, 0, 0.4], [0, 0, 1]),
            "film": film,
        },
        "floor": {
            "type": "rectangle",
            "to_world": T.scale(3.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 8.0, 8.0]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
        "ball": {"type": "sphere", "bsdf": bsdf, **ball},
    }


def assert_same(a: np.ndarray, b: np.ndarray, rounding: float) -> None:
    """Fail unless two sets of batches of images, (count, H, W, 3), have the same means over blocks of pixels."""
    (mean_a, var_a), (mean_b, var_b) = (mean_and_variance(blocks(x, 8)) for x in (a, b))
    z = largest_z(var_a, var_b, mean_a - mean_b, mean_a, rounding)
    assert z.max() < z_limit(z.size, len(a) - 1)


@pytest.mark.slow_rows("inside", "outside")
@pytest.mark.parametrize("seen_from", ["outside", "inside"])
def test_white_furnace(seen_from: str) -> None:
    """Under a uniform sky a convex body scatters once: albedo x sky; and one inside sees nothing but itself."""
    eye = [0, -3, 0.5] if seen_from == "outside" else [0.05, 0.0, 0.7]
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 5.0, "to_world": T.look_at(eye, [0.1, 0.0, 0.75], [0, 0, 1]), "film": film}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}}
    ball = {"type": "sphere", "exact": True, "to_world": POSE, "bsdf": bsdf}
    held = psdr.load_dict({"type": "scene", "sensor": sensor, "ball": ball, "sky": {"type": "constant"}})
    image = batches(held, count=2, spp=64, max_depth=4)
    expected = [0.2, 0.5, 0.8] if seen_from == "outside" else [0.0, 0.0, 0.0]
    # Absorbs the noise of cosine-weighted directions, which next-event estimation mixes with uniform ones.
    np.testing.assert_allclose(image.mean(axis=(0, 1, 2)), expected, atol=0.01)


@pytest.mark.slow_rows("textured")
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "textured")) for n in BSDFS])
def test_image_is_mitsubas(name: str) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    form = {"center": [0.1, 0.2, 0.5], "radius": 0.5}
    held = psdr.load_dict(scene(BSDFS[name], exact=True, **form))
    theirs = mi.load_dict(for_mitsuba(mi, scene(BSDFS[name], **form)))
    images = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    ours = batches(held, count=8, spp=64, max_depth=5)
    assert_same(ours, images, MITSUBA_ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("name", BSDFS)
def test_ellipsoid_is_its_fine_tessellation(name: str) -> None:
    exact = psdr.load_dict(scene(BSDFS[name], exact=True, to_world=POSE))
    fine = psdr.load_dict(scene(BSDFS[name], resolution=512, to_world=POSE))
    # The tessellation is 1e-4 smaller.
    a, b = batches(exact, count=8, spp=64, max_depth=5), batches(fine, count=8, spp=64, seed=50, max_depth=5)
    assert_same(a, b, 3.0 * ROUNDING)


@pytest.mark.slow
def test_what_the_camera_sees_is_the_fine_tessellations() -> None:
    names = "dd:depth, nn:sh_normal, gg:geo_normal, uv:uv, pp:position, du:dp_du, dv:dp_dv, ii:prim_index"
    seen = []
    for form in ({"exact": True}, {"resolution": 1024}):
        held = psdr.load_dict(scene(BSDFS["textured"], to_world=POSE, **form))
        found = psdr.render_aov(held, names, spp=1)
        seen.append({name: image.numpy().astype(np.float64) for name, image in found.items()})
    for name in ("dd", "nn", "gg", "uv", "pp", "du", "dv"):
        a, b = (s[name] for s in seen)
        # All but the outline, and the seam of the azimuth.
        assert (np.abs(a - b) <= 0.02 * np.abs(b).max()).mean() > 0.99, name
    assert (seen[0]["ii"] <= 1.0).all()


@pytest.mark.slow
def test_traced_vertices_lie_on_it() -> None:
    held = psdr.load_dict(scene(BSDFS["textured"], exact=True, to_world=POSE))
    trace = psdr.trace_sample(held, pixel=(16, 14), sample=0)
    vertex = trace.vertices[0]
    assert vertex.shape == "ball" and vertex.face == -1
    local = np.linalg.inv(POSE.matrix) @ np.append(vertex.position, 1.0)
    assert np.linalg.norm(local[:3]) == pytest.approx(1.0, abs=1e-5)
