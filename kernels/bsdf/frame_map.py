"""A nested model in a frame that a texture turns: the common part of normal and bump maps.

With n the perturbed normal in the local frame whose first axis follows dp/du, the nested model sees directions in

    s = normalize(x - n n.x),    t = n x s,    n.

A direction below one of the two surfaces and above the other has no value. ``use_shadowing_function`` removes light
where the perturbed surface would hide it [ELS19, eq. 1 and 2], which makes the model not reciprocal:

    G(wo) = 2 / (1 + sqrt(1 + a^2 tan^2 theta_o)),    a^2 = min(tan^2 theta_n / 8, 1),

theta_o from the unperturbed normal. ``flip_invalid_normals`` turns a normal that looks away from the viewer about the
unperturbed one, by half a turn.

[ELS19] Estevez, Lecocq and Stein 2019, A Microfacet-Based Shadowing Function to Solve the Bump Terminator Problem.
"""

from collections.abc import Callable

import warp as wp

from warp_psdr.kernels.bsdf.composite import Child
from warp_psdr.kernels.bsdf.model import Flag, Functions
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_NULL
from warp_psdr.kernels.math import aligned_tangent, at_least, to_local, to_world, where3, where_number
from warp_psdr.kernels.structs import BsdfSample, Scattered

FLIP = Flag("flip_invalid_normals", True)
SHADOW = Flag("use_shadowing_function", True)
#: Variant of the back of a two-sided model inside of a map: its normal is the opposite one, a bump seen from below is a
#: dent. (A map inside of ``twosided`` has bumps on both sides.)
BEHIND = "seen_from_below"
#: Least cosine of the shadowing function's angle; keeps its ratio a number in the surface.
MIN_COSINE = 1.0e-7


@wp.struct
class LocalFrame:
    """A perturbed frame, in coordinates of the unperturbed one."""

    s: wp.vec3
    t: wp.vec3
    n: wp.vec3


@wp.func
def frame_around(n: wp.vec3) -> LocalFrame:
    """The frame of a unit normal."""
    s = aligned_tangent(n, wp.vec3(1.0, 0.0, 0.0))
    return LocalFrame(s, wp.cross(n, s), n)


@wp.func
def to_perturbed(frame: LocalFrame, w: wp.vec3) -> wp.vec3:
    return to_local(frame.s, frame.t, frame.n, w)


@wp.func
def from_perturbed(frame: LocalFrame, w: wp.vec3) -> wp.vec3:
    return to_world(frame.s, frame.t, frame.n, w)


@wp.func
def bump_shadowing(n: wp.vec3, wo: wp.vec3) -> wp.float32:
    """G(wo) under the normal n."""
    across = n[0] * n[0] + n[1] * n[1]
    a2 = across / at_least(at_least(1.0e-30, across), 8.0 * n[2] * n[2])
    c = at_least(MIN_COSINE, wp.abs(wo[2]))
    return 2.0 * c / (c + wp.sqrt(c * c + a2 * (wo[0] * wo[0] + wo[1] * wo[1])))


@wp.func
def agree(a: wp.float32, b: wp.float32) -> wp.float32:
    """One where two cosines have the same sign, else 0."""
    return where_number(a * b > 0.0, 1.0, 0.0)


