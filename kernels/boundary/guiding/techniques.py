"""Sampling of boundary segments by two techniques [YLB*22, section 5], each with guiding cells of its own.

A point of the unit cube is an edge point and a direction. One technique draws the direction from the wedge between the
edge's faces, the other towards a point of a light. One-sample MIS with the balance heuristic joins the two.

Derivation: ``docs/theory/guiding.md#two-techniques``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.cells import Cells, CellSample, pdf_cells, sample_cells
from warp_psdr.kernels.boundary.guiding.light_square import make_light_square
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_at
from warp_psdr.kernels.boundary.path_space.direction import (
    Direction,
    Wedge,
    make_pdf_light,
    pdf_wedge,
    wedge_at,
    wedge_direction,
    wedge_square,
)
from warp_psdr.kernels.rng import UNIT
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig


@wp.struct
class Guide:
    """How segments are drawn. ``wedge`` and ``light`` are read by guided kernels, the rest by "target" kernels.

    Those do not sample but evaluate: at ``points``, or, where there are none, at ``samples`` points of every box (low,
    high), stratified by octants.
    """

    share: wp.float32  # of the wedge
    wedge: Cells
    light: Cells
    technique: wp.int32  # 1: wedge, 0: light
    points: wp.array(dtype=wp.vec3d)
    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Aim:
    """A point of the cube and what it stands for."""

    point: EdgePoint
    direction: Direction
    at: CellSample
    wedge: wp.int32  # 1: drawn from the wedge, 0: towards a light


@wp.func
def octant_point(low: wp.vec3, high: wp.vec3, octant: wp.int32, u4: wp.vec4) -> wp.vec3d:
    """Random point of an octant of a box: its bits 4, 2 and 1 say the upper half of the axes 0, 1 and 2."""
    r = wp.vec3d()
    for a in range(3):
        upper = (octant >> (2 - a)) & 1
        t = wp.float64(0.5) * (wp.float64(u4[a]) + wp.float64(upper))
        r[a] = wp.float64(low[a]) + t * (wp.float64(high[a]) - wp.float64(low[a]))
    return r


@functools.cache
def make_techniques(lights: LightConfig, guided: bool):
    """Return ``(sample, density, place)``; ``guided``: the cells are read, otherwise coordinates are uniform.

    ``sample(scene, edges, guide, v, u4) -> Aim``: ``v`` the stratified number, u4 further ones.
    ``density(scene, edges, guide, wedge, aim, face, u, v, t) -> float``: solid-angle density of the aim's direction at
    its edge coordinate, relative to the edges' own density of x_b; (face, u, v) is its first hit, at the distance t.
    ``place(scene, edges, u, technique) -> Aim``: what a point of the cube stands for (1: wedge, 0: light).
    """
    aim_light, light_coordinates = make_light_square(lights)
    pdf_light = make_pdf_light(lights)

    @wp.func
    def place(scene: Scene, edges: Edges, u: wp.vec3d, technique: wp.int32) -> Aim:
        r = Aim()
        r.at.u = u
        r.at.pdf = 1.0
        r.wedge = technique
        r.point = edge_at(scene, edges, u[0])
        if technique == 1:
            wedge = wedge_at(scene, edges, r.point)
            r.direction.w = wedge_direction(wedge, wp.vec2(wp.float32(u[1]), wp.float32(u[2])))
            r.direction.valid = 1
            r.direction.light = -1
            r.direction.face = -1
            r.direction.share = 1.0
        else:
            r.direction = aim_light(scene, edges, r.point, u[1], u[2])
        return r

    @wp.func
    def sample(scene: Scene, edges: Edges, guide: Guide, v: wp.float64, u4: wp.vec4) -> Aim:
        if wp.static(guided):
            share = wp.float64(guide.share)
            jitter = wp.vec3(u4[1], u4[2], u4[3])
            if v < share:
                at = sample_cells(guide.wedge, v / share, jitter)
                r = place(scene, edges, at.u, 1)
                r.at = at
            else:
                at = sample_cells(guide.light, (v - share) / (wp.float64(1.0) - share), jitter)
                r = place(scene, edges, at.u, 0)
                r.at = at
            return r
        else:
            fine = wp.float64(u4[1]) + wp.float64(UNIT) * wp.float64(u4[3])
            return place(scene, edges, wp.vec3d(v, fine, wp.float64(u4[2])), wp.where(u4[0] < guide.share, 1, 0))

    @wp.func
    def density(
        scene: Scene,
        edges: Edges,
        guide: Guide,
        wedge: Wedge,
        aim: Aim,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        t: wp.float32,
    ) -> wp.float32:
        if aim.direction.light >= 0:
            return (1.0 - guide.share) * aim.at.pdf
        w = aim.direction.w
        part = aim.direction.share
        p_light = aim.at.pdf
        p_wedge = aim.at.pdf
        j_light = pdf_light(scene, face, u, v, w, t)
        if aim.wedge == 1:
            if j_light > 0.0:
                at = light_coordinates(scene, edges, aim.point, face, u, v, w)
                part = wp.float32(at[2])
                if at[0] < wp.float64(0.0):
                    p_light = 0.0
                elif wp.static(guided):
                    p_light = pdf_cells(guide.light, wp.vec3d(aim.at.u[0], at[0], at[1]))
        elif wp.static(guided):
            square = wedge_square(wedge, w)
            p_wedge = pdf_cells(guide.wedge, wp.vec3d(aim.at.u[0], wp.float64(square[0]), wp.float64(square[1])))
        return guide.share * p_wedge * pdf_wedge(wedge) + (1.0 - guide.share) * p_light * j_light / part

    return sample, density, place
