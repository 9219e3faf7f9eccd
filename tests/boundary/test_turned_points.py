"""Points at which interpolated normals of grids turn away: the length of the curve that an eye sees of a sphere."""

import numpy as np
import pytest
import warp as wp

from tests.path.test_sdfgrid import sphere
from warp_psdr.kernels.boundary.shading_normals.turned_points import make_turned_point
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    GridItems,
    choose_item,
    eye_in_voxels,
    item_parts,
)
from warp_psdr.kernels.primitive.sdfgrid import grid_of
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, grid_shapes

from .etendue import LIMIT, loaded, spread

TURNED_POINT = make_turned_point()
SAMPLES = 400_000
RADIUS = 0.4


@wp.kernel(module="unique", enable_backward=False)
def turn_away(
    scene: Scene,
    found: GridItems,
    target: wp.array(dtype=wp.float32),
    eye: wp.vec3,
    out: wp.array(dtype=wp.float64),
):
    """One over the density of a point of the curve, as seen from a direction."""
    t = wp.tid()
    state = wp.rand_init(3, t)
    count = found.items.shape[0]
    n, _along = choose_item(found, count, wp.float64(wp.randf(state)))
    item = found.items[n]
    tri = triangle_at(scene, item[0])
    g = grid_of(scene, tri)
    parts = item_parts(g, item[1])
    if parts[3] != VOXEL_ITEM:
        return
    seen = eye_in_voxels(tri, g, eye, True)
    p = TURNED_POINT(scene, target, tri, g, parts, seen, True, wp.randf(state), wp.randf(state))
    if p.touch.valid == 1:
        out[t] = wp.float64(wp.float32(count) * p.touch.roots * wp.length(p.touch.along) / p.touch.density)


@pytest.mark.parametrize("count", [16, 17])
def test_length_of_the_curve(count: int) -> None:
    """Along an axis it runs through the middles of voxels, where the surface is upright, or between voxels."""
    scene = loaded(sphere(count, RADIUS), normals="smooth")
    found = grid_items(scene, grid_shapes(scene), None)
    target = wp.zeros(1, dtype=wp.float32, device=scene.device)
    for eye in ([0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.31, 0.21, 0.93]):
        way = wp.vec3(*(np.array(eye) / np.linalg.norm(eye)))
        out = wp.zeros(SAMPLES, dtype=wp.float64, device=scene.device)
        wp.launch(turn_away, SAMPLES, inputs=[scene.data(), found, target, way], outputs=[out], device=scene.device)
        length, error = spread(out.numpy())
        assert abs(length - 2.0 * np.pi * RADIUS) < LIMIT * error < 0.1 * length, (eye, length, error)
