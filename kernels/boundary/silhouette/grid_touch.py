"""Grids of signed distances as a family of touches (``touch.py``) [ZCM*24]: creases and smooth silhouettes.

Items are faces and voxels (``grid_points.py``, ``grid_sampling.py``); of cubic grids voxels alone
(``spline_points.py``), and of networks cells (``network_points.py``). Each file ends with its ``VoxelFunctions``.

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.film_edge import BESIDE
from warp_psdr.kernels.boundary.guiding.slots import choose_slot
from warp_psdr.kernels.boundary.path_space.direction import pdf_wedge
from warp_psdr.kernels.boundary.silhouette.ends import SourceEnd
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    TouchPoint,
    VoxelFunctions,
    ahead_of_sheet,
    choose_item,
    crease_side,
    eye_in_voxels,
    from_voxels,
    item_parts,
    shows_both_sheets,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import (
    front_direction,
    front_wedge,
    own_density,
    own_direction,
)
from warp_psdr.kernels.boundary.silhouette.spline_points import SLOT_ROOT
from warp_psdr.kernels.boundary.silhouette.touch import FRONT, DrawnItem, Passing, Touch
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.primitive.sdfgrid import pack
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.structs import Scene


@functools.cache
def make_grid_touch(primitives: tuple[int, ...], sampler_kind: str, voxels: VoxelFunctions) -> Touch:
    """Return the functions of grids."""
    record, seen, place, make_sink = voxels.record, voxels.seen, voxels.place, voxels.make_sink
    curvature_of, direction, density = voxels.curvature, voxels.direction, voxels.density
    sample_1d = make_sampler(sampler_kind).sample_1d

    @wp.func
    def grid_choice(sampler: Sampler, of_camera: wp.bool) -> wp.float32:
        if wp.static(voxels.roots):
            return sample_1d(sampler, wp.static(SLOT_ROOT))
        return 0.0

    @wp.func
    def grid_item(found: GridItems, n: wp.int32, along: wp.float32, own: wp.bool) -> DrawnItem:
        r = DrawnItem()
        r.number = n
        r.face = found.items[n][0]
        r.along = along
        r.chance = wp.float32(wp.where(own, found.items.shape[0], found.aimed))
        r.aims = n < found.aimed
        r.factor = 1.0
        return r

    @wp.func
    def draw_grid(found: GridItems, own: wp.bool, u: wp.float64) -> DrawnItem:
        n, along = choose_item(found, wp.where(own, found.items.shape[0], found.aimed), u)
        return grid_item(found, n, along, own)

    @wp.func
    def draw_guided_grid(found: GridItems, own: wp.bool, u: wp.float64, weight: wp.float32) -> DrawnItem:
        n, along, size = choose_slot(found.slots, own, u)
        r = grid_item(found, n, along, own)
        r.factor = weight / (size * r.chance)
        return r

    @wp.func
    def grid_seen(
        scene: Scene, found: GridItems, drawn: DrawnItem, eye: wp.vec3, distant: wp.bool, choice: wp.float32
    ) -> TouchPoint:
        tri = scene.triangles[drawn.face]
        g = record(scene, tri)
        parts = item_parts(g, found.items[drawn.number][1])
        r = seen(scene, tri, g, parts, eye_in_voxels(tri, g, eye, distant), distant, drawn.along, choice)
        r.face = drawn.face
        if wp.static(voxels.front):
            r.valid = r.valid * r.crease
        return r

    @wp.func
    def grid_own(
        scene: Scene, found: GridItems, drawn: DrawnItem, u: wp.vec3, choice: wp.float32
    ) -> tuple[TouchPoint, wp.vec3]:
        tri = scene.triangles[drawn.face]
        g = record(scene, tri)
        r = place(scene, tri, g, item_parts(g, found.items[drawn.number][1]), drawn.along, u[2], choice)
        r.face = drawn.face
        w = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(voxels.front):
            r.valid = r.valid * r.crease
            if r.valid == 1:
                w = front_direction(tri, g, r, wp.vec2(u[0], u[1]))
        elif r.valid == 1:
            w = own_direction(r, wp.vec2(u[0], u[1]))
        return r, w

    @wp.func
    def grid_passing(scene: Scene, point: TouchPoint, w: wp.vec3, step: wp.float32, reach: wp.float32) -> Passing:
        r = Passing()
        r.beside = step
        r.apart = BESIDE * step
        r.most = FAR
        r.out = point.out
        r.normal = -point.out
        r.start = point.x
        if wp.static(voxels.front):
            r.crease = 1
            r.shows = wp.where(shows_both_sheets(point, w), 1, 0)
            r.normal = wp.cross(point.along, w)
            r.out = wp.normalize(r.normal)
            r.start -= FRONT * step * w
        elif point.crease == 1:
            side = crease_side(point, w)
            r.shows = wp.where(side != 0.0, 1, 0)
            r.normal = side * wp.cross(point.along, w)
            r.out = -wp.normalize(r.normal)
            r.start += step * r.out
        else:
            tri = scene.triangles[point.face]
            r.curvature = curvature_of(tri, record(scene, tri), point, w)
            r.shows = wp.where(r.curvature > 0.0, 1, 0)
            r.start += step * r.out
        return r

    @wp.func
    def grid_ahead(point: TouchPoint, passing: Passing, w: wp.vec3, apart: wp.float32) -> wp.float32:
        if point.crease == 1:
            return apart * ahead_of_sheet(point, w, passing.out)
        return wp.sqrt(2.0 * apart / wp.max(passing.curvature, 1.0e-20))

    @wp.func
    def grid_meets(
        point: TouchPoint, outside: wp.bool, face: wp.int32, beyond: wp.float32, ahead: wp.float32
    ) -> wp.bool:
        return face == point.face

    @wp.func
    def grid_scale(point: TouchPoint, drawn: DrawnItem, samples: wp.float32) -> wp.float32:
        return drawn.chance / (point.density * samples) * point.roots

    @wp.func
    def grid_own_scale(
        scene: Scene, point: TouchPoint, drawn: DrawnItem, w: wp.vec3, curvature: wp.float32, samples: wp.float32
    ) -> wp.float32:
        found = wp.float32(0.0)
        if wp.static(voxels.front):
            found = 2.0 * point.density * pdf_wedge(front_wedge(point))
        else:
            tri = scene.triangles[point.face]
            found = own_density(tri, record(scene, tri), point, curvature)
        if not found > 0.0:
            return 0.0
        return drawn.chance / (found * samples) * point.roots

    @wp.func
    def grid_own_density(
        scene: Scene, found: GridItems, point: TouchPoint, drawn: DrawnItem, w: wp.vec3, curvature: wp.float32
    ) -> wp.float32:
        tri = scene.triangles[point.face]
        return found.share * own_density(tri, record(scene, tri), point, curvature) / wp.float32(found.items.shape[0])

    @wp.func
    def grid_aimed_density(
        scene: Scene, found: GridItems, point: TouchPoint, drawn: DrawnItem, w: wp.vec3, end: SourceEnd
    ) -> wp.float32:
        towards = point.density
        if point.crease == 0:
            tri = scene.triangles[point.face]
            g = record(scene, tri)
            t = direction(point, eye_in_voxels(tri, g, end.y, end.distant), end.distant)
            towards = density(t) / wp.length(wp.cross(from_voxels(tri, g, t), w))
        shown = wp.float32(found.aimed)
        if end.delta:
            return (1.0 - found.share) * towards / shown
        return (1.0 - found.share) * (end.towards * (towards / shown))

    @wp.func
    def weigh_grid(
        point: TouchPoint, drawn: DrawnItem, scale: wp.float32, samples: wp.float32, length: wp.float32
    ) -> wp.float32:
        return scale / samples * (drawn.factor * length) * point.roots

    @wp.func
    def grid_outline(scene: Scene, point: TouchPoint, w: wp.vec3) -> wp.vec3:
        if point.crease == 1:
            return point.along
        tri = scene.triangles[point.face]
        g = record(scene, tri)
        return from_voxels(tri, g, direction(point, eye_in_voxels(tri, g, w, True), True))

    @wp.func
    def grid_held(scene: Scene, point: TouchPoint) -> wp.vec2:
        return pack(point.q)

    return Touch(
        items=GridItems, point=TouchPoint, choice=grid_choice, draw=draw_grid,
        draw_guided=draw_guided_grid, seen=grid_seen, own=grid_own, passing=grid_passing,
        ahead=grid_ahead, meets=grid_meets, scale=grid_scale, own_scale=grid_own_scale, own_density=grid_own_density,
        aimed_density=grid_aimed_density, weigh=weigh_grid, outline=grid_outline, held=grid_held, make_sink=make_sink,
        creases=voxels.front,
    )  # fmt: skip
