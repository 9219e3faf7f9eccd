"""Boundary segments to point, spot and directional lights that pass masks and thin sheets.

Shadow rays to such lights pass surfaces by their null lobes (``kernels/transmittance.py``), so x_1 is any surface
behind the edge, not the first one alone, and what jumps is the transmittance of the whole segment: E (T_+ - T_-), of
the rays that pass the edge on either side. Each surface that is crossed counts as a path vertex.

Derivation: ``docs/theory/boundary.md#shadows-of-masks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.coincident import distance_to_plane, edge_share
from warp_psdr.kernels.boundary.detector import NEVER, ROW_COUNT, ROWS, Incident
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_behind
from warp_psdr.kernels.boundary.path_space.direction import Direction
from warp_psdr.kernels.boundary.path_space.edge_segment import edge_segment, moves
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR, LOBE_NULL
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.transmittance import (
    MOST_CROSSINGS,
    Passage,
    make_passage,
    most_crossings,
    transmittance_of,
)
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slot of the choice of x_1, beyond those of ``secondary.py`` and ``transport.py``.
SLOT_FIRST = 1 << 12


@wp.func
def counted(p: Passage, k: wp.int32, max_depth: wp.int32) -> wp.vec3:
    """The transmittance of a segment from the k-th vertex; 0 if it is blocked, or has more vertices than a path."""
    if p.blocked != 0 or p.crossings > most_crossings(k - 1, max_depth):
        return wp.vec3(0.0, 0.0, 0.0)
    return transmittance_of(p)


@functools.cache
def make_sheet_segment(config: PathConfig):
    """Return ``sheet_segment(scene, edges, moving, point, direction, sampler) -> Segment``, to a light of no area.

    Its ``radiance`` is the irradiance at the edge, its ``t2`` the distance of the light, and its ``scale`` lacks the
    densities of the edge point and the light.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf
    sample_1d = make_sampler(config.sampler).sample_1d

    @wp.func
    def sheet_segment(
        scene: Scene,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        point: EdgePoint,
        direction: Direction,
        sampler: Sampler,
    ) -> Segment:
        along = wp.normalize(point.p1 - point.p0)
        r, side, any_moves = edge_segment(scene, edges, moving, point, along, direction.w)
        if side == 0.0:
            return r
        r.light = direction.light
        r.radiance = direction.irradiance
        r.t2 = direction.distance
        # x_1 is one of all surfaces that the light reaches behind the edge.
        behind = edge_behind(scene, r.step)
        u = sample_1d(sampler, SLOT_FIRST)
        sum = wp.float32(0.0)
        chosen = wp.float32(0.0)
        passed = wp.vec3(1.0, 1.0, 1.0)
        start = r.x + behind * r.w
        count = wp.int32(0)
        r.face1 = -1
        while count <= MOST_CROSSINGS:
            hit = visibility.closest(scene, start, -r.w, FAR)
            count += 1
            if hit.face < 0:
                count = MOST_CROSSINGS + 1
            else:
                at = interaction.at(scene, hit.face, hit.u, hit.v, -r.w)
                t = wp.dot(r.x - at.x, r.w)
                weight = wp.max(passed)
                if bsdf.has_smooth(at.model) and t > r.step and weight > 0.0:
                    sum += weight
                    share = weight / sum
                    if u < share:
                        u /= share
                        chosen = weight
                        r.face1 = hit.face
                        r.u1 = hit.u
                        r.v1 = hit.v
                        r.t1 = t
                    else:
                        u = (u - share) / (1.0 - share)
                if bsdf.has_null(at.model):
                    passed = wp.cw_mul(passed, interaction.scatter(at, LOBE_NULL).value)
                    start = interaction.offset(at, -r.w)
                else:
                    count = MOST_CROSSINGS + 1
        if r.face1 < 0:
            return r
        if any_moves + moves(scene, moving, r.face1) == 0:
            return r
        if direction.distance < 0.5 * FAR:
            r.tau = r.t1 / (r.t1 + direction.distance)
        r.scale = edge_share(scene, edges, point, along, r.w, side) * sum / chosen
        r.valid = 1
        return r

    return sheet_segment


@functools.cache
def make_sheet_source(config: PathConfig, others: wp.Function):
    """Return a source of radiance: of segments to lights of no area what jumps, of all other segments ``others``."""
    passage = make_passage(config, False)

    @wp.func
    def sheet_source(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        if s.light < 0:
            return others(scene, sampler, s, k, max_depth, rr_depth)
        inside = s.x + (2.0 * s.step / wp.length(s.boundary_normal)) * s.boundary_normal
        way_out = distance_to_plane(scene, s.face1, s.x, s.w, 0.0)
        way_in = distance_to_plane(scene, s.face1, inside, s.w, 0.0)
        reach = wp.min(s.t2, FAR)
        free = passage(scene, s.x - way_out * s.w, s.w, wp.min(way_out + reach, FAR), MOST_CROSSINGS)
        hidden = passage(scene, inside - way_in * s.w, s.w, wp.min(way_in + reach, FAR), MOST_CROSSINGS)
        r = Incident()
        r.first = k
        r.cut = NEVER
        r.total = wp.cw_mul(s.radiance, counted(free, k, -1) - counted(hidden, k, -1))
        if max_depth >= 0:
            r.cut = 0
            rows = ROWS()
            for i in range(ROW_COUNT):
                row = counted(free, k + i, max_depth) - counted(hidden, k + i, max_depth)
                row = wp.cw_mul(s.radiance, row)
                for c in range(3):
                    rows[i, c] = row[c]
            r.rows = rows
        return r

    return sheet_source
