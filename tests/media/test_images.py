"""Images of media: Mitsuba's ``volpath`` and ``volpathmis``, rays that are lost, equal bits, and what is refused."""

import functools

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media import scenes
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

#: Its boxes end inside of their interface, and are meant to.
INSIDE = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")
CASES = {
    "fog in a room": scenes.fog_in_a_room,
    "milk": scenes.milk,
    "striped milk": scenes.striped_milk,
    "smoke": scenes.smoke,
    "ink in fog": scenes.ink_in_fog,
    "ink in the sun": scenes.ink_in_the_sun,
    "ink in glass": scenes.ink_in_glass,
    "coloured smoke": scenes.coloured_smoke,
    "inside smoke": scenes.inside_smoke,
    "two phases": scenes.two_phases,
    "blended": scenes.blended,
    "blended by grids": scenes.blended_by_grids,
    "microflakes": scenes.microflakes,
}
FAST = ("milk",)
PEERS = ("volpath", "volpathmis")


@functools.cache
def our_batches(name):
    """Images of a case, and the scene for Mitsuba."""
    parts = CASES[name]()
    scene = psdr.load_dict(parts)
    images = batches(scene, spp=64)
    assert psdr.invalid_samples(scene)["image"] == 0
    return images, parts


@INSIDE
@pytest.mark.parametrize("peer", PEERS)
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FAST)) for n in CASES])
def test_equals_mitsuba(name, peer):
    """Blocks of 6 x 6 pixels have the mean of each of Mitsuba's integrators."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    ours, parts = our_batches(name)
    whole_paths = {**parts["integrator"], "type": peer, "rr_depth": 100}  # roulette of volpathmis loses light
    theirs = mi.load_dict(for_mitsuba(mi, {**parts, "integrator": whole_paths}))
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    assert_same_mean(blocks(ours, 6), blocks(theirs, 6), f"{name}, {peer}", MITSUBA_ROUNDING)


@pytest.mark.slow
def test_any_number_of_workers_and_wide_filters():
    """Equal bits, under a box and under a wide filter, which agree in the mean."""
    parts = scenes.milk()
    scene = psdr.load_dict(parts)
    before = psdr.set_workers(1)
    try:
        first = psdr.render(scene, spp=4, seed=3).numpy()
    finally:
        psdr.set_workers(before)
    np.testing.assert_array_equal(first, psdr.render(scene, spp=4, seed=3).numpy())
    parts["sensor"]["film"] = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "gaussian"}}
    wide = batches(psdr.load_dict(parts), spp=16)
    assert_same_mean(wide.mean(axis=(1, 2)), batches(scene, spp=16).mean(axis=(1, 2)), "filters", 1e-2)


@pytest.mark.filterwarnings("ignore:'sensor' names no medium")
def test_rays_in_another_medium_than_a_shape_has_there_are_counted():
    parts = scenes.milk()
    parts["sensor"] = scenes.camera([0.0, 0.1, 0.0], [1.0, 0.0, 0.0], 40.0, 8)
    scene = psdr.load_dict(parts)
    with pytest.warns(RuntimeWarning, match="name the medium that the sensor is in"):
        psdr.render(scene, spp=4)
    assert psdr.invalid_samples(scene)["image"] > 200
    parts["sensor"]["medium"] = parts["cube"]["interior"] = {**parts["cube"]["interior"], "id": "milk"}
    parts["sensor"]["medium"] = {"type": "ref", "id": "milk"}
    scene = psdr.load_dict(parts)
    psdr.render(scene, spp=4)
    assert psdr.invalid_samples(scene)["image"] == 0


def test_the_plan_names_media_and_others_have_none():
    scene = psdr.load_dict(scenes.milk())
    text = str(psdr.plan(scene))
    assert "1 homogeneous" in text and "bounded by 1 shapes" in text and "hg" in text
    wanted = str(psdr.plan(scene, names=["cube.interior_medium.scale"]))
    assert "media derivatives" in wanted and "made to collide" in wanted
    assert psdr.plan(psdr.load_dict(psdr.cornell_box())).config.media is None


@pytest.mark.parametrize("name", ["milk", pytest.param("smoke", marks=pytest.mark.slow)])
def test_paths_through_media_are_traced(name):
    """Their sum is the pixel, and what scatters in the medium is among their vertices."""
    scene = psdr.load_dict(getattr(scenes, name)())
    image = psdr.render(scene, spp=8, seed=3).numpy()
    x, y = 12, 11
    traces = [psdr.trace_sample(scene, pixel=(x, y), sample=i, seed=3) for i in range(8)]
    np.testing.assert_allclose(sum(trace.radiance for trace in traces) / 8, image[y, x], rtol=1e-4)
    scattered = [v for trace in traces for v in trace.vertices if v.collides]
    assert scattered and {v.medium for v in scattered} == {"cube.interior_medium"}
    assert all(np.abs(v.position).max() < 1.5 for v in scattered)
    assert "in cube.interior_medium: position" in "".join(map(str, traces))
    with pytest.raises(ValueError, match="takes the params of the gradient"):
        psdr.trace_sample(scene, pixel=(x, y), sample=0, kind="interior")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube.interior_medium.scale", "floor.to_world"])
def test_the_path_of_a_gradient_is_that_of_what_is_requested(name):
    """Some flights are made to collide: forward mode drops what the trace shows to be broken."""
    scene = psdr.load_dict(scenes.smoke())
    params = psdr.traverse(scene)
    params.requires_grad_only(name)
    integrator = psdr.PathIntegrator(max_depth=3, boundary=None)
    how = {"integrator": integrator, "kind": "interior", "params": params, "pixel": (12, 11)}
    forced = [psdr.trace_sample(scene, sample=i, **how) for i in range(64)]
    params.requires_grad_only("floor.bsdf.reflectance.value")
    free = [psdr.trace_sample(scene, sample=i, **how) for i in range(64)]
    count = [
        sum(trace.vertices[min(1, len(trace.vertices) - 1)].collides for trace in traces) for traces in (forced, free)
    ]
    assert count[0] > count[1] > 0
