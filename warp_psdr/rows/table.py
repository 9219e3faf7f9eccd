"""The table of interior methods: the kernel that estimates the interior term, its claims, and its lines in the plan.

A row belongs to a method of ``psdr.interior`` and to a kind of method of the boundary term. Explicit boundary terms
leave the interior's kernel as it is; reparameterisations change it. A new method is an object in
``options/interior.py``, a kernel, and a row here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.bsdf.motion import MOVED_BY
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.interior.attached import make_attached_kernel
from warp_psdr.kernels.interior.bidirectional import make_bidirectional_kernel
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.media_sweep import explores_density
from warp_psdr.kernels.interior.film_antithetic import make_film_antithetic_kernel
from warp_psdr.kernels.interior.media_replay import make_media_replay_kernel
from warp_psdr.kernels.interior.media_textbook import make_media_textbook_kernel
from warp_psdr.kernels.interior.pixel_border import make_pixel_border_kernel
from warp_psdr.kernels.interior.radiative import make_radiative_kernel
from warp_psdr.kernels.interior.textbook import make_textbook_kernel
from warp_psdr.kernels.transfer.radiative_transfer import make_transfer_kernel
from warp_psdr.options import boundary, interior
from warp_psdr.plan.motion import moves_in_media
from warp_psdr.rows.attached import refused_by_attached
from warp_psdr.rows.branches import (
    branch_kernels,
    decomposed_kernels,
    keep_branches,
    keep_candidates,
    keep_lobes,
    keep_pairs,
    pair_kernels,
    refused_by_antithetic,
    refused_by_decomposed,
    refused_by_resampled,
    resampled_kernels,
)
from warp_psdr.rows.film_antithetic import refused_on_the_film, sees_a_room
from warp_psdr.rows.reparametrised import make_reparametrised
from warp_psdr.rows.replay import (
    MOST_KEPT,
    SHORT,
    Kept,
    beside_motion,
    keep_blocks,
    make_replay,
    moved_request,
    replay_kernels,
    replayed,
    without,
)
from warp_psdr.rows.transfer import has_film_edges, refused_by_transfer, refused_in_scene, sphere_edges
from warp_psdr.rows.warped_area import keep_warped, make_warped

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Row:
    """An interior method.

    Attributes:
        label: what the plan calls it.
        keep: (method, max_depth, rr_depth) -> what of a path is kept.
        kernels: (what the path loop compiles, which derivatives, "reverse" or "forward", what is kept) -> its kernels,
            of the paths from the camera; those of the derivatives that it leaves to other methods last.
        refuse: (what the path loop compiles, which derivatives) -> why it cannot estimate them; empty: it claims to.
        refuse_in: (method, scene, requested names, sensor) -> likewise, of what the scene holds.
        whole: why its derivative needs no boundary term beside it, but that of the film; empty: it may.
        whole_in: (scene, requested names, sensor) -> whether that holds there.
        film: (method, config) -> whether edges that the camera sees have a term beside it, of those that are whole.
        reads: (scene, which derivatives, what is kept) -> what the kernel reads of the scene besides its record.
        compensated: whether environment maps are drawn with MIS compensation.
    """

    label: str
    keep: Callable[[interior.Method, int, int], Kept]
    kernels: Callable[[PathConfig, GradientRequest, str, Kept], list[wp.Kernel]]
    refuse: Callable[[PathConfig, GradientRequest], str] = lambda _config, _wanted: ""
    refuse_in: Callable[[interior.Method, Scene, list[str], int], str] = lambda *_arguments: ""
    whole: str = ""
    whole_in: Callable[[Scene, list[str], int], bool] = lambda *_arguments: True
    film: Callable[[interior.Method, PathConfig], bool] = lambda _method, _config: False
    reads: Callable[[Scene, GradientRequest, Kept], list] = lambda *_arguments: []
    compensated: bool = True


def row_of(method: interior.Method, term: boundary.Method | None) -> Row:
    """Return the row of a method of the interior term beside one of the boundary term (None: there is no such term)."""
    kinds = boundary.Method.__mro__[:1] if term is None else type(term).__mro__
    for kind in kinds:
        if (type(method), kind) in TABLE:
            return TABLE[type(method), kind]
    names = ", ".join(f"interior.{m.__name__}()" for m, kind in TABLE if kind in kinds and m is not interior.Branches)
    raise ValueError(f"interior.{type(method).__name__}() has no kernel beside {type(term).__name__}(); use {names}")


def _keep_transfer(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, interior.RadiativeTransfer)
    kept = keep_blocks(interior.Replay(block=method.block), max_depth, rr_depth)
    seen = "an edge from every vertex" if method.edges else "no edges"
    return replace(kept, reason=f"moving ends of flights, {seen}; {kept.reason}", sees_edges=method.edges)


def _transfer(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    if not moves_in_media(wanted):
        return replay_kernels(config, wanted, role, kept)
    moved = make_transfer_kernel(config, moved_request(wanted), role, kept.block, kept.longest, kept.sees_edges)
    return [moved, *beside_motion(config, wanted, role, kept)]


def _read_by_transfer(scene: Scene, wanted: GradientRequest, kept: Kept) -> list:
    if not moves_in_media(wanted):
        return []
    return [sphere_edges(scene) if kept.sees_edges else Edges()]


def _bidirectional(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    if not config.connections:
        return [make_replay(config, wanted, role, kept)]
    return [make_bidirectional_kernel(config, wanted, role, kept.block, kept.blocks)]


def _textbook(config: PathConfig, wanted: GradientRequest, role: str, _kept: Kept) -> list[wp.Kernel]:
    make = make_textbook_kernel if config.media is None else make_media_textbook_kernel
    return [make(config, wanted, role)]


def _ratio_tracking(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    return [make_media_replay_kernel(config, wanted, role, kept.block, kept.longest, True)]


def _refused_by_ratio_tracking(config: PathConfig, wanted: GradientRequest) -> str:
    if config.media is None or not config.media.grids or not explores_density(wanted):
        return (
            "interior.DifferentialRatioTracking() draws points for the density of 'heterogeneous' media, and no "
            "parameter that is requested is one (sigma_t or scale). Use interior.Replay()"
        )
    return ""


def _roughnesses(config: PathConfig, wanted: GradientRequest) -> tuple[bool, ...]:
    """Return which of the requested material values directions move with."""
    return tuple(w and slot.name in MOVED_BY for slot, w in zip(config.surfaces.material, wanted.material, strict=True))


def _keep_attached(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, interior.Attached)
    kept = keep_blocks(interior.Replay(), max_depth, rr_depth)
    said = f"directions {method.bsdf}, light points {method.emitter}, weights {method.weights}"
    return replace(kept, reason=f"{said}: {method.combination.reason}; {kept.reason}", attached=method)


def _attached(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return attached samples beside replay of the rest; of samples that stay, what attached weights add to replay."""
    assert kept.attached is not None
    own = _roughnesses(config, wanted)
    moved = kept.attached.bsdf == "attached"
    rest = replayed(config, without(wanted, own), role, kept) if moved else [make_replay(config, wanted, role, kept)]
    if not moved and kept.attached.weights != "attached":
        return rest
    weighed = make_attached_kernel(config, GradientRequest(material=own), role, moved, kept.attached.weights)
    return [weighed, *rest] if moved else [*rest, weighed]


