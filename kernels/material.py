"""Values of a material at a point, read from its textures."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.bsdf.record import Slot
from warp_psdr.kernels.constants import TEXTURE_CONSTANT
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.reading import load_int, texture_record
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.texture.gradient import make_reader


def is_optional(models: tuple[str, ...], slot: Slot) -> bool:
    """Whether some of the models have no such value."""
    return any(slot.name not in {value.name for value in model.values} for model in models_of(models))


def varies(slot: Slot) -> bool:
    """Whether some material has a texture there that is not constant."""
    return bool(set(slot.kinds) - {TEXTURE_CONSTANT})


@wp.func
def slot_at(scene: Scene, slots: wp.int32, number: wp.int32) -> wp.int32:
    """Index of the texture that holds a value of a material; -1: its model has no such value."""
    return load_int(scene.slots, slots + number)


@wp.func
def is_varied(scene: Scene, index: wp.int32) -> wp.bool:
    """Whether there is a texture of this number, and it is not constant."""
    varied = wp.bool(False)
    if index >= 0:
        varied = texture_record(scene, index).kind != TEXTURE_CONSTANT
    return varied


@wp.func_native("return (wp::uint64)(values.data + offset);")
def address_of(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.uint64:
    return wp.uint64(0)


@wp.func
def table_address(scene: Scene, index: wp.int32) -> wp.uint64:
    """Address of a material's table, see ``bsdf/model.py``.

    Where a material has none, ``index`` is -1, the address is that of values of the scene, which are as many as those
    of a table at least: paths side by side read it for all materials.
    """
    offset = wp.int32(0)
    if index >= 0:
        offset = texture_record(scene, index).offset
    return address_of(scene.values, offset)


@functools.cache
def make_material(
    models: tuple[str, ...], material: tuple[Slot, ...], primitives: tuple[int, ...], varied: bool = False
) -> wp.Function | None:
    """Return ``material_at(scene, m: record, slots, face, u, v, uv) -> record`` with the values that textures hold.

    Other values stay as they are; unused ones cost nothing. ``varied``: only values of textures that are not constant;
    None: there are none.
    """
    scope = {"record": make_bsdf(models).record, "Scene": Scene, "slot_at": slot_at, "table_address": table_address}
    scope["is_varied"] = is_varied
    lines = [
        f"def {'varied' if varied else 'material'}_at(",
        "    scene: Scene, m: record, slots: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2",
        ") -> record:",
    ]
    read = [(k, slot) for k, slot in enumerate(material) if (varies(slot) if varied else slot.kinds or slot.table)]
    if varied and not read:
        return None
    for k, slot in read:
        lines.append(f"    i{k} = slot_at(scene, slots, {k})")
        if slot.table:
            lines.append(f"    m.{slot.name} = table_address(scene, i{k})")
            continue
        scope[f"texture_{k}"] = make_reader(slot.kinds, slot.rises, slot.color, primitives)
        value = f"texture_{k}(scene, i{k}, face, u, v, uv)" + ("" if slot.color else "[0]")
        if varied or is_optional(models, slot):
            lines += [
                f"    if {f'is_varied(scene, i{k})' if varied else f'i{k} >= 0'}:",
                f"        m.{slot.name} = {value}",
            ]
        else:
            lines.append(f"    m.{slot.name} = {value}")
    lines.append("    return m\n")
    return make_generated("\n".join(lines), **scope)
