"""Branches in the plan: the derivatives that the methods draw for or refuse, and all kernels of a request."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes, has_glossy_lobes, has_null_lobes, models_of
from warp_psdr.kernels.constants import DELTA_LIGHTS, PHASE_HG, PHASE_ISOTROPIC, PHASE_RAYLEIGH
from warp_psdr.kernels.interior.antithetic import make_pair_kernel
from warp_psdr.kernels.interior.branch import make_branch_kernel
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.shape_parameters import branched_values, unsplit_values
from warp_psdr.kernels.interior.factors.tilts import tilting_values, tilts
from warp_psdr.kernels.interior.phase_branch import make_phase_branch_kernel
from warp_psdr.kernels.medium.coefficients import PHASE
from warp_psdr.options import interior
from warp_psdr.options.words import WORDS
from warp_psdr.rows.replay import Kept, keep_blocks, replayed, without

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig

#: Name of a mask's value.
OPACITY = "opacity"
#: The method of ``interior.Branches`` that draws from candidates.
RESAMPLED = "resampled"
#: Phase functions whose parameters are drawn for, or that have none.
DRAWN_PHASES = {PHASE_ISOTROPIC, PHASE_HG, PHASE_RAYLEIGH}


def keep_candidates(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    """Return what resampled branches keep."""
    assert isinstance(method, interior.Resampled)
    kept = keep_blocks(interior.Replay(), max_depth, rr_depth)
    return replace(kept, reason=f"{method.candidates} candidates; {kept.reason}", candidates=method.candidates)


def make_branches_of_shapes(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    """Return the kernel of resampled branches by the shapes of lobes."""
    if config.media is not None:
        return make_phase_branch_kernel(config, role, kept.candidates, False)
    return make_branch_kernel(
        config, GradientRequest(material=branched_values(config.surfaces, wanted)), role, kept.candidates
    )


def resampled_kernels(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernels by the shapes of lobes, by what turns normals, and of the rest, of what is requested."""
    if config.media is not None:
        return [make_branches_of_shapes(config, wanted, role, kept), *beside_branches(config, wanted, role, kept)]
    branched = branched_values(config.surfaces, wanted)
    rest = without(wanted, branched)
    found = [make_branches_of_shapes(config, wanted, role, kept)] if any(branched) else []
    if not refused_by_tilts("", config, rest):
        found.append(make_pair_kernel(config, turned_by(config, rest), role, kept.candidates))
        rest = unpaired(config, rest)
    return found + replayed(config, rest, role, kept)


