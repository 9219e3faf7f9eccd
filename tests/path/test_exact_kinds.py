"""Images of exact disks and cylinders: Mitsuba's, and fine tessellations."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

from .helpers import ROUNDING, batches
from .test_exact_sphere import BSDFS, T, assert_same
from .test_exact_sphere import scene as ball_scene

FORMS = {
    "disk": {"to_world": T.translate([-0.6, 0.0, 0.6]).rotate([1, 0.5, 0], 60.0).scale([0.5, 0.35, 1.0])},
    "cylinder": {"p0": [0.6, 0.2, 0.1], "p1": [0.5, -0.1, 1.0], "radius": 0.3},
}
FLIPPED = {"to_world": T.translate([0.0, -0.2, 0.9]).rotate([0, 1, 0], 40.0).scale([-0.15, 0.2, 0.3])}
#: Of materials, which both kinds share; a cylinder shows its inside.
SIDES = {
    "textured": {"type": "twosided", "bsdf": BSDFS["textured"]},
    "brushed": {"type": "twosided", "bsdf": BSDFS["brushed"]},
    "one-sided": BSDFS["textured"],
    "glass": BSDFS["glass"],
}


def scene(bsdf: str, **form) -> dict:
    """A disk, a cylinder, a mirrored cylinder inside out, and a ball."""
    held = ball_scene(BSDFS["textured"], center=[0.0, 0.5, 0.3], radius=0.3, **form)
    for name, place in FORMS.items():
        held[name] = {"type": name, "bsdf": SIDES[bsdf], **place, **form}
    held["flipped"] = {"type": "cylinder", "bsdf": SIDES[bsdf], "flip_normals": True, **FLIPPED, **form}
    return held


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "textured")) for n in SIDES])
def test_image_is_mitsubas(name: str) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs = mi.load_dict(for_mitsuba(mi, scene(name)))
    images = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    assert_same(
        batches(psdr.load_dict(scene(name, exact=True)), count=8, spp=64, max_depth=5), images, MITSUBA_ROUNDING
    )


@pytest.mark.slow
def test_image_is_the_fine_tessellations() -> None:
    exact, fine = psdr.load_dict(scene("textured", exact=True)), psdr.load_dict(scene("textured", resolution=512))
    a, b = batches(exact, count=8, spp=64, max_depth=5), batches(fine, count=8, spp=64, seed=50, max_depth=5)
    assert_same(a, b, 3.0 * ROUNDING)


@pytest.mark.slow
def test_what_the_camera_sees_is_the_fine_tessellations() -> None:
    names = "dd:depth, nn:sh_normal, gg:geo_normal, uv:uv, pp:position, du:dp_du, dv:dp_dv, ii:prim_index"
    seen = []
    for form in ({"exact": True}, {"resolution": 1024}):
        found = psdr.render_aov(psdr.load_dict(scene("textured", **form)), names, spp=1)
        seen.append({name: image.numpy().astype(np.float64) for name, image in found.items()})
    for name in ("dd", "nn", "gg", "uv", "pp", "du", "dv"):
        a, b = (s[name] for s in seen)
        # All but the outlines, and the seam of the azimuth.
        assert (np.abs(a - b) <= 0.02 * np.abs(b).max()).mean() > 0.98, name
    assert (seen[0]["ii"] <= 1.0).all()


@pytest.mark.slow
def test_a_cylinder_is_seen_from_within() -> None:
    """A uniform sky through both ends of a cylinder, scattered once by its wall."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    view = T.look_at([0, 0, 0.5], [1, 0, 0.5], [0, 0, 1])
    tube = {"type": "cylinder", "exact": True, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    held = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 5.0, "to_world": view, "film": film},
            "tube": tube,
            "sky": {"type": "constant"},
        }
    )
    image = batches(held, count=2, spp=256, max_depth=2)
    # View factor of an end, at half a radius along the axis, from a point of the wall: (Z^2 + 1/2) / sqrt(Z^2 + 1) - Z.
    z = 0.25
    np.testing.assert_allclose(image.mean(), 0.5 * 2.0 * ((z * z + 0.5) / np.sqrt(z * z + 1.0) - z), atol=0.005)
