"""The material values that turn the normals of lobes, by which antithetic pairs (``antithetic.py``) differentiate."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.bsdf.record import Slot
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.vertex import SurfaceConfig
from warp_psdr.kernels.vertex_motion import VertexTangent


class Tilts(NamedTuple):
    """Functions that split a record of adjoints or velocities; they add up to it.

    Attributes:
        only: ``(m) -> record``: of the values that turn normals.
        still: ``(m) -> record``: of the others.
    """

    only: wp.Function
    still: wp.Function


@wp.func
def upright(vertex: VertexTangent) -> VertexTangent:
    """How a vertex moves whose normal does not turn."""
    v = vertex
    v.n = wp.vec3(0.0, 0.0, 0.0)
    return v


def tilts(slot: Slot, bsdfs: tuple[str, ...]) -> bool:
    """Whether the normal of a glossy model's lobes depends on a value."""
    return any(model.glossy and slot.name in model.tilts for model in models_of(bsdfs))


def tilting_values(surfaces: SurfaceConfig, wanted: GradientRequest) -> tuple[bool, ...]:
    """Return which of the requested values turn normals of glossy lobes, one for each of ``SurfaceConfig.material``."""
    return tuple(w and tilts(slot, surfaces.bsdfs) for slot, w in zip(surfaces.material, wanted.material, strict=True))


@functools.cache
def make_tilts(surfaces: SurfaceConfig) -> Tilts:
    """Return the functions for the material values of a scene."""
    record = make_bsdf(surfaces.bsdfs).record
    names = [slot.name for slot in surfaces.material if tilts(slot, surfaces.bsdfs)]
    only = "def only_tilts(m: record) -> record:\n    r = record()\n"
    only += "".join(f"    r.{name} = m.{name}\n" for name in names) + "    return r\n"
    still = "def still_values(m: record) -> record:\n    r = m\n    nothing = record()\n"
    still += "".join(f"    r.{name} = nothing.{name}\n" for name in names) + "    return r\n"
    return Tilts(make_generated(only, record=record), make_generated(still, record=record))
