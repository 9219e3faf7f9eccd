"""Exact shapes of all affine kinds as a family of touches (``touch.py``): smooth silhouettes, and rims.

On a smooth surface the density of a point and a tangent direction is uniform in area and theta. On a rim it is uniform
in u and the direction. A rim that a disk shares with a cylinder is a silhouette where both lie on one side; where one
lies on either side, both are seen from the front.

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``, ``#rims``, ``#rims-that-join``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.crossing.curve import MOST, OFF
from warp_psdr.kernels.boundary.film_edge import BESIDE
from warp_psdr.kernels.boundary.silhouette.dispatch import (
    choose_outline,
    make_coordinates,
    make_silhouette_sink,
    make_silhouettes,
)
from warp_psdr.kernels.boundary.silhouette.edge_on import EDGEWISE, is_beside
from warp_psdr.kernels.boundary.silhouette.ends import SourceEnd
from warp_psdr.kernels.boundary.silhouette.point import OutlineItem, SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.rim import is_open_end, make_neighbour, make_rims
from warp_psdr.kernels.boundary.silhouette.touch import FRONT, DrawnItem, Passing, Touch
from warp_psdr.kernels.constants import FAR, INV_FOUR_PI, INV_TWO_PI, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Scene, Triangle


@wp.struct
class OutlineItems:
    """Outlines as ``choose_outline`` takes them. ``share``: of the segments that are not drawn towards lights."""

    items: wp.array(dtype=OutlineItem)
    share: wp.float32


@wp.func
def no_choice(sampler: Sampler, of_camera: wp.bool) -> wp.float32:
    return 0.0


@wp.func
def draw_outline(found: OutlineItems, own: wp.bool, u: wp.float64) -> DrawnItem:
    r = DrawnItem()
    n, along = choose_outline(found.items, u)
    number = found.items[n].number
    r.number = n
    r.along = along
    r.face = wp.where(number < 0, -1 - number, number)
    r.chance = wp.float32(found.items.shape[0])
    r.aims = found.share < 1.0
    r.factor = 1.0
    return r


@wp.func
def draw_guided_outline(found: OutlineItems, own: wp.bool, u: wp.float64, weight: wp.float32) -> DrawnItem:
    r = draw_outline(found, own, u)
    r.factor = weight
    return r


@wp.func
def outline_scale(point: SilhouettePoint, drawn: DrawnItem, samples: wp.float32) -> wp.float32:
    return drawn.chance / samples


@wp.func
def weigh_outline(
    point: SilhouettePoint, drawn: DrawnItem, scale: wp.float32, samples: wp.float32, length: wp.float32
) -> wp.float32:
    # ``out`` is the boundary normal, one unit long.
    return scale * (drawn.chance / samples) * drawn.factor


@functools.cache
def make_exact_touch(primitives: tuple[int, ...], sampler_kind: str) -> Touch:
    """Return the functions of exact shapes."""
    silhouettes = make_silhouettes(primitives)
    rims = make_rims(primitives)
    neighbour = make_neighbour(primitives)
    coordinates = make_coordinates(primitives)

    @wp.func
    def tangent_of(tri: Triangle, point: SilhouettePoint, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
        """dx/du of a rim, or of the silhouette from an eye."""
        rate = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(rims is not None):
            if point.item.number < 0:
                rate = rims.rate(tri, point.q)
        if wp.static(silhouettes is not None):
            if point.item.number >= 0:
                rate = silhouettes.rate(tri, eye, distant, point.q)
        return rate

    @wp.func
    def exact_seen(
        scene: Scene, found: OutlineItems, drawn: DrawnItem, eye: wp.vec3, distant: wp.bool, choice: wp.float32
    ) -> SilhouettePoint:
        tri = scene.triangles[drawn.face]
        item = found.items[drawn.number]
        p = SilhouettePoint()
        if wp.static(rims is not None):
            if item.number < 0:
                p = rims.seen(tri, drawn.face, drawn.along, eye, distant)
                if not is_open_end(item, p.q):
                    p.valid = 0
        if wp.static(silhouettes is not None):
            if item.number >= 0:
                p = silhouettes.seen(tri, drawn.face, eye, distant, drawn.along)
        p.item = item
        p.along = tangent_of(tri, p, eye, distant)
        return p

    @wp.func
    def exact_own(
        scene: Scene, found: OutlineItems, drawn: DrawnItem, u: wp.vec3, choice: wp.float32
    ) -> tuple[SilhouettePoint, wp.vec3]:
        tri = scene.triangles[drawn.face]
        item = found.items[drawn.number]
        p = SilhouettePoint()
        w = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(rims is not None):
            if item.number < 0:
                w = square_to_sphere(wp.vec2(u[0], u[1]))
                p = rims.seen(tri, drawn.face, drawn.along, w, True)
                if not is_open_end(item, p.q):
                    p.valid = 0
        if wp.static(silhouettes is not None):
            if item.number >= 0:
                p = silhouettes.place(tri, drawn.face, wp.vec2(drawn.along, u[0]))
                s_axis = any_tangent(p.out)
                theta = TWO_PI * u[1]
                w = wp.cos(theta) * s_axis + wp.sin(theta) * wp.cross(p.out, s_axis)
        p.item = item
        return p, w

    @wp.func
    def exact_passing(scene: Scene, point: SilhouettePoint, w: wp.vec3, step: wp.float32, reach: wp.float32) -> Passing:
        tri = scene.triangles[point.face]
        r = Passing()
        r.shows = 1
        r.out = point.out
        r.normal = -point.out
        r.beside = step
        r.start = point.x + step * point.out
        r.apart = BESIDE * step
        r.most = FAR
        if wp.static(silhouettes is not None):
            if point.item.number >= 0:
                r.curvature = silhouettes.curvature(tri, point.q, w)
        if wp.static(rims is not None):
            if point.item.number < 0:
                r.slant = rims.slant(tri, point.q, w)
        if wp.static(neighbour is not None):
            if point.item.number < 0 and point.item.neighbours[0] >= 0:
                # From outside or from within, the way to the eye does not pass the two surfaces.
                r.start = point.x - wp.min(FRONT * step, reach) * w
                wall = neighbour.into(scene, point.item, point.x)
                inner = is_beside(wall, -point.out, w, EDGEWISE)
                r.crease = wp.where(inner, 0, 1)
                if inner != is_beside(wall, point.out, w, EDGEWISE):
                    r.slant = wp.min(r.slant, neighbour.slant(scene, point.item, point.x, w))
                    sine = neighbour.corner(scene, point.item, point, w)
                    if sine > 0.0:
                        r.apart = step * wp.min(OFF / sine, MOST)
        return r

    @wp.func
    def exact_ahead(point: SilhouettePoint, passing: Passing, w: wp.vec3, apart: wp.float32) -> wp.float32:
        # At a depth s below the surface, a ray meets it sqrt(2 s / kappa) in front of the silhouette; beside a rim, s
        # over the slant.
        if point.item.number < 0:
            return apart / passing.slant
        return wp.sqrt(2.0 * apart / passing.curvature)

    @wp.func
    def exact_meets(
        point: SilhouettePoint, outside: wp.bool, face: wp.int32, beyond: wp.float32, ahead: wp.float32
    ) -> wp.bool:
        first = point.item.neighbours[0]
        if outside:
            return face == first
        # In front of a silhouette's end there may be a disk.
        return face == point.face or (face >= 0 and (face == first or face == point.item.neighbours[1]))

    @wp.func
    def exact_own_density(
        scene: Scene, found: OutlineItems, point: SilhouettePoint, drawn: DrawnItem, w: wp.vec3, curvature: wp.float32
    ) -> wp.float32:
        tri = scene.triangles[point.face]
        if wp.static(rims is not None):
            if point.item.number < 0:
                return found.share * INV_FOUR_PI / wp.length(wp.cross(rims.rate(tri, point.q), w))
        if wp.static(silhouettes is not None):
            return found.share * INV_TWO_PI * silhouettes.density(tri, point.q) / curvature
        return 0.0

    @wp.func
    def exact_aimed_density(
        scene: Scene, found: OutlineItems, point: SilhouettePoint, drawn: DrawnItem, w: wp.vec3, end: SourceEnd
    ) -> wp.float32:
        tangent = tangent_of(scene.triangles[point.face], point, end.y, end.distant)
        return (1.0 - found.share) * end.towards / wp.length(wp.cross(tangent, w))

    @wp.func
    def exact_outline(scene: Scene, point: SilhouettePoint, w: wp.vec3) -> wp.vec3:
        return tangent_of(scene.triangles[point.face], point, w, True)

    @wp.func
    def exact_held(scene: Scene, point: SilhouettePoint) -> wp.vec2:
        return coordinates(scene.triangles[point.face], point.q)

    return Touch(
        items=OutlineItems, point=SilhouettePoint, choice=no_choice, draw=draw_outline,
        draw_guided=draw_guided_outline, seen=exact_seen, own=exact_own, passing=exact_passing,
        ahead=exact_ahead, meets=exact_meets, scale=outline_scale, own_scale=None, own_density=exact_own_density,
        aimed_density=exact_aimed_density, weigh=weigh_outline, outline=exact_outline, held=exact_held,
        make_sink=make_silhouette_sink,
    )  # fmt: skip