def _keep_whole_path(method: interior.Method, max_depth: int, _rr_depth: int) -> Kept:
    assert isinstance(method, interior.FilmAntithetic)
    if not 1 <= max_depth <= MOST_KEPT:
        raise ValueError(
            f"max_depth: got {max_depth}, expected 1 to {MOST_KEPT} for interior.FilmAntithetic(), which keeps whole "
            "paths"
        )
    points = "in mirrored fours" if method.mirrored else "drawn one by one"
    block = max(SHORT, 1 << (max_depth - 1).bit_length())
    return Kept(block, 1, f"film points {points}; the whole path fits, one trace", mirrored=method.mirrored)


def _film_antithetic(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernel of film points, and that of what crosses the border of a box filter."""
    found = [make_film_antithetic_kernel(config, wanted, role, kept.block, kept.mirrored)]
    if config.filter == RFILTER_BOX and wanted.geometry:
        found.append(make_pixel_border_kernel(config, wanted, role, kept.mirrored))
    return found


def _keep_textbook(_method: interior.Method, _max_depth: int, _rr_depth: int) -> Kept:
    lost = "derivatives of factors that are exactly zero are lost"
    return Kept(0, 1, "nothing is kept: divides by every factor", lost)


def _keep_radiative(method: interior.Method, _max_depth: int, _rr_depth: int) -> Kept:
    assert isinstance(method, interior.Radiative)
    if method.linear:
        return Kept(0, 1, "nothing is kept", "the light that arrives at every vertex counts as 1", linear=True)
    return Kept(0, 1, "nothing is kept: every vertex traces a path of its own")


def _radiative(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    return [make_radiative_kernel(config, wanted, role, kept.linear)]


def _only(make: Callable[[PathConfig, GradientRequest, str, Kept], wp.Kernel]) -> Callable[..., list[wp.Kernel]]:
    """Return what makes one kernel and no others beside it."""
    return lambda *what: [make(*what)]


#: (method of the interior term, kind of method of the boundary term) -> row. ``boundary.Method``: every explicit term.
TABLE: dict[tuple[type[interior.Method], type[boundary.Method]], Row] = {
    (interior.Replay, boundary.Method): Row(label="record and sweep", keep=keep_blocks, kernels=replay_kernels),
    (interior.Replay, boundary.Distances): Row(label="rays move", keep=keep_blocks, kernels=_only(make_reparametrised)),
    (interior.Replay, boundary.WarpedArea): Row(
        label="rays move, record and sweep", keep=keep_warped, kernels=_only(make_warped)
    ),
    (interior.Replay, boundary.Rotation): Row(
        label="rays turn, record and sweep", keep=keep_warped, kernels=_only(make_warped)
    ),
    (interior.Resampled, boundary.Method): Row(
        label="resampled branches, record and sweep",
        keep=keep_candidates,
        kernels=resampled_kernels,
        refuse=refused_by_resampled,
    ),
    (interior.Attached, boundary.Method): Row(
        label="attached samples, record and sweep",
        keep=_keep_attached,
        kernels=_attached,
        refuse_in=refused_by_attached,
        # It differentiates the weights of both techniques, too, which change quickly where one hardly looks.
        compensated=False,
    ),
    (interior.Decomposed, boundary.Method): Row(
        label="decomposed branches, record and sweep",
        keep=keep_lobes,
        kernels=decomposed_kernels,
        refuse=refused_by_decomposed,
    ),
    (interior.Antithetic, boundary.Method): Row(
        label="antithetic pairs, record and sweep",
        keep=keep_pairs,
        kernels=pair_kernels,
        refuse=refused_by_antithetic,
    ),
    (interior.Branches, boundary.Method): Row(
        label="branches, record and sweep", keep=keep_branches, kernels=branch_kernels
    ),
    (interior.DifferentialRatioTracking, boundary.Method): Row(
        label="differential ratio tracking, record and sweep",
        keep=keep_blocks,
        kernels=_ratio_tracking,
        refuse=_refused_by_ratio_tracking,
    ),
    (interior.RadiativeTransfer, boundary.Method): Row(
        label="differential radiative transfer, record and sweep",
        keep=_keep_transfer,
        kernels=_transfer,
        refuse=refused_by_transfer,
        refuse_in=refused_in_scene,
        whole="edges that path vertices see are sampled with it",
        film=has_film_edges,
        reads=_read_by_transfer,
    ),
    (interior.FilmAntithetic, boundary.Method): Row(
        label="mirrored film points",
        keep=_keep_whole_path,
        kernels=_film_antithetic,
        refuse_in=refused_on_the_film,
        whole_in=sees_a_room,
        whole="edges stay on surfaces, of which none hides another",
    ),
    (interior.Textbook, boundary.Method): Row(
        label="textbook replay",
        keep=_keep_textbook,
        kernels=_textbook,
    ),
    (interior.Radiative, boundary.Method): Row(
        label="radiative backpropagation",
        keep=_keep_radiative,
        kernels=_radiative,
    ),
    (interior.LightTracing, boundary.Method): Row(
        label="light tracing",
        keep=keep_blocks,
        kernels=_only(make_replay),
    ),
    (interior.Bidirectional, boundary.Method): Row(
        label="bidirectional record and sweep",
        keep=keep_blocks,
        kernels=_bidirectional,
    ),
}
