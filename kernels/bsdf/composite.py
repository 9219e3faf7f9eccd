"""Models made of models: the declaration of a composite, and the functions of its children on its own record.

A composite (``blendbsdf``) is one file of this folder, which ends with a ``Composite``, and one row of ``COMPOSITES``
in ``dispatch.py``. For given children it is a ``Model`` like any other. Its values are its own and its children's, the
latter under a prefix ("first_reflectance"); nesting nests the prefixes. Code outside this folder therefore does not
distinguish a composite from a plain model.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bsdf.model import Functions, MadeTable, Model, Value, key_of
from warp_psdr.kernels.bsdf.record import make_material_record
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.structs import BsdfSample, Scattered

#: Functions of a child: name -> (arguments behind the record, result, what a model without the function returns).
SIGNATURES = {
    "eval": ("wi: wp.vec3, wo: wp.vec3", "wp.vec3", "wp.vec3(0.0, 0.0, 0.0)"),
    "pdf": ("wi: wp.vec3, wo: wp.vec3", "wp.float32", "0.0"),
    "scatter": ("wi: wp.vec3, lobe: wp.int32", "Scattered", "Scattered()"),
    "probability": ("wi: wp.vec3, lobe: wp.int32", "wp.float32", "0.0"),
    "relative_eta": ("wi: wp.vec3", "wp.float32", "1.0"),
    "slopes": ("", "wp.vec2", "wp.vec2(0.0, 0.0)"),
    "normal": ("wi: wp.vec3", "wp.vec3", "wp.vec3(0.0, 0.0, 1.0)"),
    "sample": ("wi: wp.vec3, u: wp.float32, v: wp.vec2", "BsdfSample", ""),
}


@dataclass(frozen=True)
class Nested:
    """The values of a child, a parameter of the composite as far as device code knows."""

    prefix: str
    model: Model
    variant: str

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return tuple(value._replace(name=nested_name(self.prefix, value.name)) for value in self.model.values)

    @property
    def tables(self) -> tuple[MadeTable, ...]:
        """The tables among them."""
        return tuple(
            table._replace(
                name=nested_name(self.prefix, table.name), of=tuple(nested_name(self.prefix, name) for name in table.of)
            )
            for table in self.model.tables(self.variant)
        )

    @property
    def axes(self) -> tuple[tuple[str, str], ...]:
        """Pairs of values along the tangents."""
        return tuple((nested_name(self.prefix, u), nested_name(self.prefix, v)) for u, v in self.model.axes)


class BoundChild(NamedTuple):
    """The functions of a child over the composite's record, as in ``Functions`` but all there.

    Where the child has no such function, the value is zero (``relative_eta``: one, ``normal``: upright).

    Attributes:
        sends: ``(lobe) -> float32``: 1 where the child has this lobe, else 0.
        own: what the child really has, over its own record.
    """

    sample: wp.Function
    eval: wp.Function
    pdf: wp.Function
    scatter: wp.Function
    probability: wp.Function
    relative_eta: wp.Function
    slopes: wp.Function
    normal: wp.Function
    sends: wp.Function
    own: Functions


class Child(NamedTuple):
    """A nested model.

    Attributes:
        model: its declaration.
        variant: of the model.
        prefix: of its values in the composite's record.
    """

    model: Model
    variant: str
    prefix: str

    def has(self, lobe: int) -> bool:
        """Whether the child has a lobe."""
        return lobe in self.model.lobes

    def bind(self, record: type) -> BoundChild:
        """Return the child's functions over the composite's ``record``."""
        members = self.model.values
        inner = make_material_record(tuple((value.name, value.type) for value in members))
        functions = self.model.make(inner, self.variant)
        read = ", ".join(f"mat.{nested_name(self.prefix, value.name)}" for value in members)
        bound = {name: self._over(name, functions, record, inner, read) for name in SIGNATURES}
        return BoundChild(**bound, sends=_make_sends(self.model.lobes), own=functions)

    def _over(self, name: str, functions: Functions, record: type, inner: type, read: str) -> wp.Function:
        """Return ``name(mat, ...)``: the child's function of the part of ``mat`` that is the child's."""
        arguments, result, rest = SIGNATURES[name]
        f = getattr(functions, name)
        head = f"def {self.prefix}_{name}(mat: record{', ' if arguments else ''}{arguments}) -> {result}:\n"
        passed = "".join(f", {part.split(':')[0].strip()}" for part in arguments.split(",") if part)
        body = f"    return f(inner({read}){passed})\n" if f is not None else f"    return {rest}\n"
        types = {"BsdfSample": BsdfSample, "Scattered": Scattered}
        return make_generated(head + body, record=record, inner=inner, f=f, **types)


@dataclass(frozen=True)
class Composite:
    """A model made of models.

    Attributes:
        plugin: its name in scene files.
        parameters: its own, as those of ``Model``.
        prefixes: of its children's values in the record; as many as it has children.
        places: the children's names in ``psdr.traverse``.
        make: ``(record, variant, children) -> Functions``.
        refuse: ``(children) -> str``: why these cannot be nested in it, and what can; empty: they can.
        mixes: own values that all lobes are linear in.
        turns: own values that the normal depends on, and with it the direction of a delta lobe.
        framed: whether it needs dp/du.
        adds: lobes that it has beside its children's.
        behind: name of the variant that the back of a two-sided child becomes, if that is another.
    """

    plugin: str
    parameters: tuple
    prefixes: tuple[str, ...]
    places: tuple[str, ...]
    make: Callable[[type, str, tuple[Child, ...]], Functions]
    refuse: Callable[[tuple[Child, ...]], str]
    mixes: tuple[str, ...] = ()
    turns: tuple[str, ...] = ()
    framed: bool = False
    adds: tuple[int, ...] = ()
    behind: str = ""

    def of(self, nested: tuple[tuple[Model, str], ...]) -> Model:
        """Return the model with these children, (model, variant) each."""
        children = tuple(Child(*each, prefix) for each, prefix in zip(nested, self.prefixes, strict=True))
        lobes = {lobe for child in children for lobe in child.model.lobes} | set(self.adds)
        turned = [nested_name(c.prefix, name) for c in children for name in c.model.turned_by]
        return Model(
            self.plugin,
            (*self.parameters, *(Nested(child.prefix, child.model, child.variant) for child in children)),
            tuple(sorted(lobes)),
            lambda record, variant: self.make(record, variant, children),
            turned_by=(*(self.turns if lobes - {LOBE_SMOOTH} else ()), *turned),
            framed=self.framed or any(child.model.framed for child in children),
            brushed=any(child.model.brushed for child in children),
            passes=any(child.model.passes for child in children),
            glossy=any(child.model.glossy for child in children),
            mixes=(*self.mixes, *(nested_name(c.prefix, name) for c in children for name in c.model.mixes)),
            tilts=(*self.turns, *(nested_name(c.prefix, name) for c in children for name in c.model.tilts)),
        )

    def refusal(self, nested: tuple[tuple[Model, str], ...]) -> str:
        """Say why these children, (model, variant) each, cannot be nested; empty: they can."""
        return self.refuse(tuple(Child(*each, prefix) for each, prefix in zip(nested, self.prefixes, strict=True)))


def nested_name(prefix: str, name: str) -> str:
    """Return the name of a child's value in the composite's record."""
    return f"{prefix}_{name}"


def split_key(key: str) -> tuple[str, str, tuple[str, ...]]:
    """Return plugin, variant and the children's keys of a composite's key, as ``key_of`` put them together.

    Raises:
        ValueError: It is not the key of a composite.
    """
    plugin, _, rest = key.partition("(")
    depth, start = 1, 0
    children: list[str] = []
    for i, letter in enumerate(rest):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if (depth == 1 and rest[i : i + 2] == ", ") or depth == 0:
            children.append(rest[start:i])
            start = i + 2
        if depth == 0:
            variant = rest[i + 1 :].removeprefix(" (").removesuffix(")")
            if plugin.isidentifier() and key == key_of(plugin, variant, tuple(children)):
                return plugin, variant, tuple(children)
            break
    raise ValueError(f"{key!r} is no key of a nested model, such as 'blendbsdf(diffuse, conductor)'")


def _make_sends(lobes: tuple[int, ...]) -> wp.Function:
    bits = sum(1 << lobe for lobe in lobes)

    @wp.func
    def sends(lobe: wp.int32) -> wp.float32:
        return wp.where(((wp.static(bits) >> lobe) & 1) == 1, 1.0, 0.0)

    return sends
