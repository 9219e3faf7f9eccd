"""The samples of the boundary term on edges and outlines as plain arrays, and the density by which edges are sampled.

They are for pictures, and show what an estimator spends its samples on. ``draw_samples`` and ``draw_density`` draw them
with pyvista.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.drivers import launch_samples
from warp_psdr.estimate.boundary.terms import TERMS, Request, launches
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.passes import STREAM_BOUNDARY
from warp_psdr.invalid import warns
from warp_psdr.kernels.boundary.pull_record import SAMPLE_RECORD
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.boundary import EdgeSampling, PathSpace
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import decide
from warp_psdr.plan.transient import require_steady
from warp_psdr.plots import as_array
from warp_psdr.topology.secondary_edges import secondary_edges

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.guiding.cells import Cells
    from warp_psdr.scene.parameters import Parameters

__all__ = ["EdgeDensity", "EdgeSamples", "boundary_samples", "draw_density", "draw_samples", "edge_density"]

#: Terms of edges with two ends; what the others record is a tangent.
OF_EDGES = ("primary", "flat_creases", "secondary")
#: Length of the piece of an outline that stands in for an edge, over the diagonal of the box around the points.
PIECE = 0.05


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """Samples of the boundary term that contribute, K of them.

    Attributes:
        points: (K, 3) x_b, world units.
        edges: (K, 3) the edge that x_b lies on, from its first to its second end; of shapes without triangles a piece
            of the tangent of the outline or crease, ``PIECE`` of the size of what the samples of its kind span.
        pulls: (K, 3) derivative of ``sum(adjoint * image)`` by x_b that the sample stands for; its share of the pass's
            estimate, so that sums over samples are gradients.
        kinds: (K,) "primary": an edge or outline that the camera sees; "secondary": a shadow's edge or its like.
    """

    points: np.ndarray
    edges: np.ndarray
    pulls: np.ndarray
    kinds: np.ndarray

    @property
    def magnitude(self) -> np.ndarray:
        """(K,) length of the pulls."""
        return np.linalg.norm(self.pulls, axis=1)

    def of_kind(self, kind: str) -> EdgeSamples:
        """Return the samples of one kind, "primary" or "secondary"."""
        kept = self.kinds == kind
        return EdgeSamples(self.points[kept], self.edges[kept], self.pulls[kept], self.kinds[kept])


@dataclass(frozen=True, eq=False)
class EdgeDensity:
    """How densely shadow edges are sampled, E edges or pieces of them.

    Attributes:
        segments: (E, 2, 3) ends, world units.
        density: (E,) mean of the samples per world unit of length, normalised: its integral over all edges is 1.
    """

    segments: np.ndarray
    density: np.ndarray


@warns
def boundary_samples(
    scene: Any,
    params: Parameters,
    adjoint: Any,
    *,
    sensor: int | str = 0,
    integrator: Integrator | None = None,
    spp: int = 4,
    seed: int = 0,
) -> EdgeSamples:
    """Return the samples with which ``psdr.render_backward`` estimates the boundary term of equal arguments.

    Edges of meshes count, and silhouettes, rims and creases of exact shapes, grids, networks and curves. Of a sample
    only its pull at x_b is kept; those at the two ends of its segment are not. Curves along which meshes run through
    each other count where the camera sees them; samples of their shadows and of curves in which other shapes cut each
    other are left out, and so are those seen through mirrors and glass and those of interpolated normals.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, NumPy (H, W, 3) or Warp (H, W) of vec3.
        sensor: which camera, by its number or its id.
        integrator: as of ``render``; default: what the scene file names.
        spp: samples a pixel, of each kind.
        seed: equal seeds give equal samples.

    Raises:
        ValueError: what is requested has no boundary term, or one that is not covered or not recorded; a wrong adjoint.

    Warns:
        RuntimeWarning: samples that were not finite were left out (``psdr.invalid_samples``).
    """
    integrator = integrator_of(scene, integrator)
    number: int = scene.description.camera_number(sensor)
    require_steady(scene, number, "psdr.view of edges")
    names = params.requested
    plan = decide(scene, params, integrator=integrator, sensor=number)
    if plan.boundary is None:
        raise ValueError(
            f"{names} have no boundary term here: no discontinuity moves, or PathIntegrator(boundary=None) left it out"
        )
    if not isinstance(plan.boundary, PathSpace):
        raise ValueError(
            f"the samples of {plan.boundary.label} are not recorded, only those of boundary.PathSpace(); name that"
        )
    camera = scene.camera(number)
    values = np.ascontiguousarray(as_array(adjoint), np.float32)
    if values.shape != (camera.crop_height, camera.crop_width, 3):
        raise ValueError(
            f"adjoint: got shape {values.shape}, expected the image's {(camera.crop_height, camera.crop_width, 3)}"
        )
    weights = wp.array(values, dtype=wp.vec3, device=scene.device)
    stream = mix_seed(seed, STREAM_BOUNDARY)
    request = Request(scene, plan, motion(scene, names), "samples", number, spp, stream)
    records, kinds = [np.zeros((0, SAMPLE_RECORD), np.float32)], []
    recorded = [term for term in TERMS[PathSpace] if term.recorded]
    found = [(term, launched) for term in recorded for launched in launches(term, request)]
    for term, launched in found:
        target = wp.zeros(SAMPLE_RECORD * launched.samples, dtype=wp.float32, device=scene.device)
        launch_samples(scene, launched, weights, target)
        rows = target.numpy().reshape(-1, SAMPLE_RECORD)
        rows = rows[(rows[:, 6:] != 0.0).any(axis=1)]
        if term.name not in OF_EDGES and len(rows):
            rows[:, 3:6] = _pieces(rows[:, :3], rows[:, 3:6])
        records.append(rows)
        kinds += [term.recorded] * len(rows)
    rows = np.concatenate(records)
    return EdgeSamples(rows[:, :3], rows[:, 3:6], rows[:, 6:], np.array(kinds, dtype="<U9"))


def _pieces(points: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Return tangents (K, 3) of outlines, of the length of ``PIECE`` of the box around their points."""
    length = np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    return PIECE * np.linalg.norm(np.ptp(points, axis=0)) * tangents / length


