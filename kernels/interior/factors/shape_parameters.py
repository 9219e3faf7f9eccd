"""The material values that shape a lobe or mix lobes, by which branches (``branch.py``) differentiate.

A branch differentiates by one number of a vertex's material at a time: the texture that holds it. Values that share a
texture move together (an isotropic roughness is both ``alpha_u`` and ``alpha_v``). The direction in which a material
moves is a record of its values' velocities.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.bsdf.model import TEXTURE
from warp_psdr.kernels.bsdf.record import Slot, merge_values
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.velocities import make_material_jvp
from warp_psdr.kernels.invalid import LARGEST
from warp_psdr.kernels.material import slot_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import SurfaceConfig
from warp_psdr.kernels.vertex_motion import VertexTangent

#: Colours that are branched: the complex index of refraction.
INDICES = ("eta", "k")

#: The step by which targets tell a derivative, over the size of a value, and the least size: large for the digits of
#: float32, small for where a derivative changes its sign.
STEP, LEAST_SCALE = wp.constant(1.0 / 128.0), wp.constant(1.0e-3)


@wp.func
def is_within(x: wp.float32, low: wp.float32, high: wp.float32) -> wp.bool:
    return x >= low and x <= high


def _number(bound: float) -> str:
    """The text of a bound that may be infinite."""
    return repr(max(min(float(bound), 3.0e38), -3.0e38))


def is_shape(slot: Slot, bsdfs: tuple[str, ...]) -> bool:
    """Whether branches can differentiate by a value: a number of a smooth lobe, but for those that turn delta lobes."""
    plain = slot.name.rsplit("_", 1)[-1]
    if slot.table or slot.source != TEXTURE or (slot.color and plain not in INDICES):
        return False
    models = models_of(bsdfs)
    smooth = any(m.has_smooth and slot.name in {value.name for value in m.values} for m in models)
    return smooth and not any(slot.name in m.turned_by for m in models)


def branched_values(surfaces: SurfaceConfig, wanted: GradientRequest) -> tuple[bool, ...]:
    """Return which of the requested material values are branched, one answer for each of ``SurfaceConfig.material``."""
    return tuple(
        w and is_shape(slot, surfaces.bsdfs) for slot, w in zip(surfaces.material, wanted.material, strict=True)
    )


def unsplit_values(surfaces: SurfaceConfig, wanted: GradientRequest) -> list[str]:
    """Return the branched values of which some model of the scene has no lobes of one sign (``bsdf/model.py``)."""
    branched = [slot.name for slot, b in zip(surfaces.material, branched_values(surfaces, wanted), strict=True) if b]
    models = models_of(surfaces.bsdfs)
    return [
        name
        for name in branched
        if any(name in {value.name for value in m.values} and name not in m.decomposed for m in models)
    ]


class ShapeParameters(NamedTuple):
    """Functions over the values that a kernel branches; ``slots`` is a material's, see ``slot_at``.

    Attributes:
        count: ``(scene, slots) -> int32``: how many directions a material has.
        direction: ``(scene, target, slots, face, u, v, uv, number) -> record``: direction ``number``. In forward mode
            there is one, the velocity that the tangents give.
        along: ``(a, direction) -> record``: the part of an adjoint that belongs to a direction.
        moved: ``(material, direction) -> (record, bool)``: the material a small step along or against a direction,
            within the bounds of its values; and whether anything moves.
    """

    count: wp.Function
    direction: wp.Function
    along: wp.Function
    moved: wp.Function


@functools.cache
def make_shape_parameters(surfaces: SurfaceConfig, wanted: GradientRequest, role: str) -> ShapeParameters:
    """Return the functions for the material values that ``wanted`` holds."""
    record = make_bsdf(surfaces.bsdfs).record
    scope = {"record": record, "Scene": Scene, "VertexTangent": VertexTangent, "anchor": anchor, "slot_at": slot_at}
    scope |= {"LARGEST": LARGEST, "STEP": STEP, "LEAST_SCALE": LEAST_SCALE, "is_within": is_within}
    chosen = [(k, slot) for k, (slot, w) in enumerate(zip(surfaces.material, wanted.material, strict=True)) if w]
    found = [f"    i{k} = slot_at(scene, slots, {k})" for k, _slot in chosen]
    first = [
        " and ".join([f"i{k} >= 0", *(f"i{k} != i{j}" for j, _slot in chosen[:place])])
        for place, (k, _slot) in enumerate(chosen)
    ]
    count = ["def shape_count(scene: Scene, slots: wp.int32) -> wp.int32:", "    n = wp.int32(0)", *found]
    for is_first in first:
        count += [f"    if {is_first}:", "        n += 1"]
    count.append("    return wp.min(n, 1)\n" if role == "forward" else "    return n\n")

    direction = [
        "def shape_direction(",
        "    scene: Scene, target: wp.array(dtype=wp.float32), slots: wp.int32, face: wp.int32, u: wp.float32,",
        "    v: wp.float32, uv: wp.vec2, number: wp.int32,",
        ") -> record:",
        "    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py",
    ]
    if role == "forward":
        scope["material_jvp"] = make_material_jvp(surfaces, wanted)
        direction.append("    return material_jvp(scene, target, slots, face, u, v, uv, VertexTangent())\n")
    else:
        direction += ["    m = record()", "    n = wp.int32(0)", "    texture = wp.int32(-1)", *found]
        for (k, _slot), is_first in zip(chosen, first, strict=True):
            direction += [f"    if {is_first}:", "        if n == number:", f"            texture = i{k}"]
            direction += ["        n += 1"]
        for k, slot in chosen:
            one = "wp.vec3(1.0, 1.0, 1.0)" if slot.color else "1.0"
            direction += [f"    if i{k} >= 0 and i{k} == texture:", f"        m.{slot.name} = {one}"]
        direction.append("    return m\n")

    bounds = {value.name: (value.low, value.high) for value in merge_values(models_of(surfaces.bsdfs))}
    linear = {name for model in models_of(surfaces.bsdfs) for name in model.mixes}
    members = [
        (f"{slot.name}{part}", *bounds[slot.name])
        for _k, slot in chosen
        for part in (("[0]", "[1]", "[2]") if slot.color else ("",))
    ]
    moved = ["def moved_shape(material: record, direction: record) -> tuple[record, wp.bool]:"]
    moved += ["    h = wp.float32(LARGEST)", "    back = wp.bool(False)", "    m = material"]
    for name, low, high in members:
        # What is linear in a number has the same derivative for every step.
        size = _number(high - low) if name in linear else f"wp.max(wp.abs(material.{name}), LEAST_SCALE)"
        moved += [f"    if direction.{name} != 0.0:"]
        moved += [f"        h = wp.min(h, STEP * {size} / wp.abs(direction.{name}))"]
    moved += ["    h = wp.where(h < LARGEST, h, 0.0)"]
    for name, low, high in members:
        moved += [f"    if not is_within(material.{name} + h * direction.{name}, {_number(low)}, {_number(high)}):"]
        moved += ["        back = True"]
    moved += ["    step = wp.where(back, -h, h)"]
    for name, low, high in members:
        moved += [
            f"    m.{name} = wp.clamp(material.{name} + step * direction.{name}, {_number(low)}, {_number(high)})"
        ]
    moved.append("    return m, h > 0.0\n")

    along = ["def along_shape(a: record, direction: record) -> record:", "    m = record()"]
    for _k, slot in chosen:
        product = (
            f"wp.cw_mul(a.{slot.name}, direction.{slot.name})"
            if slot.color
            else f"a.{slot.name} * direction.{slot.name}"
        )
        along.append(f"    m.{slot.name} = {product}")
    along.append("    return m\n")
    return ShapeParameters(*(make_generated("\n".join(lines), **scope) for lines in (count, direction, along, moved)))
