"""The records of a boundary term: what it is asked for, how a kind of discontinuity declares itself, and its launch."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.device import shared_copy
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.boundary import Method
from warp_psdr.plan.discontinuities import Asked
from warp_psdr.plan.motion import Motion
from warp_psdr.plan.transient import gates_of
from warp_psdr.topology.edges import select
from warp_psdr.topology.edges_there import curves_there
from warp_psdr.topology.film_edges import FilmEdges, film_edges
from warp_psdr.topology.intersection_curves import moving_curves, scene_curves

if TYPE_CHECKING:
    from warp_psdr.kernels.jobs import SampleJob
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Roulette ends paths behind a discontinuity so many vertices earlier than those of the image: their first vertices are
#: what makes boundary samples differ. By default, from the first one on.
ROULETTE_EARLIER = 4
#: Share of the segments whose direction is drawn for what they touch (an edge's wedge, a tangent plane) instead of
#: towards a light. With direct light of lights that are not at infinity, what is not a light contributes nothing.
OWN_SHARE_DIRECT, OWN_SHARE = 0.1, 0.5


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
        indirect: paths of two vertices are left out, of the terms that split.
        creases: of the terms of both parts, those of creases alone (True), or of all else (False); None: all.
    """

    scene: Scene
    plan: Plan
    moves: Motion
    role: str
    sensor: int
    spp: int
    seed: int
    indirect: bool = False
    creases: bool | None = None

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

    @functools.cached_property
    def config(self) -> PathConfig:
        """The path loop's: the estimators stratify what they sample first; everything else is independent."""
        return replace(self.plan.config, sampler="independent")

    @functools.cached_property
    def asked(self) -> Asked:
        """What the plan's declarations of discontinuities are asked about."""
        return Asked(self.scene, self.config, self.moves, self.sensor, self.plan.max_depth)

    @property
    def lit(self) -> bool:
        """Whether there are lights, and paths that reach them by way of a vertex."""
        return self.asked.lit

    @property
    def own_share(self) -> float:
        """The share of segments that are not aimed at lights."""
        direct = self.plan.max_depth == 2 and self.scene.builder.environment < 0
        return OWN_SHARE_DIRECT if direct else OWN_SHARE

    @property
    def view_moves(self) -> bool:
        """Whether all that the camera sees moves against its edges: with the camera, or with points on surfaces."""
        return self.moves.camera or self.config.material_first

    @property
    def values_alone(self) -> bool:
        """Whether all that moves are shapes without triangles, and single values of theirs do."""
        others = self.moves.camera or self.moves.light_pose or self.moves.shapes - set(self.scene.builder.primitives)
        return self.moves.values and not others

    @property
    def vertex_motion(self) -> Motion:
        """What moves path vertices against each other: not the camera, unless first vertices slide along its rays."""
        return self.asked.vertex_motion

    @functools.cached_property
    def scatters_smoothly(self) -> bool:
        """Whether any surface is more than a mirror or glass: only then can a path vertex be connected to another."""
        return self.asked.scatters_smoothly

    @property
    def method(self) -> Method:
        """The method, with its sample counts."""
        assert self.plan.boundary is not None
        return self.plan.boundary


@dataclass(frozen=True, kw_only=True)
class BoundaryTerm:
    """A kind of discontinuity, as its file declares it.

    Attributes:
        name: of the samples that it drops, and in ``psdr.trace_sample``.
        title: what reports of accuracy call it; ``{}``: whether only paths of two vertices are in it (direct), or only
            longer ones.
        stream: sub-stream of the boundary term's random numbers.
        methods: the boundary methods that it belongs to.
        launch: request -> its launch; None: nothing of the kind moves, or exists.
        applies: request -> whether it can have a launch at all, without a look at the scene's edges.
        splits: paths of two vertices behind the camera can be told from longer ones (``kernels/boundary/depth.py``).
        guided: a method's guiding, where there is one, guides it.
        knows: words (``options/words.py``) of what it copes with in the scene around it.
        part: of the boundary term that it belongs to (``parts``): "smooth", "edges", or "both" ("creases" of the
            request tells the two apart).
        recorded: as what it is known to role "samples": "primary" or "secondary"; "": its samples are not recorded.
    """

    name: str
    title: str
    stream: int
    methods: tuple[type[Method], ...]
    launch: Callable[[Request], Term | None]
    applies: Callable[[Request], bool] = lambda _request: True
    splits: bool = False
    guided: bool = False
    knows: frozenset[str] = frozenset()
    part: str = "edges"
    recorded: str = ""


def term_of(
    r: Request, term: BoundaryTerm, kernel: wp.Kernel, head: list, samples: int, *, count: int | None = None
) -> Term:
    """Return the launch of a kernel: what it reads of the scene, and what all of them take.

    Args:
        r: what is asked for.
        term: of this kind.
        kernel: one thread a sample.
        head: the arguments in front of the first sample's number.
        samples: how many.
        count: what the kernel is told of their number; None: ``samples``.
    """
    compiler.begin([kernel], r.scene.device)
    told = count or samples
    random = mix_seed(r.seed, term.stream)
    gates = [] if r.plan.times is None else [gates_of(r.plan.times)]
    made: list[tuple[wp.array, SampleJob]] = []

    def inputs(first: int, adjoint: wp.array) -> list:
        # To fill a record anew takes four times as long as to copy it.
        if not made or made[0][0] is not adjoint:
            made[:] = [(adjoint, sample_job(0, told, random, r.plan.max_depth, r.rr_depth, adjoint))]
        job = shared_copy(made[0][1])
        job.first = first
        return [*head, *gates, job]

    return Term(kernel, inputs, samples)


def film_edges_of(r: Request) -> FilmEdges:
    """Return the edges that the camera may see move."""
    shapes = set(r.moves.shapes)
    return film_edges(
        r.scene,
        r.sensor,
        shapes,
        camera_moves=r.view_moves,
        hide_emitters=r.config.rays.hidden,
        of_radiance=not r.config.shown,
    )


def curves_of(r: Request, *, camera_moves: bool) -> Adjacency:
    """Return the curves of intersection that move."""
    curves = scene_curves(r.scene) if r.config.media is None else curves_there(r.scene)
    return (
        curves if camera_moves else select(curves, np.flatnonzero(moving_curves(r.scene, curves, set(r.moves.shapes))))
    )
