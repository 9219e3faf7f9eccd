"""The terms of a boundary method: which kernel runs over how many samples, and with what.

Every kind of discontinuity is one function of ``Request`` that returns a ``Term``, or None where it provably does not
move or does not exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.edge_sampling.edge_sampling import make_edge_sampling_kernel
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import MAX_SPLIT
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.curve import make_curve_kernel
from warp_psdr.kernels.boundary.path_space.facets import make_facets_kernel
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.kernels.boundary.path_space.secondary import make_secondary_kernel
from warp_psdr.kernels.boundary.shading_normals.bent import make_bent_kernel
from warp_psdr.kernels.boundary.shading_normals.horizon import make_horizon_kernel
from warp_psdr.kernels.boundary.shading_normals.terminator import make_terminator_kernel
from warp_psdr.kernels.boundary.specular.line_search import make_line_search_kernel
from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes, has_smooth_lobes
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.kernels.structs import Emitter
from warp_psdr.options.boundary import DEFAULT_CANDIDATES, Connecting, EdgeSampling, Method, PathSpace, Projective
from warp_psdr.plan.motion import Motion, motion, moving_shapes
from warp_psdr.scene.light_sampling import cumulative
from warp_psdr.topology.bent import bent_choice, terminator_faces
from warp_psdr.topology.clip_planes import require_uncut
from warp_psdr.topology.curves import moving_curves, scene_curves
from warp_psdr.topology.edge_trees import edge_trees
from warp_psdr.topology.edges import curve_edges, select
from warp_psdr.topology.faces import face_tables
from warp_psdr.topology.film_edges import FilmEdges, crease_edges, facet_edges, film_edges, primary_edges
from warp_psdr.topology.secondary_edges import secondary_edges

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Share of the segments whose direction is drawn from the wedge instead of towards a light. With direct light of lights
#: that are not at infinity, what is not a light contributes nothing.
WEDGE_SHARE_DIRECT, WEDGE_SHARE = 0.1, 0.5
#: Sub-streams of the boundary term's random numbers.
PRIMARY, SECONDARY, TERMINATOR, CURVE, BENT, EDGE_SAMPLING, HORIZON, CREASES, FACETS = range(9)
THROUGH_MIRRORS = 100
#: Roulette ends paths behind a discontinuity so many vertices earlier than those of the image: their first vertices are
#: what makes boundary samples differ. By default, from the first one on.
ROULETTE_EARLIER = 4


@dataclass(frozen=True)
class Term:
    """One launch.

    Attributes:
        kernel: one thread a sample; its last two parameters are the target and the image.
        inputs: (number of the first sample, adjoint) -> the arguments in front of them, the scene's record first.
        samples: how many.
        kind: the term's name.
    """

    kernel: wp.Kernel
    inputs: Callable[[int, wp.array], list]
    samples: int
    kind: str = ""


@dataclass(frozen=True)
class Request:
    """What a boundary term is asked for.

    Attributes:
        scene: the scene.
        plan: with the method in ``boundary``.
        moves: what moves.
        role: "reverse" or "forward"; "samples" for ``edge_fields``.
        sensor: which camera.
        spp: samples a pixel of the interior term.
        seed: of the boundary term's stream.
        indirect: paths of two vertices are left out, of the terms in ``SPLIT``.
    """

    scene: Scene
    plan: Plan
    moves: Motion
    role: str
    sensor: int
    spp: int
    seed: int
    indirect: bool = False

    @property
    def camera(self) -> Camera:
        """The camera's record."""
        return self.scene.camera(self.sensor)

    @property
    def rr_depth(self) -> int:
        """From which vertex on roulette ends the paths behind a discontinuity."""
        return max(self.plan.rr_depth - ROULETTE_EARLIER, 1)

    @property
    def pixels(self) -> int:
        """Number of pixels of the crop window."""
        return self.camera.crop_width * self.camera.crop_height

    @property
    def config(self) -> PathConfig:
        """The path loop's: the estimators stratify what they sample first; everything else is independent."""
        return replace(self.plan.config, sampler="independent")

    @property
    def scatters_smoothly(self) -> bool:
        """Whether any surface is more than a mirror or glass: only then can a path vertex be connected to another."""
        return has_smooth_lobes(self.config.bsdfs)

    @property
    def method(self) -> Method:
        """The method, with its sample counts."""
        assert self.plan.boundary is not None
        return self.plan.boundary


def terms(scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int) -> list[Term]:
    """Return the launches that estimate the boundary term of the named parameters."""
    request = Request(scene, plan, motion(scene, names), role, sensor, spp, seed)
    return [t for term in TERMS[type(request.method)] for t in launches(term, request)]


def launches(term: Callable[[Request], Term | None], request: Request) -> list[Term]:
    """Return the launches of one of a method's terms, under its name."""
    found = term(request)
    return [] if found is None else [replace(found, kind=term.__name__)]


