"""The table of interior methods: which kernel estimates the interior term, what it claims, what the plan says of it.

A row belongs to a method of ``psdr.interior`` and to a kind of method of the boundary term: explicit boundary terms
leave the interior's kernel as it is, others (reparameterisations) change it. A new method is an object in
``options/interior.py``, a kernel, and a row here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes, has_glossy_lobes, has_null_lobes, models_of, passing
from warp_psdr.kernels.bsdf.motion import MOVED_BY
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.kernels.interior.antithetic import make_pair_kernel
from warp_psdr.kernels.interior.attached import make_attached_kernel
from warp_psdr.kernels.interior.bidirectional import make_bidirectional_kernel
from warp_psdr.kernels.interior.branch import make_branch_kernel
from warp_psdr.kernels.interior.film_antithetic import make_film_antithetic_kernel
from warp_psdr.kernels.interior.forward import make_forward_kernel
from warp_psdr.kernels.interior.gradient_request import GradientRequest
from warp_psdr.kernels.interior.media_motion_replay import make_media_motion_kernel
from warp_psdr.kernels.interior.media_replay import make_media_replay_kernel
from warp_psdr.kernels.interior.media_sweep import explores_density
from warp_psdr.kernels.interior.radiative import make_radiative_kernel
from warp_psdr.kernels.interior.replay import make_replay_kernel
from warp_psdr.kernels.interior.shape_parameters import branched_values, unsplit_values
from warp_psdr.kernels.interior.textbook import make_textbook_kernel
from warp_psdr.kernels.interior.tilts import tilting_values, tilts
from warp_psdr.kernels.transfer.radiative_transfer import make_transfer_kernel
from warp_psdr.options import boundary, interior
from warp_psdr.plan import media
from warp_psdr.plan.attached import refused_by_attached
from warp_psdr.plan.film_antithetic import refused_by_film_antithetic, refused_for_what_is_seen
from warp_psdr.plan.light import refused_with_light_paths
from warp_psdr.plan.reparametrised import WarpOptions, make_reparametrised
from warp_psdr.plan.transfer import has_film_edges, refused_by_transfer, refused_in_scene, sphere_edges

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

#: Vertices after which a path without depth limit is cut, counted from where Russian roulette begins: it survives with
#: probability 0.95 at most, so fewer than one path in 10^11 is that long.
UNBOUNDED_VERTICES = 507
#: Most vertices of a path whose vertices are kept.
MOST_VERTICES = 4096
#: Paths of at most so many vertices have a kernel of their own, which keeps no more.
SHORT = 4
#: Most vertices of a path that is kept as a whole whatever its length.
MOST_KEPT = 64


@dataclass(frozen=True)
class Kept:
    """What of a path is kept while it is differentiated.

    Attributes:
        block: path vertices at a time; 0: none.
        blocks: most blocks of a path.
        reason: of these numbers, for the plan.
        bias: what the method leaves out by design; empty: nothing.
        candidates: of a method that draws for derivatives; 0: it does not.
        linear: whether the light that arrives at vertices is not estimated.
        attached: what moves with a parameter; None: the method leaves no choice.
        mirrored: whether film points are mirrored.
        sees_edges: whether path vertices sample edges.
        warp: of a boundary method whose rays move; None: they stay.
    """

    block: int
    blocks: int
    reason: str
    bias: str = ""
    candidates: int = 0
    linear: bool = False
    attached: interior.Attached | None = None
    mirrored: bool = False
    sees_edges: bool = False
    warp: WarpOptions | None = None

    @property
    def longest(self) -> int:
        """Most vertices of a path that the records hold; 0: any number."""
        return self.block * self.blocks


@dataclass(frozen=True, kw_only=True)
class Row:
    """An interior method.

    Attributes:
        label: what the plan calls it.
        keep: (method, max_depth, rr_depth) -> what of a path is kept.
        make: (what the path loop compiles, which derivatives, "reverse" or "forward", what is kept) -> its kernel, of
            the paths from the camera.
        beside: likewise, the kernel of the derivatives that it leaves to another method; None: it leaves none.
        refuse: (what the path loop compiles, which derivatives) -> why it cannot estimate them; empty: it claims to.
        refuse_in: (method, scene, requested names, sensor) -> likewise, of what the scene holds.
        whole: why its derivative needs no boundary term beside it, but that of the film; empty: it may.
        film: (method, config) -> whether edges that the camera sees have a term beside it, of those that are whole.
        reads: (scene, which derivatives, what is kept) -> what the kernel reads of the scene besides its record.
    """

    label: str
    keep: Callable[[interior.Method, int, int], Kept]
    make: Callable[[PathConfig, GradientRequest, str, Kept], wp.Kernel]
    beside: Callable[[PathConfig, GradientRequest, str, Kept], wp.Kernel | None] = lambda *_arguments: None
    refuse: Callable[[PathConfig, GradientRequest], str] = lambda _config, _wanted: ""
    refuse_in: Callable[[interior.Method, Scene, list[str], int], str] = lambda *_arguments: ""
    whole: str = ""
    film: Callable[[interior.Method, PathConfig], bool] = lambda _method, _config: False
    reads: Callable[[Scene, GradientRequest, Kept], list] = lambda *_arguments: []


def row_of(method: interior.Method, term: boundary.Method | None) -> Row:
    """Return the row of a method of the interior term beside one of the boundary term (None: there is no such term)."""
    kinds = boundary.Method.__mro__[:1] if term is None else type(term).__mro__
    for kind in kinds:
        if (type(method), kind) in TABLE:
            return TABLE[type(method), kind]
    names = ", ".join(f"interior.{m.__name__}()" for m, kind in TABLE if kind in kinds)
    raise ValueError(f"interior.{type(method).__name__}() has no kernel beside {type(term).__name__}(); use {names}")


def _keep_blocks(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, (interior.Replay, *interior.FROM_LIGHTS, interior.DifferentialRatioTracking))
    if max_depth < 0:
        max_depth = rr_depth + UNBOUNDED_VERTICES
        if max_depth > MOST_VERTICES:
            raise ValueError(
                f"rr_depth: paths without a depth limit that Russian roulette ends from vertex {rr_depth} on are too "
                "long to be differentiated; give max_depth, or an rr_depth of at most "
                f"{MOST_VERTICES - UNBOUNDED_VERTICES}"
            )
    if max_depth > MOST_VERTICES:
        raise ValueError(
            f"max_depth: got {max_depth}, expected at most {MOST_VERTICES} for derivatives; -1 leaves the end of paths "
            "to Russian roulette"
        )
    # Few kernel variants: the default keeps 4 or 8 vertices, whatever the depth.
    block = min(method.block, SHORT) if max_depth <= SHORT else method.block
    blocks = -(-max_depth // block)
    blocks = 1 << (blocks - 1).bit_length()
    whole = "the whole path fits, one trace"
    return Kept(block, blocks, whole if blocks == 1 else f"longer paths are replayed in at most {blocks} blocks")


def _moved(wanted: GradientRequest) -> GradientRequest:
    """Return what of a request moves in media."""
    return GradientRequest(
        material=(False,) * len(wanted.material),
        shapes=wanted.shapes,
        texcoords=wanted.texcoords,
        lights=tuple(kind for kind in wanted.lights if kind == "pose"),
        camera=wanted.camera,
    )


def _make_replay(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    if config.media is not None and media.moves(wanted):
        return make_media_motion_kernel(config, _moved(wanted), role, kept.block, kept.longest)
    if config.media is not None:
        return make_media_replay_kernel(config, wanted, role, kept.block, kept.longest)
    if role == "forward":
        return make_forward_kernel(config, wanted)
    return make_replay_kernel(config, wanted, kept.block, kept.blocks)


def _make_beside_motion(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel | None:
    """Return the kernel of what moves nothing beside what moves in media, if there is any."""
    if config.media is None or not media.moves(wanted):
        return None
    lights = tuple(kind for kind in wanted.lights if kind != "pose")
    rest = replace(wanted, shapes=False, texcoords=False, camera=False, lights=lights)
    nothing = GradientRequest(material=(False,) * len(wanted.material))
    return None if rest == nothing else _make_replay(config, rest, role, kept)


def _keep_transfer(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, interior.RadiativeTransfer)
    kept = _keep_blocks(interior.Replay(block=method.block), max_depth, rr_depth)
    seen = "an edge from every vertex" if method.edges else "no edges"
    return replace(kept, reason=f"moving ends of flights, {seen}; {kept.reason}", sees_edges=method.edges)


def _make_transfer(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    if not media.moves(wanted):
        return _make_replay(config, wanted, role, kept)
    return make_transfer_kernel(config, _moved(wanted), role, kept.block, kept.longest, kept.sees_edges)


def _read_by_transfer(scene: Scene, wanted: GradientRequest, kept: Kept) -> list:
    if not media.moves(wanted):
        return []
    return [sphere_edges(scene) if kept.sees_edges else Edges()]


def _make_bidirectional(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    if not config.connections:
        return _make_replay(config, wanted, role, kept)
    return make_bidirectional_kernel(config, wanted, role, kept.block, kept.blocks)


def _make_ratio(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    return make_media_replay_kernel(config, wanted, role, kept.block, kept.longest, True)


def _refused_by_ratio_tracking(config: PathConfig, wanted: GradientRequest) -> str:
    if config.media is None or not config.media.grids or not explores_density(wanted):
        return (
            "interior.DifferentialRatioTracking() draws points for the density of 'heterogeneous' media, and no "
            "parameter that is requested is one (sigma_t or scale). Use interior.Replay()"
        )
    return ""


def _keep_candidates(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, interior.Resampled)
    kept = _keep_blocks(interior.Replay(), max_depth, rr_depth)
    return replace(kept, reason=f"{method.candidates} candidates; {kept.reason}", candidates=method.candidates)


def _make_resampled(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    return make_branch_kernel(config, GradientRequest(material=branched_values(config, wanted)), role, kept.candidates)


def _make_rest(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel | None:
    """Return the kernel of what is not branched, if there is any."""
    return _make_others(config, wanted, branched_values(config, wanted), role, kept)


def _make_others(
    config: PathConfig, wanted: GradientRequest, own: tuple[bool, ...], role: str, kept: Kept
) -> wp.Kernel | None:
    """Return the kernel of what is requested but for a method's own material values; None: there is no more."""
    rest = replace(wanted, material=tuple(w and not o for w, o in zip(wanted.material, own, strict=True)))
    nothing = GradientRequest(material=(False,) * len(own))
    return None if rest == nothing else _make_replay(config, rest, role, kept)


