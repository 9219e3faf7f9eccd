"""The ray offset: the step by which rays leave surfaces and pass edges, long for float32, short for small shapes.

The step is a multiple of u = 2^-24 times the largest coordinate. It is ``Scene.ray_epsilon`` for all triangles, or,
where shapes are too small for that, ``LEAVE`` (6.4 u) of the triangle's own largest coordinate, and ``Shape.edge_step``
past edges.

Derivation: ``docs/theory/numerics.md#steps-off-surfaces-and-past-edges``.
"""

import warp as wp

from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene, Triangle

#: Steps over the largest coordinate: of the scene; of the triangle that is left; at edges, of the shape and of what
#: touches it.
RAY_EPSILON = 1.0e-5
LEAVE = 4.0e-7
RESOLVED = 2.5e-6
TOUCH = 2.5e-7


@wp.func
def largest_coordinate(tri: Triangle) -> wp.float32:
    m = wp.max(wp.max(wp.abs(tri.p0), wp.abs(tri.p1)), wp.abs(tri.p2))
    return wp.max(m)


@wp.func
def step_off_triangle(scene: Scene, tri: Triangle) -> wp.float32:
    """Distance from a triangle, world units, at which the rays that leave it start."""
    return wp.where(scene.least_step <= 0.0, scene.ray_epsilon, LEAVE * largest_coordinate(tri))


@wp.func
def leaving_step(scene: Scene, face: wp.int32) -> wp.float32:
    """The same of the triangle with the number ``face``."""
    if scene.least_step <= 0.0:
        return scene.ray_epsilon
    return step_off_triangle(scene, triangle_at(scene, face))


@wp.func
def passing_step(scene: Scene, face: wp.int32) -> wp.float32:
    """The ray epsilon at the edges of a triangle, world units."""
    if scene.least_step <= 0.0:
        return scene.ray_epsilon
    return scene.shapes[scene.triangles[face].shape].edge_step


@wp.func
def step_beside(x: wp.vec3, ng: wp.vec3, d: wp.vec3, step: wp.float32) -> wp.vec3:
    """A point of a surface with the normal ``ng``, moved off it by ``step`` to the side of the direction ``d``."""
    return x + wp.where(wp.dot(ng, d) >= 0.0, step, -step) * ng
