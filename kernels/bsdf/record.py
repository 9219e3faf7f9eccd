"""The record of a scene's material values: one member for each value that any of its models declares, by its name.

Member k comes from the texture number k of a material, ``Scene.slots[bsdf.slots + k]``, and is -1 where its model has
no such value.
"""

import functools
import hashlib
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bsdf.model import GEOMETRY, GRADIENT, TEXTURE, Value
from warp_psdr.kernels.generated import make_generated, make_struct
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.math import where3

#: Longest name of a struct.
MAX_NAME = 200

#: What a value of a type is called.
KINDS = {wp.vec3: "colour", wp.float32: "number", wp.uint64: "table"}


class Slot(NamedTuple):
    """A member of the record, and the kinds of the textures that hold it in a scene; tables and geometry have none.

    ``source`` is that of ``Value``.
    """

    name: str
    color: bool
    kinds: tuple[int, ...]
    table: bool = False
    source: str = TEXTURE

    @property
    def rises(self) -> bool:
        """Whether it is how a texture rises that is read."""
        return self.source == GRADIENT


def slot_of(value: Value, kinds: tuple[int, ...]) -> Slot:
    """Return the member for a value whose textures have these kinds."""
    return Slot(
        value.name, value.color, () if value.size or value.source in GEOMETRY else kinds, value.size > 0, value.source
    )


def merge_values(models) -> tuple[Value, ...]:
    """Return the values of all ``Model``s, each once, in the order of their first mention.

    Raises:
        ValueError: two models declare values of one name and of different kinds.
    """
    found: dict[str, Value] = {}
    for model in models:
        for value in model.values:
            if found.setdefault(value.name, value).type is not value.type:
                raise ValueError(
                    f"{model.plugin!r} declares the value {value.name!r}, a {KINDS[value.type]}, "
                    "which is not what another model declares by that name; give one of them another name"
                )
    return tuple(found.values())


def _short(name: str) -> str:
    """A name that compilers take: its end is a digest where nested models make it long."""
    return (
        name if len(name) <= MAX_NAME else name[: MAX_NAME - 17] + "_" + hashlib.sha256(name.encode()).hexdigest()[:16]
    )


@functools.cache
def make_material_record(members: tuple[tuple[str, type], ...]) -> type:
    """Return the Warp struct with these members: (name, type)."""
    types = dict(members)
    return make_struct(_short("Material_" + "_".join(types)), types)


@functools.cache
def make_adjoint_record(material: type) -> type:
    """Return the Warp struct of the partial derivatives of a weighted scattering value."""
    name = "BsdfAdjoint_" + material.key.rsplit(".", 1)[-1]
    types = {"material": material, "wi": wp.vec3, "wo": wp.vec3}
    return make_struct(name, types)


class MaterialAlgebra(NamedTuple):
    """Functions of a material record, one line a member; tables, which are constants, are left out.

    Attributes:
        add: ``(a, b) -> material``.
        dot: ``(a, b) -> float32``: the sum of the products of all members.
        vanishes: ``(a) -> bool``: whether all members are 0.
    """

    add: wp.Function
    dot: wp.Function
    vanishes: wp.Function


@functools.cache
def make_material_algebra(material: type) -> MaterialAlgebra:
    """Return the functions for a record."""
    members = {name: var for name, var in material.vars.items() if var.type is not wp.uint64}
    add = "def add_materials(a: material, b: material) -> material:\n    m = material()\n"
    add += "".join(f"    m.{name} = a.{name} + b.{name}\n" for name in members) + "    return m\n"
    products = [
        f"wp.dot(a.{name}, b.{name})" if var.type is wp.vec3 else f"a.{name} * b.{name}"
        for name, var in members.items()
    ]
    dot = f"def dot_materials(a: material, b: material) -> wp.float32:\n    return {' + '.join(products)}\n"
    zeros = [f"vanishes(a.{n})" if var.type is wp.vec3 else f"a.{n} == 0.0" for n, var in members.items()]
    vanish = f"def material_vanishes(a: material) -> wp.bool:\n    return {' and '.join(zeros)}\n"
    return MaterialAlgebra(
        make_generated(add, material=material),
        make_generated(dot, material=material),
        make_generated(vanish, material=material, vanishes=vanishes),
    )


@functools.cache
def make_add_where(material: type, names: tuple[str, ...]) -> wp.Function:
    """Return ``(condition, a, b) -> material``: ``a``, plus the members ``names`` of ``b`` if the condition holds."""
    lines = ["def add_where(condition: wp.bool, a: material, b: material) -> material:", "    m = a"]
    for name in names:
        if material.vars[name].type is wp.vec3:
            lines.append(f"    m.{name} = a.{name} + where3(condition, b.{name}, wp.vec3(0.0, 0.0, 0.0))")
        elif material.vars[name].type is wp.float32:
            lines.append(f"    m.{name} = a.{name} + wp.where(condition, b.{name}, 0.0)")
    return make_generated("\n".join([*lines, "    return m", ""]), material=material, where3=where3)
