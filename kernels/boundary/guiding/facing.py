"""The share of the lights for which an edge is a silhouette: tells guiding where to look, without a ray."""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.light_square import make_light_square
from warp_psdr.kernels.boundary.local_form import Edges, edge_at, facing_side
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig


@functools.cache
def make_facing_kernel(lights: LightConfig):
    """Return the kernel: one thread an edge; points (u_1, u_2) of the lights are the same for all edges.

    At an area light of triangles each point stands for its triangle, whose share is exact. The result is the root mean
    square over the points: with uniform coordinates the integrand is proportional to the share, and cells follow its
    second moment.
    """
    aim, _coordinates = make_light_square(lights)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def facing(
        # Scene:
        scene: Scene,
        edges: Edges,
        # In:
        first: wp.int32,
        points: wp.array(dtype=wp.vec2d),
        # Out:
        share_out: wp.array(dtype=wp.float32),
    ):
        number = first + wp.tid()
        middle = wp.float64(0.5) * (wp.float64(edges.cdf[number]) + wp.float64(edges.cdf[number + 1]))
        point = edge_at(scene, edges, middle)
        found = wp.float32(0.0)
        for i in range(points.shape[0]):
            direction = aim(scene, edges, point, points[i][0], points[i][1])
            if direction.valid == 1:
                if direction.face >= 0 and not is_primitive_at(scene, direction.face):
                    found += direction.share * direction.share
                elif facing_side(scene, edges, point, wp.normalize(point.p1 - point.p0), direction.w) != 0.0:
                    found += 1.0
        share_out[number] = wp.sqrt(found / wp.float32(points.shape[0]))

    return facing
