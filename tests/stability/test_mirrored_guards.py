"""Guards of the search for discontinuities through mirrors and glass (``kernels/boundary/discontinuity.py``)."""

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr.boundary.faces import face_tables
from warp_psdr.kernels.boundary.chain import Block
from warp_psdr.kernels.boundary.chain_pullback import Visit
from warp_psdr.kernels.boundary.discontinuity import make_crossing
from warp_psdr.kernels.boundary.line_search import MAX_VISITS
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.ray_differential import RayDifferential
from warp_psdr.kernels.boundary.rims import Tables
from warp_psdr.kernels.structs import Camera, Scene

from .sweeps import box, room

#: Somewhere, so that there is a search.
MIRROR = {
    "type": "rectangle",
    "to_world": psdr.Transform.translate([-2.5, 0.0, 1.0]) @ psdr.Transform.rotate([0, 1, 0], 90),
    "bsdf": {"type": "conductor", "material": "none"},
}


def test_seen_from_close_by_a_sunk_edge_is_its_own_background() -> None:
    """An edge inside of a wall, where the two touch, is behind the wall: tau is 1 there, not more.

    Points of the floor as near as five times that depth. What touches there is met at the same distance.
    """
    sunk, at = 5e-5, 0.6
    corners = [[-2.0, at - sunk, 0.0], [2.0, at - sunk, 0.0], [2.0, at - sunk, 2.0], [-2.0, at - sunk, 2.0]]
    extra = {"wall": {"type": "mesh", "vertices": corners, "faces": [[0, 1, 2], [0, 2, 3]]}, "mirror": MIRROR}
    description = room(extra=extra)
    vertices, faces = box((0.2, 0.1, 0.5), 0.5, 0.0)
    scene = psdr.load_dict(description | {"box": description["box"] | {"vertices": vertices, "faces": faces}})
    edges, tables = face_tables(scene)
    crossing = make_crossing(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=4)).config)

    @wp.kernel(module="unique", enable_backward=False)
    def crossed(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        x: wp.array(dtype=wp.vec3),
        toward: wp.vec3,
        out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        block = Block()
        block.x = x[i]
        block.n = wp.vec3(0.0, 0.0, 1.0)
        block.w0 = toward
        block.w1 = wp.normalize(wp.cross(wp.vec3(0.0, 0.0, 1.0), toward))
        block.ell = 1.0
        block.depth = 2
        block.first = 1
        a = RayDifferential()
        a.d = block.w1
        b = RayDifferential()
        b.d = wp.cross(block.w0, block.w1)
        visits = wp.zeros(shape=(wp.static(MAX_VISITS),), dtype=Visit)
        r = crossing(scene, camera, edges, tables, block, -1.0e-3, 1.0e-3, 0, a, b, visits, 1, 4)
        out[i, 0] = wp.float32(r.valid)
        out[i, 1] = wp.float32(r.edge)
        out[i, 2] = r.segment.tau

    toward = np.array([-1.0, 1.0, 1.0]) / np.sqrt(3.0)
    near = np.geomspace(5.0 * sunk, 1e-2, 64)[:, None]
    x = np.array([0.7, at - sunk, 0.0]) + near * (toward * [-1.0, -1.0, 0.0])
    out = wp.zeros((64, 3), dtype=wp.float32)
    arguments = [scene.data(), scene.camera(0), edges, tables, wp.array(x, dtype=wp.vec3), wp.vec3(*toward)]
    wp.launch(crossed, 64, arguments, [out])
    valid, edge, tau = out.numpy().T
    assert (valid == 1.0).all() and (edge == 1.0).all()
    assert tau.min() > 0.99 and tau.max() == 1.0
