"""Interfaces of media (Mitsuba's ``null``): which triangles are interfaces, and how a ray continues behind one.

A crossing needs only the point, the normal and the shape, so no interaction is made.

Derivation: ``docs/theory/media.md#paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import declaration_of
from warp_psdr.kernels.bsdf.null import NULL
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.step import TOUCH, largest_coordinate, step_beside, step_off_triangle
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig

#: Distance, over the largest coordinate, at which float32 tells the sides of an exact shape apart.
TOUCH_CURVED = 4.0e-6


@wp.struct
class PassedSurface:
    """A surface that a ray goes on behind."""

    shape: wp.int32
    ng: wp.vec3
    x: wp.vec3
    o: wp.vec3  # where the ray starts behind it


@wp.func
def told_apart(tri: Triangle) -> wp.float32:
    """Distance from an interface at which float32 tells its sides apart."""
    if is_primitive(tri):
        return TOUCH_CURVED * wp.max(wp.abs(tri.normal) + wp.abs(tri.p0) + wp.abs(tri.p1) + wp.abs(tri.p2))
    return TOUCH * largest_coordinate(tri)


def null_model_of(bsdfs: tuple[str, ...]) -> int:
    """Return the number of the model of surfaces that are not there; -1: there are none."""
    return next((i for i, key in enumerate(bsdfs) if declaration_of(key)[0] is NULL), -1)


@functools.cache
def make_null_surface(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``(is_interface, past)``.

    ``is_interface(scene, face) -> bool``: of a surface that is not there, face -1: False.
    ``past(scene, face, u, v, d) -> PassedSurface``: of any surface that a ray along d meets.
    """
    null_model = null_model_of(surfaces.bsdfs)
    position, _cross_of = make_position(surfaces.primitives)
    interaction = make_interaction(surfaces, lights)

    @wp.func
    def is_interface(scene: Scene, face: wp.int32) -> wp.bool:
        if wp.static(null_model < 0):
            return False
        if face < 0:
            return False
        return scene.bsdfs[scene.shapes[scene.triangles[face].shape].bsdf].model == null_model

    @wp.func
    def past(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3) -> PassedSurface:
        r = PassedSurface()
        if wp.static(len(surfaces.primitives) > 0):
            at = interaction.at(scene, face, u, v, d)
            r.shape = at.shape
            r.ng = at.ng
            r.x = at.x
            r.o = interaction.offset(at, d)
        else:
            tri = triangle_at(scene, face)
            r.shape = tri.shape
            r.ng = tri.normal
            r.x = position(tri, u, v)
            r.o = step_beside(r.x, r.ng, d, step_off_triangle(scene, tri))
        return r

    return is_interface, past