def _roughnesses(config: PathConfig, wanted: GradientRequest) -> tuple[bool, ...]:
    """Return which of the requested material values directions move with."""
    return tuple(w and slot.name in MOVED_BY for slot, w in zip(config.material, wanted.material, strict=True))


def _keep_attached(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    assert isinstance(method, interior.Attached)
    kept = _keep_blocks(interior.Replay(), max_depth, rr_depth)
    said = f"directions {method.bsdf}, light points {method.emitter}, weights {method.weights}"
    return replace(kept, reason=f"{said}: {method.combination.reason}; {kept.reason}", attached=method)


def _make_attached(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    assert kept.attached is not None
    if kept.attached.bsdf == "detached":
        return _make_replay(config, wanted, role, kept)
    own = GradientRequest(material=_roughnesses(config, wanted))
    return make_attached_kernel(config, own, role, True, kept.attached.weights)


def _make_beside_attached(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel | None:
    """Return replay of all but attached samples; of samples that stay, what attached weights add."""
    assert kept.attached is not None
    own = _roughnesses(config, wanted)
    if kept.attached.bsdf == "attached":
        return _make_others(config, wanted, own, role, kept)
    if kept.attached.weights != "attached":
        return None
    return make_attached_kernel(config, GradientRequest(material=own), role, False, "attached")


def _keep_lobes(_method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    light_points = interior.Resampled().candidates
    kept = _keep_blocks(interior.Replay(), max_depth, rr_depth)
    said = f"a lobe of each sign; {light_points} light points; {kept.reason}"
    return replace(kept, reason=said, candidates=light_points)


def _make_decomposed(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    branched = GradientRequest(material=branched_values(config, wanted))
    return make_branch_kernel(config, branched, role, kept.candidates, True)


def _refused_by_decomposed(config: PathConfig, wanted: GradientRequest) -> str:
    unsplit = unsplit_values(config, wanted)
    if unsplit:
        models = [m for m in models_of(config.bsdfs) if {v.name for v in m.values} & set(unsplit) - set(m.splits)]
        return (
            "interior.Decomposed() knows the lobes of the roughnesses of 'roughconductor' alone, and not those of "
            f"{', '.join(unsplit)} of {', '.join(sorted({repr(m.plugin) for m in models}))}. Use interior.Resampled()"
        )
    return _refused_by_resampled(config, wanted).replace("Resampled()", "Decomposed()")


def _keep_pairs(_method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    kept = _keep_blocks(interior.Replay(), max_depth, rr_depth)
    return replace(kept, reason=f"a pair at one glossy vertex of a path; {kept.reason}")


def _make_pairs(config: PathConfig, wanted: GradientRequest, role: str, _kept: Kept) -> wp.Kernel:
    turned = GradientRequest(
        material=tilting_values(config, wanted),
        to_uv=wanted.to_uv,
        shapes=wanted.shapes,
        texcoords=wanted.texcoords,
        camera=wanted.camera,
    )
    return make_pair_kernel(config, turned, role)


def _make_unpaired(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel | None:
    """Return the kernel of what is not paired, if there is any: all but the normals of glossy surfaces."""
    kept_still = {name for model in models_of(config.bsdfs) if not model.glossy for name in model.tilts}
    turned = tilting_values(config, wanted)
    material = tuple(
        w and not (t and slot.name not in kept_still)
        for w, t, slot in zip(wanted.material, turned, config.material, strict=True)
    )
    rest = replace(wanted, material=material, paired=True)
    nothing = GradientRequest(material=(False,) * len(material), paired=True)
    return None if rest == nothing else _make_replay(config, rest, role, kept)


def _refused_by_antithetic(config: PathConfig, wanted: GradientRequest) -> str:
    name = "interior.Antithetic()"
    if not has_glossy_lobes(config.bsdfs):
        through = passing(config.bsdfs)
        why = f", and of '{through}' it does not know the mirrored directions" if through else ""
        return f"{name} draws pairs at glossy surfaces, and the scene has none that reflect{why}. Use interior.Replay()"
    slides = wanted.to_uv and any(tilts(slot, config.bsdfs) for slot in config.material)
    if not wanted.geometry and not slides and not any(tilting_values(config, wanted)):
        if any(branched_values(config, wanted)):
            return (
                f"{name} draws pairs for what turns the normals of glossy surfaces; derivatives by the shape of a lobe "
                "are alike on both sides of it, and gain nothing. Use interior.Resampled()"
            )
        return (
            f"{name} draws pairs for what turns the normals of glossy surfaces (normal and bump maps, vertex normals, "
            "what moves), and no parameter that is requested does. Use interior.Replay()"
        )
    if refused := _refused_in_path_order(name)(config, wanted):
        return refused
    if has_null_lobes(config.bsdfs) and DELTA_LIGHTS & set(config.lights):
        return (
            f"{name} does not let shadow rays pass masks, thin glass and 'null', and lights of no area are found by "
            "nothing else behind them. Use interior.Replay(), or area lights"
        )
    return ""


def _refused_by_resampled(config: PathConfig, wanted: GradientRequest) -> str:
    if not any(branched_values(config, wanted)):
        return (
            "interior.Resampled() draws directions for the shapes of lobes, and no parameter that is requested is one "
            "(a roughness, an exponent, an index of refraction or a weight of a material with a smooth lobe). Use "
            "interior.Replay()"
        )
    if has_null_lobes(config.bsdfs) and DELTA_LIGHTS & set(config.lights):
        return (
            "interior.Resampled() does not let shadow rays pass masks, thin glass and 'null', and lights of no area "
            "are found by nothing else behind them. Use interior.Replay(), or area lights"
        )
    return ""


def _refused_in_path_order(name: str) -> Callable[[PathConfig, GradientRequest], str]:
    def refuse(config: PathConfig, wanted: GradientRequest) -> str:
        if wanted.geometry and has_delta_lobes(config.bsdfs):
            return (
                f"interior.{name} cannot differentiate moving vertices behind smooth mirrors or glass: the adjoint of "
                "a ray has to be carried backwards. Use interior.Replay()"
            )
        return ""

    return refuse


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


def _make_film_antithetic(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    return make_film_antithetic_kernel(config, wanted, role, kept.block, kept.mirrored)


def _keep_textbook(_method: interior.Method, _max_depth: int, _rr_depth: int) -> Kept:
    lost = "derivatives of factors that are exactly zero are lost"
    return Kept(0, 1, "nothing is kept: divides by every factor", lost)


def _keep_radiative(method: interior.Method, _max_depth: int, _rr_depth: int) -> Kept:
    assert isinstance(method, interior.Radiative)
    if method.linear:
        return Kept(0, 1, "nothing is kept", "the light that arrives at every vertex counts as 1", linear=True)
    return Kept(0, 1, "nothing is kept: every vertex traces a path of its own")


def _make_radiative(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    return make_radiative_kernel(config, wanted, role, kept.linear)


#: (method of the interior term, kind of method of the boundary term) -> row. ``boundary.Method``: every explicit term.
TABLE: dict[tuple[type[interior.Method], type[boundary.Method]], Row] = {
    (interior.Replay, boundary.Method): Row(
        label="record and sweep", keep=_keep_blocks, make=_make_replay, beside=_make_beside_motion
    ),
    (interior.Replay, boundary.Reparametrised): Row(label="rays move", keep=_keep_blocks, make=make_reparametrised),
    (interior.Resampled, boundary.Method): Row(
        label="resampled branches, record and sweep",
        keep=_keep_candidates,
        make=_make_resampled,
        beside=_make_rest,
        refuse=_refused_by_resampled,
    ),
    (interior.Attached, boundary.Method): Row(
        label="attached samples, record and sweep",
        keep=_keep_attached,
        make=_make_attached,
        beside=_make_beside_attached,
        refuse_in=refused_by_attached,
    ),
    (interior.Decomposed, boundary.Method): Row(
        label="decomposed branches, record and sweep",
        keep=_keep_lobes,
        make=_make_decomposed,
        beside=_make_rest,
        refuse=_refused_by_decomposed,
    ),
    (interior.Antithetic, boundary.Method): Row(
        label="antithetic pairs, record and sweep",
        keep=_keep_pairs,
        make=_make_pairs,
        beside=_make_unpaired,
        refuse=_refused_by_antithetic,
    ),
    (interior.DifferentialRatioTracking, boundary.Method): Row(
        label="differential ratio tracking, record and sweep",
        keep=_keep_blocks,
        make=_make_ratio,
        refuse=_refused_by_ratio_tracking,
    ),
    (interior.RadiativeTransfer, boundary.Method): Row(
        label="differential radiative transfer, record and sweep",
        keep=_keep_transfer,
        make=_make_transfer,
        beside=_make_beside_motion,
        refuse=refused_by_transfer,
        refuse_in=refused_in_scene,
        whole="edges that path vertices see are sampled with it",
        film=has_film_edges,
        reads=_read_by_transfer,
    ),
    (interior.FilmAntithetic, boundary.Method): Row(
        label="mirrored film points",
        keep=_keep_whole_path,
        make=_make_film_antithetic,
        refuse=refused_by_film_antithetic,
        refuse_in=refused_for_what_is_seen,
        whole="edges stay on surfaces, of which none hides another",
    ),
    (interior.Textbook, boundary.Method): Row(
        label="textbook replay",
        keep=_keep_textbook,
        make=lambda config, wanted, role, _kept: make_textbook_kernel(config, wanted, role),
        refuse=_refused_in_path_order("Textbook(), textbook replay,"),
    ),
    (interior.Radiative, boundary.Method): Row(
        label="radiative backpropagation",
        keep=_keep_radiative,
        make=_make_radiative,
        refuse=_refused_in_path_order("Radiative()"),
    ),
    (interior.LightTracing, boundary.Method): Row(
        label="light tracing",
        keep=_keep_blocks,
        make=_make_replay,
        refuse=partial(refused_with_light_paths, "interior.LightTracing()"),
    ),
    (interior.Bidirectional, boundary.Method): Row(
        label="bidirectional record and sweep",
        keep=_keep_blocks,
        make=_make_bidirectional,
        refuse=partial(refused_with_light_paths, "interior.Bidirectional()"),
    ),
}
