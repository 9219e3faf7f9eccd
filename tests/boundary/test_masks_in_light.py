"""A leaf with soft holes under a point light, whose light through it counts or is left out."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import assert_transposes
from .scenes import T
from .test_light_frame import assert_slope, film, shift

HOLES = np.random.default_rng(1).uniform(0.1, 0.9, (4, 4, 1)).astype(np.float32)
LEFT_OUT = {"caustics": False}


def leaf(**objects):
    opacity = {"type": "bitmap", "bitmap": HOLES, "raw": True}
    bsdf = {"type": "mask", "opacity": opacity, "nested": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    view = T.look_at([0.2, -3.0, 1.5], [0.0, 0.0, 0.2], [0, 0, 1])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40.0, "to_world": view, "film": film("gaussian")},
            "floor": {"type": "rectangle", "to_world": T.scale(2)},
            "leaf": {
                "type": "rectangle",
                "to_world": T.translate([0.1, 0, 0.6]) @ T.rotate([1, 0.3, 0], 15) @ T.scale(0.5),
                "bsdf": bsdf,
            },
            **objects,
            "lamp": {"type": "point", "position": [0.3, 0.0, 2.5], "intensity": {"type": "rgb", "value": 10.0}},
        }
    )
    return scene, psdr.traverse(scene)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leaf.to_world", "lamp.position", "sensor.to_world"])
def test_a_leaf_under_a_point_light_moves(name) -> None:
    scene, params = leaf()
    way = [1.0, 0.3, 0.2]
    tangent = np.array(way) if name == "lamp.position" else shift(*way)
    assert_slope(scene, params, name, tangent, 0.01, depth=3, spp=1024, difference_spp=8192, **LEFT_OUT)
    options = {"integrator": psdr.PathIntegrator(max_depth=3, **LEFT_OUT), "spp": 32, "seed": 2}
    assert_transposes(scene, params, [name], options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leaf.to_world", "lamp.position", "sensor.to_world"])
def test_what_the_point_light_sends_through_the_leaf_moves_too(name) -> None:
    scene, params = leaf()
    way = [1.0, 0.3, 0.2]
    tangent = np.array(way) if name == "lamp.position" else shift(*way)
    assert_slope(scene, params, name, tangent, 0.01, depth=3, spp=1024, difference_spp=8192)


@pytest.mark.slow
def test_a_mirror_shows_the_shadow_of_the_leaf() -> None:
    pose = T.translate([0, 0.9, 0.6]) @ T.rotate([1, 0, 0], 80) @ T.scale([0.9, 0.6, 1])
    scene, params = leaf(mirror={"type": "rectangle", "to_world": pose, "bsdf": {"type": "conductor"}})
    assert_slope(scene, params, "leaf.to_world", shift(1.0, 0.3, 0.2), 0.01, depth=5, spp=1024, difference_spp=8192)


@pytest.mark.slow
def test_light_through_the_leaf_moves_alike_in_both_modes() -> None:
    scene, params = leaf()
    assert_transposes(scene, params, ["leaf.to_world"], {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 8})