@warns
def edge_density(
    scene: Any,
    params: Parameters,
    *,
    sensor: int | str = 0,
    integrator: Integrator | None = None,
    seed: int = 0,
    pieces: int = 1,
) -> EdgeDensity:
    """Return how densely shadow edges are sampled for the requested parameters: guided, if the integrator says so.

    A guided density varies along an edge; ``pieces`` resolves that. What is shown is its marginal over directions.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        sensor: which camera, by its number or its id.
        integrator: as of ``render``; default: what the scene file names.
        seed: that of the gradient whose structure is shown.
        pieces: into how many segments an edge is cut; ``EdgeDensity`` holds each of them.

    Raises:
        ValueError: there is no edge that could be a silhouette, ``boundary.EdgeSampling`` draws edges for every path
            vertex anew, or ``pieces`` is no positive integer.
    """
    if isinstance(pieces, bool) or not isinstance(pieces, int) or pieces < 1:
        raise ValueError(f"pieces: got {pieces!r}, expected a positive integer")
    integrator = integrator_of(scene, integrator)
    number: int = scene.description.camera_number(sensor)
    require_steady(scene, number, "psdr.view of edges")
    names = params.requested
    plan = decide(scene, params, integrator=integrator, sensor=number)
    if isinstance(plan.boundary, EdgeSampling):
        raise ValueError(
            f"{plan.boundary.label} draws edges by each path vertex, not by one density of the scene; name PathSpace() "
            "or Projective()"
        )
    method = getattr(plan.boundary, "guiding", None)
    guide = None
    if method is None:
        edges = secondary_edges(scene, set(motion(scene, names).shapes))
    else:
        request = Request(scene, plan, motion(scene, names), "reverse", number, 1, mix_seed(seed, STREAM_BOUNDARY))
        asker = projective.asker(request) if isinstance(plan.boundary, projective.Projective) else None
        edges, guide = store.guide(request, method, asker)
    if edges is None:
        raise ValueError("the scene has no edge that could be a silhouette; nothing is sampled")
    corners = edges.points.numpy().astype(np.float64)
    cut = np.linspace(0.0, 1.0, pieces + 1)
    points = (1.0 - cut)[:, None] * corners[:, None, 0] + cut[:, None] * corners[:, None, 1]
    segments = np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
    cdf = edges.cdf.numpy().astype(np.float64)
    u = np.append((cdf[:-1, None] + np.diff(cdf)[:, None] * cut[:-1]).reshape(-1), 1.0)
    share = u
    if guide is not None:
        part = float(guide.share)
        share = part * _marginal(guide.wedge, u) + (1.0 - part) * _marginal(guide.light, u)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    return EdgeDensity(segments.astype(np.float32), np.diff(share) / length)


