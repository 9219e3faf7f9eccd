"""Guiding structures, kept on the scene from one gradient to the next.

A structure belongs to a method, to what moves, to a camera, a depth and the form of the first vertices. At the same
values of the scene it is used as it is. While vertices, lights and cameras have moved by less than ``drift``, its cells
stay, and the masses of some of them are refreshed at each change. Beyond that the structure is built anew once it has
guided so many samples that the evaluations of a build are few beside them, or at once if an edge that is not in it can
be a silhouette. A step of an optimisation therefore spends little on guiding, however fine the structure is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.guiding.grid import edge_ends
from warp_psdr.estimate.guiding.intervals import Intervals, Listing, begin
from warp_psdr.estimate.guiding.intervals import follow as follow_items
from warp_psdr.estimate.guiding.ordering import follow, ordered_edges
from warp_psdr.estimate.guiding.structure import (
    MOST_DRIFTS,
    TECHNIQUES,
    Space,
    Structure,
    drift,
    renew,
    run,
    samples_of,
    stays,
)
from warp_psdr.kernels.boundary.guiding.facing import make_facing_kernel
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.path_space.secondary import make_secondary_kernel
from warp_psdr.options.guiding import Method
from warp_psdr.plan.guiding import kept
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.edges import COPLANAR, scene_adjacency
from warp_psdr.topology.secondary_edges import secondary_candidates

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.scene.scene import Scene

#: Points of the lights for which edges are tested to be a silhouette.
FACING = 32
#: Angle of an edge, over ``edges.COPLANAR``, up to which it is still as good as flat if it was so at the build:
#: rounding moves edges across that bound whenever they move.
STILL_FLAT = 4.0
#: The term of edges.
EDGES = "secondary"
Seeds = Callable[[str, Edges], np.ndarray]


@dataclass(eq=False, kw_only=True)
class Guiding(Structure):
    """A built structure over edges.

    Attributes:
        edges: the edges in the order of the first coordinate.
        keep: their numbers in the scene's adjacency, sorted.
        order: these numbers in that order.
        turned: which of them are turned around.
        numbering: the adjacency's own array of triangles; another one may number the edges otherwise.
        facing: for which share of the lights each edge is a silhouette.
        ordered: values of the scene when the edges were put in order.
    """

    edges: Edges
    keep: np.ndarray
    order: np.ndarray
    turned: np.ndarray
    numbering: np.ndarray
    facing: np.ndarray
    ordered: np.ndarray


def structures(scene: Scene) -> list[Structure]:
    """Return what guiding has built for a scene."""
    return list(kept(scene).values())


def built(r: Request, method: Method, name: str) -> bool:
    """Whether there is a structure for the boundary term of a name."""
    return key_of(r, method, name) in kept(r.scene)


def forget(r: Request, method: Method, name: str) -> None:
    """Forget what guiding has built for the boundary term of a name."""
    kept(r.scene).pop(key_of(r, method, name), None)


def kernels(r: Request) -> list[wp.Kernel]:
    """Return the kernels that build structures for a boundary term: the integrand, and what faces the lights."""
    return [
        make_secondary_kernel(r.config, "target", False, False, indirect=r.indirect),
        make_facing_kernel(r.config.lights),
    ]


def key_of(r: Request, method: Method, name: str) -> tuple:
    """Return what a structure belongs to."""
    first = r.config.material_first  # edges of the same names have another integrand
    return method, name, r.moves, r.sensor, r.plan.max_depth, r.method.without_counts(), r.indirect, first


def guide(r: Request, method: Method, seeds: Seeds | None = None) -> tuple[Edges | None, Guide]:
    """Return the edges and the structures that guide their term; (None, empty): there are no edges.

    Args:
        r: the boundary term.
        method: how to guide it.
        seeds: technique, edges -> (N, 3) points of the cube near which the integrand is large; asked at a build only.
    """
    scene = r.scene
    values = scene.values.numpy()
    key = key_of(r, method, EDGES)
    old = kept(scene).get(key)
    if old is not None and np.array_equal(old.seen, values, equal_nan=True):
        old.guided += samples_of(r)
        return old.edges, old.guide
    keep, p = secondary_candidates(scene, set(r.moves.shapes))
    if not len(keep):
        return None, Guide()
    serves = False
    if old is not None and _covers(scene, old, keep) and drift(r, old.ordered, values) <= MOST_DRIFTS * method.drift:
        follow(scene, old.edges, old.order, old.turned)
        serves = True
    else:
        old = _ordered(r, keep, p, old)
    renew(r, method, old, edge_space(r, old, seeds), serves)
    kept(scene)[key] = old
    old.seen = values.copy()
    old.guided += samples_of(r)
    return old.edges, old.guide


def edge_space(r: Request, found: Guiding, seeds: Seeds | None = None) -> Space:
    """Return the cube of segments at edges (arguments as in ``guide``)."""
    edges = found.edges
    kernel, _facing = kernels(r)
    return Space(
        kernel=kernel,
        head=[r.scene.data(), r.camera, edges, moving_shapes(r.scene, r.vertex_motion)],
        cdf=dict.fromkeys(TECHNIQUES, edges.cdf.numpy().astype(np.float64)),
        facing=found.facing,
        ends=lambda technique, points: edge_ends(r, edges, technique, points),
        seeds=None if seeds is None else lambda technique: seeds(technique, edges),
    )


def guide_surfaces(
    r: Request,
    method: Method,
    name: str,
    space_of: Callable[[dict[str, Intervals]], Space],
    listed: dict[str, Listing],
) -> Guide:
    """Return the structures that guide the term of shapes without triangles of a name.

    Args:
        r: the boundary term.
        method: how to guide it.
        name: of the term.
        space_of: the intervals of items that come and go -> the cube.
        listed: technique -> its items, where they come and go.
    """
    scene = r.scene
    values = scene.values.numpy()
    empty = Structure(leaves={}, built=values.copy(), seen=values.copy(), guide=Guide())
    found = kept(scene).setdefault(key_of(r, method, name), empty)
    changed = not found.leaves or not np.array_equal(found.seen, values, equal_nan=True)
    serves = False
    if changed:
        serves = stays(r, method, found) and drift(r, found.built, values) <= MOST_DRIFTS * method.drift
        now = {t: follow_items(found.intervals[t], items) for t, items in listed.items()} if serves else {}
        serves &= all(intervals is not None for intervals in now.values())
        found.intervals = {t: (now[t] if serves else None) or begin(items) for t, items in listed.items()}
    space = space_of(found.intervals)
    if changed:
        renew(r, method, found, space, serves)
        found.seen = values.copy()
    found.guided += samples_of(r)
    return found.guide


def _covers(scene: Scene, found: Guiding, keep: np.ndarray) -> bool:
    """Return whether all of these edges are in a structure, but for those that are as good as flat."""
    edges = scene_adjacency(scene)
    if found.numbering is not edges.faces:
        return False
    outside = np.ones(len(edges.length), bool)
    outside[found.keep] = False
    return not (edges.wedge[keep[outside[keep]]] > STILL_FLAT * COPLANAR).any()


def _ordered(r: Request, keep: np.ndarray, p: np.ndarray, old: Guiding | None) -> Guiding:
    """Return a structure that has its edges and nothing else."""
    edges, facing, order, turned = ordered_edges(r.scene, keep, p, lambda edges: _facing(r, edges))
    values = r.scene.values.numpy().copy()
    builds, evaluations = (old.builds, old.evaluations) if old else (0, 0)
    return Guiding(
        edges=edges,
        keep=keep,
        order=order,
        turned=turned,
        numbering=scene_adjacency(r.scene).faces,
        leaves={},
        facing=facing,
        ordered=values,
        built=values,
        seen=values,
        guide=Guide(),
        builds=builds,
        evaluations=evaluations,
    )


def _facing(r: Request, edges: Edges) -> np.ndarray:
    """Share of points of the lights for which each edge can be a silhouette."""
    count = edges.cdf.shape[0] - 1
    _integrand, kernel = kernels(r)
    random = np.random.default_rng((r.seed, len(TECHNIQUES)))
    strata = np.stack([random.permutation(FACING) for _ in range(2)], axis=1)
    points = wp.array((strata + random.random((FACING, 2))) / FACING, dtype=wp.vec2d, device=r.scene.device)
    out = wp.zeros(count, dtype=wp.float32, device=r.scene.device)
    run(r, kernel, count, lambda first: [r.scene.data(), edges, first, points], [out])
    return out.numpy().astype(np.float64)