def beside_branches(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernel of what is not branched, if there is any."""
    if config.media is not None:
        rest = replace(wanted, media=tuple(kind for kind in wanted.media if kind != PHASE))
        return replayed(config, rest, role, kept)
    return replayed(config, without(wanted, branched_values(config.surfaces, wanted)), role, kept)


def keep_lobes(_method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    """Return what decomposed branches keep."""
    light_points = interior.Resampled().candidates
    kept = keep_blocks(interior.Replay(), max_depth, rr_depth)
    said = f"a lobe of each sign; {light_points} light points; {kept.reason}"
    return replace(kept, reason=said, candidates=light_points)


def make_decomposed(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    """Return the kernel of decomposed branches."""
    if config.media is not None:
        return make_phase_branch_kernel(config, role, kept.candidates, True)
    branched = GradientRequest(material=branched_values(config.surfaces, wanted))
    return make_branch_kernel(config, branched, role, kept.candidates, True)


def decomposed_kernels(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernels of decomposed branches, and of the rest."""
    return [make_decomposed(config, wanted, role, kept), *beside_branches(config, wanted, role, kept)]


def refused_by_decomposed(config: PathConfig, wanted: GradientRequest) -> str:
    """Return why lobes of one sign are not known; empty: they are."""
    if config.media is not None:
        return _refused_in_media("interior.Decomposed()", config, wanted)
    unsplit = unsplit_values(config.surfaces, wanted)
    if unsplit:
        left = [(m, set(unsplit) - set(m.decomposed)) for m in models_of(config.surfaces.bsdfs)]
        models = sorted({repr(m.plugin) for m, names in left if names & {value.name for value in m.values}})
        return (
            "interior.Decomposed() knows the lobes of the roughnesses of 'roughconductor', the exponents of "
            "'ashikhminshirley', A, B and C of 'abc', sigma of 'orennayar', the index of 'roughplastic' and weights of "
            "mixtures, and "
            f"not those of {', '.join(unsplit)} of {', '.join(models)}. Use interior.Resampled()"
        )
    return refused_by_branches("interior.Decomposed()", config, wanted)


def keep_pairs(_method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    """Return what antithetic pairs keep."""
    kept = keep_blocks(interior.Replay(), max_depth, rr_depth)
    return replace(kept, reason=f"a pair at one glossy vertex of a path; {kept.reason}")


def turned_by(config: PathConfig, wanted: GradientRequest) -> GradientRequest:
    """Return what of a request may turn normals of glossy surfaces."""
    return GradientRequest(
        material=tilting_values(config.surfaces, wanted),
        to_uv=wanted.to_uv,
        shapes=wanted.shapes,
        texcoords=wanted.texcoords,
        camera=wanted.camera,
    )


def pair_kernels(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernels of antithetic pairs, and of what is not paired, if there is any."""
    paired = make_pair_kernel(config, turned_by(config, wanted), role)
    return [paired, *replayed(config, unpaired(config, wanted), role, kept)]


def unpaired(config: PathConfig, wanted: GradientRequest) -> GradientRequest:
    """Return what of a request is not paired: all but the normals of glossy surfaces."""
    kept_still = {name for model in models_of(config.surfaces.bsdfs) if not model.glossy for name in model.tilts}
    turned = tilting_values(config.surfaces, wanted)
    own = tuple(t and slot.name not in kept_still for t, slot in zip(turned, config.surfaces.material, strict=True))
    return replace(without(wanted, own), paired=True)


def refused_by_antithetic(config: PathConfig, wanted: GradientRequest) -> str:
    """Return why nothing is paired; empty: something is."""
    name = "interior.Antithetic()"
    if not has_glossy_lobes(config.surfaces.bsdfs):
        return f"{name} draws pairs at glossy surfaces, and the scene has none. Use interior.Replay()"
    if not turns_normals(config, wanted):
        if any(branched_values(config.surfaces, wanted)):
            return (
                f"{name} draws pairs for what turns the normals of glossy surfaces; derivatives by the shape of a lobe "
                "are alike on both sides of it, and gain nothing. Use interior.Resampled()"
            )
        return (
            f"{name} draws pairs for what turns the normals of glossy surfaces (normal and bump maps, vertex normals, "
            "what moves), and no parameter that is requested does. Use interior.Replay()"
        )
    return refused_by_tilts(name, config, wanted)


def turns_normals(config: PathConfig, wanted: GradientRequest) -> bool:
    """Whether anything that is requested may turn the normals of glossy surfaces."""
    slides = wanted.to_uv and any(tilts(slot, config.surfaces.bsdfs) for slot in config.surfaces.material)
    turns = wanted.geometry or slides or any(tilting_values(config.surfaces, wanted))
    return turns and has_glossy_lobes(config.surfaces.bsdfs)


def refused_by_tilts(name: str, config: PathConfig, wanted: GradientRequest) -> str:
    """Return why no two directions are drawn by how normals turn; empty: they are."""
    if not turns_normals(config, wanted):
        return f"{name}: no parameter that is requested turns the normals of glossy surfaces. Use interior.Replay()"
    if wanted.geometry and has_delta_lobes(config.surfaces.bsdfs):
        what, instead = WORDS["moving_mirrors"]
        return f"{name} does not know {what}; use interior.Replay(), or {instead}"
    return _refused_behind_null(name, config)


def refused_by_resampled(config: PathConfig, wanted: GradientRequest) -> str:
    """Return why nothing is branched; empty: something is."""
    name = "interior.Resampled()"
    if config.media is None and not any(branched_values(config.surfaces, wanted)) and turns_normals(config, wanted):
        return refused_by_tilts(name, config, wanted)
    return refused_by_branches(name, config, wanted)


def refused_by_branches(name: str, config: PathConfig, wanted: GradientRequest) -> str:
    """Return why nothing is branched by the shape of a lobe; empty: something is."""
    if config.media is not None:
        return _refused_in_media(name, config, wanted)
    if not any(branched_values(config.surfaces, wanted)):
        normals = ", and nothing turns the normals of a glossy one" if name == "interior.Resampled()" else ""
        return (
            f"{name} draws directions for the shapes of lobes, and no parameter that is requested is one "
            "(a roughness, an exponent, an index of refraction, a weight or an opacity of a material with a smooth "
            f"lobe){normals}. Use interior.Replay()"
        )
    return _refused_behind_null(name, config)


def _refused_behind_null(name: str, config: PathConfig) -> str:
    if has_null_lobes(config.surfaces.bsdfs) and DELTA_LIGHTS & set(config.lights.others):
        return (
            f"{name} does not let shadow rays pass masks, thin glass and 'null', and lights of no area are found by "
            "nothing else behind them. Use interior.Replay(), or area lights"
        )
    return ""


def _refused_in_media(name: str, config: PathConfig, wanted: GradientRequest) -> str:
    """Return why nothing is branched in media; empty: g of ``hg`` is."""
    assert config.media is not None
    if PHASE not in wanted.media:
        return (
            f"{name} draws directions for g of 'hg' in scenes with participating media, and no parameter "
            "that is requested is one; shapes of lobes on surfaces beside media are for interior.Replay()"
        )
    if set(config.media.phases) - DRAWN_PHASES:
        return (
            f"{name} knows g of 'hg' beside 'isotropic' and 'rayleigh', and no other phase function. Use "
            "interior.Replay()"
        )
    return ""


def drawn_by_choice(config: PathConfig, wanted: GradientRequest) -> GradientRequest:
    """Return what of a request may be branched as a shape unasked.

    No opacity, most of whose derivative shadow rays have, and nothing that turns normals of glossy surfaces, as the
    scale of bumps does.
    """
    left = zip(config.surfaces.material, tilting_values(config.surfaces, wanted), strict=True)
    return without(wanted, tuple(turns or slot.name.rsplit("_", 1)[-1] == OPACITY for slot, turns in left))


def keep_branches(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    """Return what several methods side by side keep."""
    assert isinstance(method, interior.Branches)
    candidates = interior.Resampled().candidates if method.shapes or method.normals == RESAMPLED else 0
    kept = keep_blocks(interior.Replay(), max_depth, rr_depth)
    said = [f"{method.shapes} branches for shapes of lobes"] if method.shapes else []
    said += [f"{method.normals} pairs for normals"] if method.normals else []
    return replace(kept, reason="; ".join((*said, kept.reason)), candidates=candidates, branches=method)


def branch_kernels(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernels of several methods side by side, and of the rest."""
    assert kept.branches is not None
    make = {"": [], RESAMPLED: [make_branches_of_shapes], "decomposed": [make_decomposed]}[kept.branches.shapes]
    found = [m(config, drawn_by_choice(config, wanted), role, kept) for m in make]
    if kept.branches.normals:
        turned = turned_by(config, _not_of_shapes(kept.branches, config, wanted))
        candidates = {RESAMPLED: kept.candidates}.get(kept.branches.normals, 0)
        found.append(make_pair_kernel(config, turned, role, candidates))
    return found + replayed(config, rest_of(kept.branches, config, wanted), role, kept)


def _not_of_shapes(method: interior.Branches, config: PathConfig, wanted: GradientRequest) -> GradientRequest:
    """Return what is requested but for the shapes of lobes that are drawn for."""
    return (
        without(wanted, branched_values(config.surfaces, drawn_by_choice(config, wanted))) if method.shapes else wanted
    )


def rest_of(method: interior.Branches, config: PathConfig, wanted: GradientRequest) -> GradientRequest:
    """Return what of a request is replayed beside several methods."""
    rest = _not_of_shapes(method, config, wanted)
    return unpaired(config, rest) if method.normals else rest
