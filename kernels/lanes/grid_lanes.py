"""Rays of all lanes through a grid of signed distances, or the cells of a network (``primitive/sdfgrid_walk.py``).

Entering the block around the surface, and going on to the next voxel that the surface may pass, are loops over all
lanes, whose loads of reaches are gathers. Roots are found lane by lane, as soon as one in ``SHARE`` of the lanes at
work waits for one. Rays go through the same voxels as alone, by the same functions.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import Ray, RayHit
from warp_psdr.kernels.lanes.lanes import ROWS, SteppedLanes, stack_rows
from warp_psdr.kernels.primitive.sdfgrid import Grid
from warp_psdr.kernels.primitive.sdfgrid_walk import (
    VoxelPlace,
    VoxelRay,
    enter_grid,
    make_grid_walk,
    voxel_ray,
    walk_on,
)
from warp_psdr.kernels.structs import Scene, Triangle

#: One in so many of the lanes at work has to wait for a root until they are looked for (measured).
SHARE = 2


@wp.struct
class Waiting:
    """Numbers of lanes."""

    roots: wp.int32  # that stand in a voxel which the surface may pass
    all: wp.int32  # not at their end


def make_grid_lanes(width: int, first: int, cubic: bool, network: bool) -> SteppedLanes:
    """Make the functions for ``width`` lanes; ``first`` is the first row that they may take.

    Other arguments as ``make_sdfgrid_hit``'s.
    """
    walk = make_grid_walk(cubic, network)
    given, rays, places, waits, founds = stack_rows(width, first, Ray, VoxelRay, VoxelPlace, Waiting, RayHit)

    @wp.func
    def take(rows: ROWS, j: wp.int32, ray: Ray, wanted: wp.int32):
        given.put(rows, j, ray)
        wait = Waiting()
        wait.all = wanted
        waits.put(rows, j, wait)

    @wp.func
    def enter(tri: Triangle, g: Grid, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            ray = given.get(rows, j)
            r = voxel_ray(tri, g, ray.o, ray.d, ray.t_max)
            at = enter_grid(g, r)
            at.walks = at.walks * waits.get(rows, j).all
            hit = RayHit()
            hit.t = ray.t_max
            hit.face = -1
            rays.put(rows, j, r)
            places.put(rows, j, at)
            founds.put(rows, j, hit)
            j += 1

    @wp.func
    def go_on(scene: Scene, g: Grid, rows: ROWS) -> Waiting:
        """Every lane that waits for nothing goes on by a block of empty voxels."""
        total = Waiting()
        j = wp.int32(0)
        while j < width:
            at = places.get(rows, j)
            walks = at.walks == 1
            i = wp.where(walks, at.i, 0)
            reach = walk.reach(scene, g, i, wp.where(walks, at.j, 0), wp.where(walks, at.k, 0))
            waits_here = walks and reach == 0
            wait = Waiting()
            wait.roots = wp.where(waits_here, 1, 0)
            waits.put(rows, j, wait)
            n = walk_on(g, rays.get(rows, j), at, wp.max(reach - 1, 0))
            goes = walks and reach > 0
            at.s = wp.where(goes, n.s, at.s)
            at.i = wp.where(goes, n.i, at.i)
            at.j = wp.where(goes, n.j, at.j)
            at.k = wp.where(goes, n.k, at.k)
            at.walks = wp.where(goes, n.walks, at.walks)
            places.put(rows, j, at)
            total.roots += wait.roots
            total.all += at.walks
            j += 1
        return total

    @wp.func
    def find_roots(scene: Scene, g: Grid, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            if waits.get(rows, j).roots == 1:
                r = rays.get(rows, j)
                at = places.get(rows, j)
                root = walk.root(scene, g, r, at)
                at.sign = root.sign
                if root.t >= 0.0:
                    hit = founds.get(rows, j)
                    if root.t < hit.t:
                        hit.t = root.t
                        hit.u = root.q[0]
                        hit.v = root.q[1]
                        hit.face = 0
                        founds.put(rows, j, hit)
                    at.walks = 0
                else:
                    at = walk_on(g, r, at, 0)
                places.put(rows, j, at)
            j += 1

    @wp.func
    def closest(scene: Scene, tri: Triangle, rows: ROWS):
        g = walk.record(scene, tri)
        enter(tri, g, rows)
        total = go_on(scene, g, rows)
        while total.all > 0:
            if wp.static(SHARE) * total.roots >= total.all:
                find_roots(scene, g, rows)
            total = go_on(scene, g, rows)

    @wp.func
    def hit(scene: Scene, tri: Triangle, rows: ROWS, j: wp.int32) -> RayHit:
        return founds.get(rows, j)

    @wp.func
    def blocked(rows: ROWS, j: wp.int32) -> wp.bool:
        return founds.get(rows, j).face >= 0

    return SteppedLanes(take, closest, closest, hit, blocked, founds.end)
