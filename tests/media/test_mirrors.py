"""Derivatives by what moves, through mirrors, glass, thin glass and masks beside media and around them.

In most scenes all that the camera sees is behind a mirror, glass or a mask. The interior term follows chains there, and
all edges are found by searching along lines.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import warp_psdr as psdr
from tests.gradients.configs import aim, shift
from tests.media.scenes import T, camera, cube, medium, point, rgb, sky, square, whole
from tests.media.test_boundary import BATCHES, assert_mean, derivatives, difference

SIZE = 16
STEP = 0.01
FOG = {**medium((1.2, 1.0, 1.4), (0.9, 0.8, 0.7), g=0.3)}
GREY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.2, 0.4, 0.6)}}
DARK = {"type": "diffuse", "reflectance": rgb(0.1, 0.15, 0.2)}
CONDUCTOR = {"type": "conductor", "specular_reflectance": 0.9}
GLASS = {"type": "dielectric", "int_ior": 1.3}
PANE = {"type": "thindielectric", "int_ior": 1.5}
VEIL = {"type": "mask", "opacity": 0.4, "nested": GREY}
#: Weights of the pixels and channels where no difference is taken.
RAMP = 1.0 + 0.5 * np.linspace(-1, 1, SIZE)[:, None, None] + 0.4 * np.linspace(-1, 1, SIZE)[None, :, None]
ADJOINT = (RAMP * np.array([1.0, 0.7, 0.4])).astype(np.float32)
#: Samples of a pixel of a difference, one a batch.
DIFFERENCE_SPP = 8192


def stage(seen, *, smoke=True, **more):
    """A floor, a block, smoke in a cube that is not there, a lamp and a sky; ``seen``: what all is seen through."""
    parts = {
        "sensor": camera([0, -1.4, 0.6], [0, 0, 0.5], 50.0, SIZE),
        "floor": square(-0.02, 5.0, {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)}),
        "lamp": square(3.0, 0.8, DARK, flipped=True, emitter={"type": "area", "radiance": rgb(8.0, 7.0, 6.0)}),
        "block": {
            "type": "cube",
            "to_world": T.translate([-0.45, 0.5, 0.35]) @ T.rotate([0, 0, 1], 20.0) @ T.scale([0.2, 0.2, 0.3]),
            "bsdf": DARK,
        },
        "sky": sky(0.5, 0.6, 0.7),
        "seen": seen,
    }
    if smoke:
        parts["smoke"] = cube(FOG, scale=0.35, translate=(0.4, 0.6, 0.5), turn=35.0)
    return psdr.load_dict(whole(**parts | more))


def upright(bsdf, y, half, turn=0.0, **more):
    """A rectangle that faces the camera of ``stage``."""
    pose = T.translate([0, y, 0.6]) @ T.rotate([0, 0, 1], turn) @ T.rotate([1, 0, 0], 90.0) @ T.scale([half, half, 1])
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf, **more}


def box(bsdf, **more):
    pose = T.translate([0.05, -0.35, 0.55]) @ T.rotate([0, 0, 1], 30.0) @ T.scale([0.45, 0.4, 0.45])
    return {"type": "cube", "to_world": pose, "bsdf": bsdf, **more}


def mirrored(**more):
    """The camera looks into a mirror, in which it sees the block and the smoke behind it."""
    wall = {"type": "rectangle", "to_world": T.translate([0, 2.5, 3.0]) @ T.rotate([1, 0, 0], 90.0) @ T.scale(2.9)}
    mirror = {"type": "rectangle", "bsdf": CONDUCTOR}
    mirror["to_world"] = T.translate([0, -1.7, 3.0]) @ T.rotate([1, 0, 0], -90.0) @ T.scale(2.9)
    view = camera([0, -1.4, 0.6], [0, -1.7, 0.55], 60.0, SIZE)
    return stage(mirror, sensor=view, wall={**wall, "bsdf": GREY}, **more)


SCENES = {
    "mirror": mirrored,
    "glass": lambda: stage(box(GLASS)),
    "ball": lambda: stage({"type": "sphere", "center": [0.05, -0.2, 0.55], "radius": 0.45, "bsdf": GLASS}),
    "glass around a medium": lambda: stage(box(GLASS, interior=FOG), smoke=False),
    "thin glass around a medium": lambda: stage(box(PANE, interior=FOG), smoke=False),
    "mask": lambda: stage(upright(VEIL, -0.5, 0.55, 15.0)),
}


def moved(scene):
    """The names of all poses."""
    return [name for name in psdr.traverse(scene) if name.endswith("to_world") and not name.startswith("sky")]


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "mirror")) for kind in SCENES])
def test_nothing_changes_where_all_moves_together(kind):
    """Sample by sample, whatever vertices ride on, and wherever edges are seen."""
    scene = SCENES[kind]()
    names = moved(scene)
    motion = shift(0.3, -0.5, 0.8)
    parts = [(g * motion(g)).sum() for g in derivatives(scene, names, ADJOINT, spp=8, depth=4, batches=1)[0]]
    assert np.count_nonzero(parts) >= len(names) - 1
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), dict(zip(names, parts, strict=True))


#: Scene, parameter, direction, depth, samples, largest share of noise.
ROWS = [
    ("mirror", "block.to_world", shift(0.5, 0.3, 0.2), 3, 512, 0.03),
    ("mirror", "smoke.to_world", shift(0.3, -0.4, 0.3), 3, 512, 0.05),
    ("mirror", "seen.to_world", aim(0, 0, 1), 3, 512, 0.03),
    ("mirror", "sensor.to_world", shift(0.2, 0.1, 0.2), 3, 2048, 0.06),
    ("glass", "smoke.to_world", shift(0.3, -0.4, 0.3), 4, 512, 0.06),
    ("glass", "seen.to_world", shift(0.4, 0.1, 0.3), 4, 512, 0.06),
    ("mask", "seen.to_world", shift(0.4, 0.1, 0.3), 4, 512, 0.06),
    ("mask", "block.to_world", shift(0.5, 0.1, 0.2), 4, 512, 0.06),
    ("glass around a medium", "block.to_world", shift(0.5, 0.1, 0.2), 4, 1024, 0.1),
    ("thin glass around a medium", "block.to_world", shift(0.5, 0.1, 0.2), 4, 1024, 0.1),
]


def expected_of(scene, name, tangent, depth):
    """Return weights of the pixels, those where the difference is large, and weighted differences of other batches."""
    weights = gaussian_filter(difference(scene, name, tangent, depth, DIFFERENCE_SPP, 90, STEP), (1.5, 1.5, 0.0))
    weights = (weights / np.abs(weights).max()).astype(np.float32)
    differences = (difference(scene, name, tangent, depth, DIFFERENCE_SPP, i, STEP) for i in range(BATCHES))
    return weights, [(weights * d).sum() for d in differences]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name", "motion", "depth", "spp", "noise"), ROWS, ids=lambda x: x if isinstance(x, str) else ""
)
def test_derivative_equals_finite_differences(kind, name, motion, depth, spp, noise):
    """Of a weighted sum of pixels, in both modes."""
    scene = SCENES[kind]()
    params = psdr.traverse(scene)
    tangent = motion(params[name].numpy())
    weights, expected = expected_of(scene, name, tangent, depth)
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    names = moved(scene)
    found = [g[names.index(name)] for g in derivatives(scene, names, weights, spp=spp, depth=depth)]
    assert_mean([(g * tangent).sum() for g in found], np.mean(expected), error, noise)
    tangents = dict.fromkeys(names, 0.0) | {name: tangent}
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": spp, "seed": 50}
    image = psdr.render_forward(scene, params, tangents, **options).numpy()
    np.testing.assert_allclose((weights * image).sum(), (found[0] * tangent).sum(), rtol=2e-3)


@pytest.mark.slow
def test_an_index_of_refraction_turns_rays_around_a_medium():
    scene = SCENES["glass around a medium"]()
    name, one = "seen.bsdf.eta", np.ones(1)
    weights, expected = expected_of(scene, name, one, 4)
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    found = [float(g[0].item()) for g in derivatives(scene, [name], weights, spp=512, depth=4)]
    assert_mean(found, np.mean(expected), error, 0.05)


@pytest.mark.slow
def test_thin_smoke_has_the_derivatives_of_none():
    """The same scene, by the kernels of media and by those without."""
    thin = cube(medium(1e-4, 0.8), scale=0.35, translate=(0.4, 0.6, 0.5), turn=35.0)
    names = ["block.to_world", "seen.to_world", "sensor.to_world"]
    motions = [shift(0.5, 0.3, 0.2), aim(0, 0, 1), shift(0.2, 0.1, 0.2)]
    found = []
    for scene in (mirrored(smoke=thin), mirrored(smoke=square(-9.0, 0.1))):
        params = psdr.traverse(scene)
        tangents = [motion(params[name].numpy()) for name, motion in zip(names, motions, strict=True)]
        gradients = derivatives(scene, names, ADJOINT, spp=512, depth=3)
        found.append([[(a * t).sum() for a, t in zip(g, tangents, strict=True)] for g in gradients])
    a, b = np.array(found)
    error = np.hypot(a.std(axis=0, ddof=1), b.std(axis=0, ddof=1)) / np.sqrt(BATCHES)
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4.0 * error).all(), (a.mean(axis=0), b.mean(axis=0), error)
    assert (error < 0.05 * np.abs(b.mean(axis=0))).all()


def test_hard_shadows_in_a_medium_are_not_searched_for_through_mirrors():
    scene = mirrored(bulb=point([0.0, 0.0, 2.0]))
    with pytest.raises(ValueError, match="'bulb' is a light of no area, whose hard shadows in media"):
        psdr.plan(scene, names=["block.to_world"])
    inside = psdr.PathIntegrator(boundary=None)
    assert "left out" in str(psdr.plan(scene, names=["block.to_world"], integrator=inside))


def test_masks_end_shadow_rays_where_something_moves():
    scene = SCENES["mask"]()
    assert "end at surfaces" in str(psdr.plan(scene, names=["block.to_world"]))
    assert "pass surfaces" in str(psdr.plan(scene, names=["floor.bsdf.reflectance.value"]))
