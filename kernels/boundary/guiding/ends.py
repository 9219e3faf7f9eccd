"""Ends of boundary segments at points of the cube, for which a grid looks up its photon maps [ZMY*20, section 6.3].

With the radiance L_2 that leaves x_2 and the importance W_1 that leaves x_1, the integrand in the coordinates of a
technique is W_1 L_2 ``scale``. Here scale is sin(phi) dl / du_0 over the mean of the densities of the two techniques,
as in ``boundary/path_space/secondary.py``. The maps give W_1 and L_2, except the emission of x_2.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.techniques import Guide, make_techniques
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.path_space.direction import wedge_at
from warp_psdr.kernels.boundary.path_space.secondary import make_segment
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_ends_kernel(config: PathConfig):
    """Return the kernel: one thread a point of the cube; a scale of 0 says that no boundary segment is there."""
    segment_at = make_segment(config)
    point_at = make_point_at(config.surfaces.primitives)
    _sample, density, place = make_techniques(config.lights, False)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def ends(
        # Scene:
        scene: Scene,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
        # In:
        first: wp.int32,
        technique: wp.int32,
        direct: wp.bool,
        # Out:
        x1_out: wp.array(dtype=wp.vec3),
        x2_out: wp.array(dtype=wp.vec3),
        emitted_out: wp.array(dtype=wp.float32),
        scatters_out: wp.array(dtype=wp.int32),
        scale_out: wp.array(dtype=wp.float32),
    ):
        number = first + wp.tid()
        scale_out[number] = 0.0
        scatters_out[number] = 0
        aim = place(scene, edges, guide.points[number], technique)
        if aim.direction.valid == 0:
            return
        s = segment_at(scene, edges, moving, aim.point, aim.direction, direct)
        if s.valid == 0:
            return
        wedge = wedge_at(scene, edges, aim.point)
        pdf = density(scene, edges, guide, wedge, aim, s.face2, s.u2, s.v2, s.t2)
        scale_out[number] = (
            wp.length(s.boundary_normal) * wp.length(aim.point.p1 - aim.point.p0) / (aim.point.pdf * pdf)
        )
        x1_out[number] = point_at(scene, triangle_at(scene, s.face1), s.u1, s.v1)
        emitted_out[number] = s.radiance[0] + s.radiance[1] + s.radiance[2]
        if s.light < 0 and s.face2 >= 0:
            x2_out[number] = point_at(scene, triangle_at(scene, s.face2), s.u2, s.v2)
            scatters_out[number] = 1

    return ends