def make_frame_map(
    record: type, variant: str, children: tuple[Child, ...], make_normal: Callable[[type], wp.Function]
) -> Functions:
    """Return the functions of a nested model in a turned frame.

    Args:
        record: the struct of a scene's material values.
        variant: names of the switches that are off, see ``FLIP`` and ``SHADOW``.
        children: the nested model.
        make_normal: ``record -> normal_of``, ``(mat) -> vec3``: the unit normal in local coordinates.
    """
    flips, shadows = (flag.options[1] not in variant.split() for flag in (FLIP, SHADOW))
    across = -1.0 if BEHIND in variant.split() else 1.0
    nested = children[0].bind(record)
    model = children[0].model
    normal_of = make_normal(record)

    @wp.func
    def frame_map_frame(mat: record, wi: wp.vec3) -> LocalFrame:
        n = normal_of(mat)
        n = wp.vec3(wp.static(across) * n[0], wp.static(across) * n[1], n[2])
        if wp.static(flips):
            turned = where_number(wi[2] * wp.dot(wi, n) <= 0.0, -1.0, 1.0)
            n = wp.vec3(turned * n[0], turned * n[1], n[2])
        return frame_around(n)

    @wp.func
    def seen(frame: LocalFrame, wo: wp.vec3, inner: wp.vec3) -> wp.float32:
        """What of a direction's value is seen; ``inner``: it in the perturbed frame."""
        share = agree(wo[2], inner[2])
        if wp.static(shadows):
            share = share * bump_shadowing(frame.n, wo)
        return share

    @wp.func
    def frame_map_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo`` with the perturbed normal, 1/sr."""
        frame = frame_map_frame(mat, wi)
        inner = to_perturbed(frame, wo)
        return seen(frame, wo, inner) * nested.eval(mat, to_perturbed(frame, wi), inner)

    @wp.func
    def frame_map_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the smooth samples, solid angle."""
        frame = frame_map_frame(mat, wi)
        inner = to_perturbed(frame, wo)
        return agree(wo[2], inner[2]) * nested.pdf(mat, to_perturbed(frame, wi), inner)

    @wp.func
    def frame_map_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Direction and weight of a delta lobe; differentiable."""
        frame = frame_map_frame(mat, wi)
        scattered = nested.scatter(mat, to_perturbed(frame, wi), lobe)
        wo = from_perturbed(frame, scattered.wo)
        return Scattered(wo, seen(frame, wo, scattered.wo) * scattered.value)

    @wp.func
    def frame_map_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        frame = frame_map_frame(mat, wi)
        inner = to_perturbed(frame, wi)
        through = nested.scatter(mat, inner, lobe).wo
        return agree(from_perturbed(frame, through)[2], through[2]) * nested.probability(mat, inner, lobe)

    @wp.func
    def frame_map_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Ask the nested model for a direction; none where the two surfaces disagree on its side."""
        frame = frame_map_frame(mat, wi)
        s = nested.sample(mat, to_perturbed(frame, wi), u, v)
        wo = from_perturbed(frame, s.wo)
        pdf = agree(wo[2], s.wo[2]) * s.pdf
        value = seen(frame, wo, s.wo) * s.value
        drawn = pdf > 0.0
        s.wo = where3(drawn, wo, wp.vec3(0.0, 0.0, 0.0))
        s.value = where3(drawn, value, wp.vec3(0.0, 0.0, 0.0))
        s.pdf = where_number(drawn, pdf, 0.0)
        s.eta = where_number(drawn, s.eta, 1.0)
        s.lobe = wp.where(drawn, s.lobe, LOBE_NONE)
        return s

    @wp.func
    def frame_map_relative_eta(mat: record, wi: wp.vec3) -> wp.float32:
        return nested.relative_eta(mat, to_perturbed(frame_map_frame(mat, wi), wi))

    @wp.func
    def frame_map_normal(mat: record, wi: wp.vec3) -> wp.vec3:
        return frame_map_frame(mat, wi).n

    return Functions(
        frame_map_sample,
        frame_map_eval if model.has_smooth else None,
        frame_map_pdf if model.has_smooth else None,
        frame_map_scatter if model.has_delta else None,
        frame_map_probability if model.has_delta else None,
        relative_eta=frame_map_relative_eta if nested.own.relative_eta is not None else None,
        normal=frame_map_normal,
        branches=nested.own.branches,
    )


def refuse_frame_map(children: tuple[Child, ...]) -> str:
    """Say why a model cannot be turned."""
    if children[0].model.framed:
        return "a normal or bump map inside another is not supported; leave one out"
    if children[0].has(LOBE_NULL):
        return "light that passes straight on has no normal to be turned; put what lets it pass around the map"
    return ""
