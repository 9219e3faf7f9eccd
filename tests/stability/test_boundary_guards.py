"""Guards of the boundary term's estimators: what comes out without one is not finite, or belongs to another place."""

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr.curves import scene_curves
from warp_psdr.edges import curve_edges
from warp_psdr.kernels.boundary.curve import MAX_SHIFT, make_curve_segment
from warp_psdr.kernels.boundary.local_form import Edges, edge_point, edge_step
from warp_psdr.kernels.structs import Scene

from .test_crossing import camera, plates


def test_a_path_vertex_on_a_curve_is_near_it_and_has_a_density() -> None:
    """Plates that cross at an angle of 3e-3, and directions of all of the hemisphere's rim.

    Three ray epsilons above the other plate is a thousand of them off the curve, one in a hundred of the scene.
    """
    floor = {"type": "rectangle"}
    scene = psdr.load_dict({"type": "scene", "camera": camera(), "floor": floor} | plates(3e-3, 1.0, 1.5))
    segment = make_curve_segment(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config)
    edges = curve_edges(scene, scene_curves(scene))

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(
        scene: Scene,
        edges: Edges,
        u4: wp.array(dtype=wp.vec4),
        scale_out: wp.array(dtype=wp.float32),
        steps_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        point = edge_point(scene, edges, i, u4.shape[0], 0.5)
        s = segment(scene, edges, point, i % 2, u4[i])
        if s.valid == 1:
            scale_out[i] = s.scale
            steps_out[i] = wp.length(s.x - point.x) / edge_step(scene, edges, point.edge)

    rim = np.linspace(0.0, 0.99999994, 1 << 14, dtype=np.float32)
    ends = [np.stack([rim, np.full_like(rim, end)]) for end in (0.0, 0.99999994)]
    u = np.concatenate([*ends, *(end[::-1] for end in ends)], axis=1)
    u4 = np.concatenate([u, np.random.default_rng(1).random(u.shape, np.float32)]).T
    scale, steps = wp.zeros(len(u4), dtype=wp.float32), wp.zeros(len(u4), dtype=wp.float32)
    wp.launch(drawn, len(u4), [scene.data(), edges, wp.array(u4, dtype=wp.vec4)], [scale, steps])
    assert np.isfinite(scale.numpy()).all() and scale.numpy().any()
    assert 0.9 * MAX_SHIFT < steps.numpy().max() < 1.01 * MAX_SHIFT
