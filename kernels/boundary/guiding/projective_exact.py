"""Seeds of segments that touch exact shapes: ordinary path segments, projected to the outline [ZRJ23, section 4].

A ray from a path vertex x_1 that ends on an exact shape is projected in closed form (``silhouette/project.py``), to the
smooth outline or the rim, whichever is nearer as seen from x_1. The outline that the light point sees gives a second
seed.

Derivation: ``docs/theory/guiding.md#projection-to-exact-shapes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.path_segments import (
    BLOCKED,
    BLOCKED_LIGHT,
    SLOT_SEED,
    make_candidate,
    seed_sampler,
)
from warp_psdr.kernels.boundary.silhouette.aim import make_aim_square
from warp_psdr.kernels.boundary.silhouette.dispatch import make_silhouettes
from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.boundary.silhouette.point import SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.project import make_projections
from warp_psdr.kernels.boundary.silhouette.rim import make_rims
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent, share_of_turn
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import from_axes, is_primitive_at
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import make_sampler
from warp_psdr.kernels.sampling import sphere_to_square
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class OutlinePoint:
    """A point of an outline as seen from an eye; ``item`` -1: none."""

    item: wp.int32
    rim: wp.bool
    u: wp.float32  # along the outline
    point: SilhouettePoint
    w: wp.vec3  # unit, from the eye to the point


@wp.func
def item_of(found: OutlineItems, number: wp.int32) -> wp.int32:
    """Place of an outline in the list; -1: it is not in it."""
    for k in range(found.items.shape[0]):
        if found.items[k].number == number:
            return k
    return -1


@functools.cache
def make_outline_projection(primitives: tuple[int, ...]):
    """Return ``project(scene, found, face, u, v, eye, d) -> OutlinePoint``: of a ray (eye, d) and its hit."""
    silhouettes = make_silhouettes(primitives)
    rims = make_rims(primitives)
    near = make_projections(primitives)
    point_at = make_point_at(primitives)

    @wp.func
    def project(
        scene: Scene, found: OutlineItems, face: wp.int32, u: wp.float32, v: wp.float32, eye: wp.vec3, d: wp.vec3
    ) -> OutlinePoint:
        r = OutlinePoint()
        r.item = -1
        tri = scene.triangles[face]
        q = from_axes(tri, point_at(scene, tri, u, v) - tri.normal)
        if wp.static(silhouettes is not None):
            item = item_of(found, face)
            if item >= 0:
                along = near.outline(tri, eye, q)
                if along >= 0.0:
                    r.item = item
                    r.u = along
                    r.point = silhouettes.seen(tri, face, eye, False, along)
                    r.w = wp.normalize(r.point.x - eye)
        if wp.static(rims is not None):
            rim = item_of(found, -1 - face)
            if rim >= 0:
                along = near.rim(tri, q)
                point = rims.seen(tri, face, along, eye, False)
                w = wp.normalize(point.x - eye)
                if point.valid == 1 and (r.item < 0 or wp.dot(w, d) > wp.dot(r.w, d)):
                    r.item = rim
                    r.rim = True
                    r.u = along
                    r.point = point
                    r.w = w
        return r

    return project


@functools.cache
def make_own_numbers(primitives: tuple[int, ...]):
    """Return ``own(scene, found, seen) -> vec3d``: the numbers with which the technique "wedge" draws a segment."""
    near = make_projections(primitives)

    @wp.func
    def own(scene: Scene, found: OutlineItems, seen: OutlinePoint) -> wp.vec3d:
        count = wp.float64(found.items.shape[0])
        first = seen.u
        rest = sphere_to_square(seen.w)
        if wp.static(near.square is not None):
            if not seen.rim:
                square = near.square(scene.triangles[seen.point.face], seen.point.q)
                first = square[0]
                s_axis = any_tangent(seen.point.out)
                t_axis = wp.cross(seen.point.out, s_axis)
                rest = wp.vec2(square[1], share_of_turn(wp.dot(seen.w, t_axis), wp.dot(seen.w, s_axis)))
        u0 = (wp.float64(seen.item) + wp.float64(wp.min(first, 0.9999999))) / count
        return wp.vec3d(u0, wp.float64(rest[0]), wp.float64(rest[1]))

    return own


@functools.cache
def make_exact_seeds_kernel(config: PathConfig, kind: int):
    """Return the kernel: one thread a camera path and its seed (``kind`` as in ``projective.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    candidate = make_candidate(config, kind)
    project = make_outline_projection(config.surfaces.primitives)
    own_numbers = make_own_numbers(config.surfaces.primitives)
    to_light = kind == BLOCKED_LIGHT
    aim_square = make_aim_square(config.lights) if to_light else None
    sample_1d = make_sampler(config.sampler).sample_1d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def exact_seeds(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: OutlineItems,
        radius: wp.float32,
        # In:
        job: SampleJob,
        # Out:
        weight_out: wp.array(dtype=wp.float32),
        wedge_out: wp.array(dtype=wp.vec3d),
        light_out: wp.array(dtype=wp.vec3d),
    ):
        number = job.first + wp.tid()
        outside = wp.vec3d(wp.float64(-1.0), wp.float64(-1.0), wp.float64(-1.0))
        weight_out[number] = 0.0
        wedge_out[number] = outside
        light_out[number] = outside
        kept, total = candidate(scene, camera, radius, number, job.seed, job.max_depth, job.rr_depth)
        weight_out[number] = total
        if total <= 0.0:
            return
        if is_primitive_at(scene, kept.face):
            hit = visibility.closest(scene, kept.o, kept.d, FAR)
            if hit.face == kept.face:
                seen = project(scene, found, hit.face, hit.u, hit.v, kept.o, kept.d)
                if seen.item >= 0:
                    wedge_out[number] = own_numbers(scene, found, seen)
        if wp.static(to_light):
            back = wp.normalize(kept.o - kept.light)
            apart = wp.length(kept.o - kept.light)
            hit2 = visibility.closest(scene, kept.light + (1.0 - BLOCKED) * apart * back, back, apart)
            if is_primitive_at(scene, hit2.face):
                lit = project(scene, found, hit2.face, hit2.u, hit2.v, kept.light, back)
                if lit.item >= 0:
                    along = (wp.float64(lit.item) + wp.float64(lit.u)) / wp.float64(found.items.shape[0])
                    sampler, _pixel = seed_sampler(camera, number, job.seed)
                    at = wp.vec2d(kept.coordinate, wp.float64(sample_1d(sampler, SLOT_SEED - 1)))
                    if kept.coordinate < wp.float64(0.0):
                        at = aim_square(scene, kept.light_face, kept.light_u, kept.light_v, -back)
                    light_out[number] = wp.vec3d(along, at[0], at[1])

    return exact_seeds