def _term(r: Request, stream: int, kernel: wp.Kernel, head: list, samples: int, *, count: int | None = None) -> Term:
    """Return the launch of a kernel: what it reads of the scene, and what all of them take.

    Args:
        r: the boundary term.
        stream: sub-stream of its random numbers.
        kernel: one thread a sample.
        head: the arguments in front of the first sample's number.
        samples: how many.
        count: what the kernel is told of their number; None: ``samples``.
    """
    told = count or samples
    random = mix_seed(r.seed, stream)

    def inputs(first: int, adjoint: wp.array) -> list:
        return [*head, sample_job(first, told, random, r.plan.max_depth, r.rr_depth, adjoint)]

    return Term(kernel, inputs, samples)


def primary(r: Request) -> Term | None:
    """Return the term of the edges that the camera sees."""
    require_uncut(r.scene, r.sensor, set(r.moves.shapes), camera_moves=r.moves.camera)
    found = _film_edges(r)
    edges = primary_edges(r.scene, found, _curves(r, camera_moves=r.moves.camera))
    if edges is None:
        return None
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * (1.0 - found.share))
    kernel = make_primary_kernel(r.config, r.role, r.moves.camera)
    return _term(r, PRIMARY, kernel, [r.scene.data(), r.camera, edges], samples)


def facets(r: Request) -> Term | None:
    """Return the term of creases between flat faces that the camera sees side by side."""
    if not r.config.scatter or not r.scene.builder.emitters or not r.scatters_smoothly:
        return None
    found = _film_edges(r)
    edges = facet_edges(r.scene, found)
    if edges is None:
        return None
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * found.share)
    kernel = make_facets_kernel(r.config, r.role, r.moves.camera)
    return _term(r, FACETS, kernel, [r.scene.data(), r.camera, edges], samples)


def _film_edges(r: Request) -> FilmEdges:
    shapes = set(r.moves.shapes)
    return film_edges(r.scene, r.sensor, shapes, camera_moves=r.moves.camera, hide_emitters=r.config.hidden)


def creases(r: Request) -> Term | None:
    """Return the term of edges inside of interpolated normals that the camera sees: light may reach one side only."""
    if not r.config.smooth or not r.config.scatter or not r.scene.builder.emitters or not r.scatters_smoothly:
        return None
    found = crease_edges(r.scene, _film_edges(r))
    if found is None:
        return None
    edges, sine = found
    # The variance is in proportion to the sine: jumps are, on a band of edges as wide; there are the more edges.
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * math.sqrt(sine))
    kernel = make_primary_kernel(r.config, r.role, r.moves.camera)
    return _term(r, CREASES, kernel, [r.scene.data(), r.camera, edges], samples)


def terminator(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from the camera."""
    if not r.config.scatter:
        return None
    shapes = set(r.moves.shapes | r.moves.normals)
    found = terminator_faces(r.scene, r.sensor, shapes, camera_moves=r.moves.camera)
    if found is None:
        return None
    samples = r.pixels * (r.method.spp_primary or r.spp)
    kernel = make_terminator_kernel(r.config, r.role, r.moves.camera)
    return _term(r, TERMINATOR, kernel, [r.scene.data(), r.camera, *found], samples)


def secondary(r: Request) -> Term | None:
    """Return the term of shadow edges and their like: visibility between two path vertices."""
    if r.plan.max_depth == 1 or not r.scene.builder.emitters or not r.moves.edges:
        return None
    if not r.scatters_smoothly:
        return None
    guiding = getattr(r.method, "guiding", None)
    if guiding is None:
        edges, guide = secondary_edges(r.scene, set(r.moves.shapes)), Guide()
        aimed = r.plan.max_depth == 2 and r.scene.builder.environment < 0
        guide.share = WEDGE_SHARE_DIRECT if aimed else WEDGE_SHARE
        if isinstance(r.method, Projective):
            guide.share = projective.uniform_share(r)
    else:
        seeds = projective.asker(r) if isinstance(r.method, Projective) else None
        edges, guide = store.guide(r, guiding, seeds)
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_secondary_kernel(
        r.config, r.role, r.moves.camera, r.moves.light_pose, guiding is not None, r.indirect
    )
    return _term(
        r, SECONDARY, kernel, [r.scene.data(), r.camera, edges, moving_shapes(r.scene, r.moves), guide], samples
    )


def _curves(r: Request, *, camera_moves: bool) -> Adjacency:
    """Return the curves of intersection that move."""
    curves = scene_curves(r.scene)
    return (
        curves if camera_moves else select(curves, np.flatnonzero(moving_curves(r.scene, curves, set(r.moves.shapes))))
    )


def curve(r: Request) -> Term | None:
    """Return the term of path vertices on curves of intersection."""
    if r.plan.max_depth == 1 or not r.scene.builder.emitters:
        return None
    if (r.plan.max_depth == 2 and not r.config.area) or not r.scatters_smoothly:
        return None
    edges = curve_edges(r.scene, _curves(r, camera_moves=False))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_curve_kernel(r.config, r.role, r.moves.camera, r.indirect)
    return _term(r, CURVE, kernel, [r.scene.data(), r.camera, edges], samples)


def bent(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from other path vertices."""
    if 0 <= r.plan.max_depth <= 2 or not r.scene.builder.emitters or not r.scatters_smoothly:
        return None
    found = bent_choice(r.scene)
    if found is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_bent_kernel(r.config, r.role, r.moves.camera)
    return _term(r, BENT, kernel, [r.scene.data(), r.camera, *found[:2]], samples)


def horizon(r: Request) -> Term | None:
    """Return the term of path vertices with interpolated normals whose own triangle turns away from light."""
    if r.plan.max_depth == 1 or not r.moves.shapes or not r.scatters_smoothly:
        return None
    # Light of no area is never met by a direction.
    kinds = {e.kind for e in r.scene.builder.emitters}
    if not (kinds if r.plan.max_depth != 2 else kinds - c.DELTA_LIGHTS):
        return None
    found = bent_choice(r.scene)
    if found is None:
        return None
    cdf, faces, sine = found
    # What a sample is worth is in proportion to the sine; lights of small extent need more samples than that says.
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * math.sqrt(sine))
    kernel = make_horizon_kernel(r.config, r.role, r.moves.camera, r.indirect)
    return _term(r, HORIZON, kernel, [r.scene.data(), r.camera, cdf, faces], samples)


