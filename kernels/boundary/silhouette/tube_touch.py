"""Curves with a radius as a family of touches (``touch.py``): silhouettes, open ends, and creases at joints.

Items are parts of segments (``tube_points.py``); of B-splines their sides and open ends, of straight segments sides and
spheres. At a crease, where the cones of two straight segments meet, the light of the surface jumps.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``, ``#joints``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.film_edge import BESIDE
from warp_psdr.kernels.boundary.guiding.slots import choose_slot
from warp_psdr.kernels.boundary.silhouette.ends import SourceEnd
from warp_psdr.kernels.boundary.silhouette.touch import FRONT, SLOT_LENS, DrawnItem, Passing, Touch
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    LOOKS,
    PART_CREASE,
    TubeItems,
    TubePoint,
    ahead_of_tube,
    beside_tube,
    choose_tube,
    in_front,
    tube_coordinates,
    tube_curvature,
    tube_outline,
    tube_seen,
)
from warp_psdr.kernels.boundary.silhouette.tube_sampling import (
    drawn_touch_density,
    own_touch,
    own_touch_density,
    seen_touch_density,
)
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.primitive.curve_kinds import CONES, CURVES
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.structs import Scene

#: Sample slot of the root around a circle.
SLOT_AROUND = 2


@wp.func
def tube_item(found: TubeItems, n: wp.int32, along: wp.float32, chance: wp.float32) -> DrawnItem:
    r = DrawnItem()
    r.number = n
    r.face = found.items[n][0]
    r.along = along
    r.chance = chance
    r.aims = found.share < 1.0
    r.factor = 1.0
    return r


@wp.func
def draw_tube(found: TubeItems, own: wp.bool, u: wp.float64) -> DrawnItem:
    n, along, chance = choose_tube(found, u)
    return tube_item(found, n, along, chance)


@wp.func
def draw_guided_tube(found: TubeItems, own: wp.bool, u: wp.float64, weight: wp.float32) -> DrawnItem:
    n, along, size = choose_slot(found.slots, own, u)
    r = tube_item(found, n, along, wp.float32(found.cdf[n + 1] - found.cdf[n]))
    r.factor = weight * r.chance / size
    return r


@wp.func
def drawn_tube_seen(
    scene: Scene, found: TubeItems, drawn: DrawnItem, eye: wp.vec3, distant: wp.bool, choice: wp.float32
) -> TubePoint:
    tri = scene.triangles[drawn.face]
    return tube_seen(scene, tri, drawn.face, found.items[drawn.number][1], eye, distant, drawn.along, choice)


@wp.func
def tube_own(
    scene: Scene, found: TubeItems, drawn: DrawnItem, u: wp.vec3, choice: wp.float32
) -> tuple[TubePoint, wp.vec3]:
    tri = scene.triangles[drawn.face]
    touch = own_touch(scene, tri, drawn.face, found.items[drawn.number][1], drawn.along, u)
    return touch.point, touch.w


@wp.func
def tube_passing(scene: Scene, point: TubePoint, w: wp.vec3, step: wp.float32, reach: wp.float32) -> Passing:
    r = Passing()
    curvature = tube_curvature(point, w)
    r.shows = wp.where(in_front(point, w, curvature), 1, 0)
    r.out = point.out
    r.normal = -point.out
    r.beside = beside_tube(point, step)
    r.start = point.x + r.beside * point.out
    r.apart = beside_tube(point, BESIDE * step)
    r.most = 0.25 * point.f.r
    if point.part == PART_CREASE:
        r.crease = 1
        r.out = wp.normalize(wp.cross(point.along, w))
        r.normal = r.out
        r.start = point.x - FRONT * step * w
    elif point.rim == 0:
        r.curvature = curvature
    return r


@wp.func
def tube_meets(point: TubePoint, outside: wp.bool, face: wp.int32, beyond: wp.float32, ahead: wp.float32) -> wp.bool:
    # The curve may come back farther behind.
    return face == point.face and beyond < ahead


@wp.func
def tube_scale(point: TubePoint, drawn: DrawnItem, samples: wp.float32) -> wp.float32:
    return point.choices / (drawn.chance * samples)


@wp.func
def tube_own_scale(
    scene: Scene, point: TubePoint, drawn: DrawnItem, w: wp.vec3, curvature: wp.float32, samples: wp.float32
) -> wp.float32:
    density = drawn.chance * own_touch_density(point, w, curvature)
    if not density > 0.0:
        return 0.0
    return 1.0 / (density * samples)


@wp.func
def tube_own_density(
    scene: Scene, found: TubeItems, point: TubePoint, drawn: DrawnItem, w: wp.vec3, curvature: wp.float32
) -> wp.float32:
    return found.share * drawn.chance * own_touch_density(point, w, curvature)


@wp.func
def tube_aimed_density(
    scene: Scene, found: TubeItems, point: TubePoint, drawn: DrawnItem, w: wp.vec3, end: SourceEnd
) -> wp.float32:
    # A segment that was aimed at a light ends where its point was seen from.
    seen = wp.float32(0.0)
    if end.aimed:
        seen = drawn_touch_density(point, w)
    else:
        seen = seen_touch_density(point, end.y, end.distant, w)
    return (1.0 - found.share) * drawn.chance * end.towards * seen


@wp.func
def weigh_tube(
    point: TubePoint, drawn: DrawnItem, scale: wp.float32, samples: wp.float32, length: wp.float32
) -> wp.float32:
    return scale / samples * (drawn.factor * length)


@functools.cache
def make_tube_touch(primitives: tuple[int, ...], sampler_kind: str) -> Touch:
    """Return the functions of curves."""
    numbers = make_sampler(sampler_kind)
    sample_1d = numbers.sample_1d
    sample_4d = numbers.sample_4d

    @wp.func
    def tube_choice(sampler: Sampler, of_camera: wp.bool) -> wp.float32:
        if of_camera:
            return sample_4d(sampler, SLOT_LENS)[2]
        return sample_1d(sampler, SLOT_AROUND)

    def make_sink(role: str) -> wp.Function:
        return make_tube_sink(role, primitives)

    return Touch(
        items=TubeItems, point=TubePoint, choice=tube_choice, draw=draw_tube,
        draw_guided=draw_guided_tube, seen=drawn_tube_seen, own=tube_own, passing=tube_passing,
        ahead=ahead_of_tube, meets=tube_meets, scale=tube_scale, own_scale=tube_own_scale, own_density=tube_own_density,
        aimed_density=tube_aimed_density, weigh=weigh_tube, outline=tube_outline, held=tube_coordinates,
        make_sink=make_sink, tries=LOOKS, hides=CURVES,
        creases=CONES.number in primitives,
    )  # fmt: skip