def _marginal(cells: Cells, u: np.ndarray) -> np.ndarray:
    """Return the cumulative probability of the first coordinate of cells at ascending points u.

    Within a leaf (low, high) of probability P and slope s it grows by P (t + s (t^2 - t)), with
    t = (u - low) / (high - low): a quadratic function, whose three coefficients are added up over the leaves that are
    open at u. Thin leaves have large ones, which cancel where they close: hence the long sums.
    """
    low, high, slope = (x.numpy()[:, 0].astype(np.longdouble) for x in (cells.low, cells.high, cells.slope))
    p = np.diff(cells.cdf.numpy().astype(np.longdouble))
    size = high - low
    a, b = p * slope / size**2, p * (1.0 - slope) / size
    open_ = np.stack([a * low**2 - b * low, b - 2.0 * a * low, a], axis=1)
    close = np.concatenate([p[:, None] - open_[:, :1], -open_[:, 1:]], axis=1)
    at = np.concatenate([low, high])
    order = np.argsort(at, kind="stable")
    sums = np.concatenate([np.zeros((1, 3), np.longdouble), np.cumsum(np.concatenate([open_, close])[order], axis=0)])
    c = sums[np.searchsorted(at[order], u, side="right")]
    inside = (c[:, 0] + c[:, 1] * u + c[:, 2] * u**2).astype(np.float64)
    return cells.floor * u + (1.0 - cells.floor) * inside


def draw_samples(
    plotter: Any,
    samples: EdgeSamples,
    *,
    reach: float = 1.0,
    size: float = 7.0,
    least: float = 0.1,
    title: str = "pull per world unit",
) -> None:
    """Add samples to a ``pyvista.Plotter``: points coloured by the size of their pull, on the edges that they sit on.

    Args:
        plotter: where to draw.
        samples: from ``boundary_samples``.
        reach: share of its edge that is drawn to either side of a point.
        size: of a point, in pixels.
        least: samples that pull with less than this share of the strongest are left out, so that one sees those that
            carry light. (The strongest: the 99.5th percentile.)
        title: name and unit of the pulls, at the colour bar.
    """
    import pyvista

    size_of_pull = samples.magnitude
    if not len(size_of_pull):
        return
    strongest = np.percentile(size_of_pull, 99.5)
    limits = [least * strongest, strongest]
    order = np.argsort(size_of_pull)  # the strongest last, over the others
    order = order[size_of_pull[order] >= limits[0]]
    points, half = samples.points[order], 0.5 * reach * samples.edges[order]
    lines = pyvista.line_segments_from_points(np.stack([points - half, points + half], axis=1).reshape(-1, 3))
    plotter.add_mesh(lines, color="black", line_width=1.0, lighting=False)
    plotter.add_mesh(
        pyvista.PolyData(points),
        scalars=size_of_pull[order],
        clim=limits,
        log_scale=True,
        cmap="inferno_r",
        point_size=size,
        lighting=False,
        render_points_as_spheres=True,
        scalar_bar_args=_bar(title),
    )


def draw_density(plotter: Any, density: EdgeDensity, *, line_width: float = 2.5) -> None:
    """Add edges to a ``pyvista.Plotter``, coloured by how densely they are sampled.

    Args:
        plotter: where to draw.
        density: from ``edge_density``.
        line_width: in pixels.
    """
    import pyvista

    lines = pyvista.line_segments_from_points(density.segments.reshape(-1, 3))
    lines.cell_data["density"] = density.density
    plotter.add_mesh(
        lines,
        scalars="density",
        clim=np.percentile(density.density, [1.0, 99.0]),
        log_scale=True,
        cmap="viridis",
        line_width=line_width,
        render_lines_as_tubes=True,
        lighting=False,
        scalar_bar_args=_bar("share of the samples per world unit of length"),
    )


def _bar(title: str) -> dict[str, Any]:
    """Return options of a colour bar below what is drawn."""
    return {
        "title": f"{title}\n",  # the empty line keeps it off the numbers
        "color": "black",
        "fmt": "%.0e",
        "n_labels": 3,
        "title_font_size": 14,
        "label_font_size": 14,
        "position_x": 0.2,
        "position_y": 0.02,
        "width": 0.6,
        "height": 0.11,
    }