def edge_sampling(r: Request) -> Term | None:
    """Return the term of shadow edges and their like as the vertices of a camera path see them [LADL18]."""
    assert isinstance(r.method, EdgeSampling)
    kinds = {e.kind for e in r.scene.builder.emitters}
    # With one scattering event only a light can be what the edge hides.
    if r.plan.max_depth == 1 or not (kinds if r.plan.max_depth != 2 else kinds - c.DELTA_LIGHTS):
        return None
    edges = secondary_edges(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    spp = r.method.spp_secondary or r.spp
    walk = replace(r.plan.config, area=(), lights=())
    candidates = r.method.candidates or (MAX_SPLIT if r.method.tree else DEFAULT_CANDIDATES)
    kernel = make_edge_sampling_kernel(r.config, walk, r.role, r.moves.camera, r.method.tree, candidates, r.indirect)
    head = [r.scene.data(), r.camera, edges, edge_trees(r.scene, edges)]
    return _term(r, EDGE_SAMPLING, kernel, head, r.pixels * spp, count=spp)


def hard_shadows(r: Request) -> Term | None:
    """Return the term of the shadow edges of point, spot and directional lights alone."""
    if r.plan.max_depth == 1 or not {e.kind for e in r.scene.builder.emitters} & c.DELTA_LIGHTS:
        return None
    edges = secondary_edges(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    data = r.scene.data()
    records = data.emitters.numpy().copy()  # on the CPU ``numpy`` is a view of the scene's own records
    cdf = cumulative(np.where(np.isin(records["kind"], list(c.DELTA_LIGHTS)), records["probability"], 0.0))
    records["probability"] = np.diff(cdf)
    data.emitters = wp.array(records, dtype=Emitter, device=r.scene.device)
    data.emitter_cdf = wp.array(cdf, dtype=wp.float32, device=r.scene.device)
    kernel = make_secondary_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, False, r.indirect)
    # No share of the wedge: every sample goes to a light.
    head = [data, r.camera, edges, moving_shapes(r.scene, r.moves), Guide()]
    return _term(r, SECONDARY, kernel, head, samples)


def through_mirrors(r: Request) -> Term | None:
    """Return the term of what is seen through smooth mirrors and glass."""
    if not r.config.scatter or not has_delta_lobes(r.config.bsdfs) or not r.scene.face_count:
        return None
    assert r.plan.wanted is not None
    edges, tables = face_tables(r.scene)
    assert isinstance(r.method, Connecting)
    samples = r.pixels * (r.method.spp_mirrors or r.spp)
    kernel = make_line_search_kernel(r.config, r.plan.wanted, r.role, r.moves.light_pose)
    return _term(r, THROUGH_MIRRORS, kernel, [r.scene.data(), r.camera, edges, tables], samples)


#: Terms in which paths of two vertices behind the camera can be told from longer ones (``kernels/boundary/depth.py``).
SPLIT = (secondary, edge_sampling, hard_shadows, curve, horizon)
_CONNECTING = (primary, facets, creases, terminator, secondary, curve, bent, horizon, through_mirrors)
#: What each method consists of.
TERMS: dict[type[Method], tuple[Callable[[Request], Term | None], ...]] = {
    PathSpace: _CONNECTING,
    Projective: _CONNECTING,
    EdgeSampling: (primary, facets, creases, terminator, edge_sampling, hard_shadows, curve, bent, horizon),
}
