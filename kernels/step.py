"""The step by which rays leave surfaces and look past edges: long enough for float32, short for what is small.

A ray that leaves a triangle must not meet it again. What it meets where is off by some roundings of the triangle's
coordinates *relative to the ray's origin*, and the origin by some of its own, so the step is a multiple of u = 2^-24
times the largest coordinate of that triangle. In most scenes one step serves all triangles, ``Scene.ray_epsilon``, a
generous 160 u of the largest coordinate of all. Where shapes are small for that (``Scene.least_step`` > 0):

* A ray leaves a triangle by ``LEAVE`` (6.4 u) of that triangle's largest coordinate. Measured, of 2.4 million points of
  turned squares, seen from anywhere and at angles down to 10^-4: at 1.6 u a share of 10^-3 meets its own square or the
  triangle beside, at 3.2 u none, for both ray backends.
* An edge is passed at ``RAY_EPSILON`` times the size of its shape, but at no less than ``RESOLVED`` (40 u) of the
  shape's largest coordinate (``primary.py`` and ``edge_sampling.py`` look past edges at a tenth of that), and no less
  than ``TOUCH`` (4 u) of the largest coordinate of whatever may touch the shape: so far a vast triangle that touches
  the edge may lie off its place. The host knows these (``scene/steps.py``): ``Shape.edge_step``.

So a small thing is as exact as a large one unless it touches something vast; at 10^-5 of what it touches, steps are
some percent of its size: float32 coordinates of vast triangles allow little more. Where the vast surface is cut into
small triangles near it, they do not count.
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
