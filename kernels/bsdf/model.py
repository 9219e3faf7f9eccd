"""What a scattering model declares: its parameters, its lobes and its functions.

A model is one file of this folder, which ends with a ``Model``, and one row of ``MODELS`` in ``dispatch.py``. Scene
files, parameter names, valid ranges, the plan's lines, gradients and the generic tests follow from the declaration.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import SignedLobes, Split
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION, LOBE_NULL, LOBE_SMOOTH

#: Where a value comes from: what a texture holds, how it rises along texture coordinates (d/du, d/dv, 0), or the
#: geometry: +1 or -1 on the back of a two-sided surface, or dp/du and dp/dv in the shading frame (``measures.py``).
TEXTURE, GRADIENT, SIDE, METRIC = "texture", "gradient", "side", "metric"
#: Sources that no texture has a part in.
GEOMETRY = (SIDE, METRIC)
#: Least index of refraction of a ``SpecularIndex``.
MIN_INDEX = 0.01


class Value(NamedTuple):
    """What device code reads of a material as ``material.<name>``: a number, a colour, or the address of a table.

    Attributes:
        name: its name.
        color: whether it is a colour.
        low: least value.
        high: greatest value.
        size: how many numbers a table holds; 0: it is none.
        source: where it comes from.
    """

    name: str
    color: bool
    low: float = 0.0
    high: float = math.inf
    size: int = 0
    source: str = TEXTURE

    @property
    def type(self) -> type:
        """Warp type of the member; see ``table_entry`` for an address."""
        return wp.uint64 if self.size else wp.vec3 if self.color else wp.float32


@dataclass(frozen=True)
class Color:
    """A parameter that is a colour or a texture, read as a value of the same name."""

    name: str
    default: float = 1.0
    high: float = 1.0

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, True, 0.0, self.high),)


@dataclass(frozen=True)
class Number:
    """A parameter that is a number or a texture of numbers.

    Attributes:
        name: of the parameter.
        low: least value.
        high: greatest value; device code takes texels and values beyond the ends for the ends.
        default: None: it has to be given.
        read: name of the value, where it is not that of the parameter.
    """

    name: str
    low: float = 0.0
    high: float = 1.0
    default: float | None = None
    read: str = ""

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.read or self.name, False, self.low, self.high),)


@dataclass(frozen=True)
class PlainNumber:
    """A parameter that is a bare number, listed without ``.value``."""

    name: str
    default: float
    low: float = -math.inf
    high: float = math.inf

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, False, self.low, self.high),)


@dataclass(frozen=True)
class NormalTexture:
    """A texture that has to be given, whose colours stand for directions and are read as they are."""

    name: str

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, True, 0.0, 1.0),)


@dataclass(frozen=True)
class HeightTexture:
    """The one nested texture of a plugin, whatever its name there, of which device code reads how it rises."""

    name: str

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, True, -math.inf, math.inf, source=GRADIENT),)


@dataclass(frozen=True)
class Measured:
    """A value that the geometry gives, no parameter of scene files; ``source`` is one of ``GEOMETRY``."""

    name: str
    source: str

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, self.source == METRIC, -math.inf, math.inf, source=self.source),)


@dataclass(frozen=True)
class ComplexIndex:
    """The complex index of refraction of a conductor: ``eta`` and ``k``, or the name of a ``material``."""

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return Value("eta", True), Value("k", True)


@dataclass(frozen=True)
class RelativeIndex:
    """The ratio of ``int_ior`` and ``ext_ior``, a bare number that is listed as ``eta`` and read as ``ior``.

    Attributes:
        interior: default of ``int_ior``, a name or a number.
        exterior: default of ``ext_ior``.
        low: least ratio that the model takes.
        high: greatest ratio that the model takes.
        gap: how far from 1 the ratio has to be at load.
    """

    interior: str
    exterior: str = "air"
    low: float = 0.0
    high: float = math.inf
    gap: float = -1.0

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value("ior", False, self.low, self.high),)


@dataclass(frozen=True)
class SpecularIndex:
    """The index of refraction of a surface as ``eta``, or as the share ``specular`` of 8 % that it reflects.

    A bare number, listed under the name that it is given by. The value of the other one is 0.

    Attributes:
        default: of ``specular``, where neither is given.
        gap: how far from 1 the index has to be at load.
    """

    default: float
    gap: float = -1.0

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return Value("ior", False, MIN_INDEX), Value("specular", False, 0.0, 1.0)


@dataclass(frozen=True)
class Rate:
    """How often a lobe is sampled beside others: a bare number that no image depends on, and so not listed.

    Attributes:
        name: of the parameter and of the value.
        default: its value when it is not given.
        low: least value.
    """

    name: str
    default: float
    low: float = 0.0

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, False, self.low),)


@dataclass(frozen=True)
class Roughness:
    """``alpha``, or ``alpha_u`` and ``alpha_v``: root mean square slopes of microfacets, textures."""

    default: float
    low: float

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return Value("alpha_u", False, self.low, 1.0), Value("alpha_v", False, self.low, 1.0)

    @property
    def axes(self) -> tuple[tuple[str, str], ...]:
        """The values along the tangents."""
        return (("alpha_u", "alpha_v"),)


@dataclass(frozen=True)
class UniformRoughness:
    """``alpha``, the root mean square slope of microfacets: one bare number for the whole surface, no texture."""

    default: float
    low: float

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value("alpha", False, self.low, 1.0),)


@dataclass(frozen=True)
class Table:
    """Numbers that follow from other values of the material; no parameter of scene files.

    The host computes them when a scene is loaded and whenever one of those values has changed
    (``warp_psdr/scene/materials/tables.py``). Device code reads them with ``table_entry`` and takes them as constants:
    a table that carries a derivative holds it beside the value.

    Attributes:
        name: of the value, and of the function in ``warp_psdr.scene.materials.tables.MAKERS`` that fills it.
        size: how many numbers it holds.
        of: the values that it follows from, bare numbers.
    """

    name: str
    size: int
    of: tuple[str, ...]

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads."""
        return (Value(self.name, False, size=self.size),)


class MadeTable(NamedTuple):
    """A table of a model, perhaps of one that is nested in another.

    Attributes:
        name: of the value.
        maker: key of ``MAKERS``.
        variant: of the model that declares it.
        size: how many numbers it holds.
        of: the values that it follows from.
    """

    name: str
    maker: str
    variant: str
    size: int
    of: tuple[str, ...]


def tables_of(parameter, variant: str) -> tuple[MadeTable, ...]:
    """Return the tables of a parameter: of a ``Table`` itself, or of nested models."""
    if isinstance(parameter, Table):
        return (MadeTable(parameter.name, parameter.name, variant, parameter.size, parameter.of),)
    return getattr(parameter, "tables", ())


@wp.func_native("return ((const float*)address)[index];")
def table_entry(address: wp.uint64, index: wp.int32) -> wp.float32:
    """Number ``index`` of a material's table; a constant to ``wp.grad``."""
    return wp.float32(0.0)


@dataclass(frozen=True)
class Choice:
    """A string that selects a variant of the model; each variant is compiled as a model of its own."""

    name: str
    default: str
    options: tuple[str, ...]

    @property
    def values(self) -> tuple[Value, ...]:
        """Nothing: it is known when the model is compiled."""
        return ()


@dataclass(frozen=True)
class Flag:
    """A boolean that selects a variant of the model where it is not the default."""

    name: str
    default: bool = False

    @property
    def values(self) -> tuple[Value, ...]:
        """Nothing: it is known when the model is compiled."""
        return ()

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the variants."""
        return "", f"no_{self.name}" if self.default else self.name


@dataclass(frozen=True)
class Accepted:
    """A boolean that scene files may give; anything but its default is noted and changes nothing."""

    name: str
    default: bool
    reason: str

    @property
    def values(self) -> tuple[Value, ...]:
        """Nothing."""
        return ()


class Functions(NamedTuple):
    """Warp functions of one model. Directions are local and point away from the surface, see ``dispatch.py``.

    Attributes:
        sample: ``(material, wi, u, v) -> BsdfSample``: draw a direction from any of the lobes.
        eval: ``(material, wi, wo) -> vec3``: smooth lobes, f_s times the cosine of ``wo``, 1/sr; differentiable.
        pdf: ``(material, wi, wo) -> float32``: density of the smooth part of ``sample``, solid angle; it integrates to
            the probability of the smooth lobes.
        scatter: ``(material, wi, lobe) -> Scattered``: direction and weight of a delta lobe, not divided by its
            probability; differentiable.
        probability: ``(material, wi, lobe) -> float32``: of a delta lobe in ``sample``. Every model with delta lobes
            has it, for ``composite.py`` and ``transmittance.py``.
        relative_eta: ``(material, wi) -> float32``: index of refraction behind the interface over the one in front.
            None: nothing is transmitted.
        slopes: ``(material) -> vec2``: root mean square slopes of a glossy lobe about the mirror direction, along the
            tangents. None: there is no such lobe.
        normal: ``(material, wi) -> vec3``: the normal that lobes are about. None: it is that of the surface.
        split: the derivative by its roughness, split into two lobes of one sign each (``decomposition.py``). None:
            there is none.
        signed: derivatives that are sums of lobes of one sign as they stand (``decomposition.py``). None: there are
            none.
        branches: whether ``sample``, ``eval`` and ``pdf`` branch. Those that do not select among what they compute, of
            any directions, so that they are computed for paths side by side, also for those on other materials. They
            select by ``where_number`` and ``where3``: the adjoint of ``wp.where`` branches.
    """

    sample: wp.Function
    eval: wp.Function | None = None
    pdf: wp.Function | None = None
    scatter: wp.Function | None = None
    probability: wp.Function | None = None
    relative_eta: wp.Function | None = None
    slopes: wp.Function | None = None
    normal: wp.Function | None = None
    split: Split | None = None
    signed: SignedLobes | None = None
    branches: bool = True


@dataclass(frozen=True)
class Model:
    """A scattering model.

    Attributes:
        plugin: its name in scene files.
        parameters: of the plugin, in the order in which scene files are read.
        lobes: which lobes it has, out of ``LOBE_SMOOTH``, ``LOBE_DELTA_REFLECTION``, ``LOBE_DELTA_TRANSMISSION``,
            ``LOBE_NULL``.
        make: ``(record, variant) -> Functions``, ``record`` the struct of a scene's material values.
        turned_by: values that the direction of a delta lobe depends on.
        framed: whether the model needs dp/du whatever its values are, and shapes texture coordinates for it.
        brushed: whether lobes follow dp/du whatever its values are; any tangent does on shapes that have none.
        passes: whether a smooth lobe lies behind the surface.
        glossy: whether light is scattered at microfacets that are as many on one side of the normal as on the other.
        splits: values of the roughness along the tangents whose derivative is split, see ``Functions.split``.
        masked: whether more than the density of normals depends on these.
        signed: values whose derivative is two lobes of one sign each, see ``Functions.signed``.
        mixes: values that ``eval`` and ``scatter`` are linear in.
        tilts: values that the normal of smooth lobes depends on.
        when: name of a parameter. Where a scene file gives it, other than as the number 0, this model serves the plugin
            and not the one of the same name; its variants bear the name.
    """

    plugin: str
    parameters: tuple
    lobes: tuple[int, ...]
    make: Callable[[type, str], Functions]
    turned_by: tuple[str, ...] = ()
    framed: bool = False
    brushed: bool = False
    passes: bool = False
    glossy: bool = False
    splits: tuple[str, ...] = ()
    masked: bool = False
    signed: tuple[str, ...] = ()
    mixes: tuple[str, ...] = ()
    tilts: tuple[str, ...] = ()
    when: str = ""

    @property
    def values(self) -> tuple[Value, ...]:
        """What device code reads of a material."""
        return tuple(value for parameter in self.parameters for value in parameter.values)

    @property
    def decomposed(self) -> tuple[str, ...]:
        """Values whose derivative is known as lobes of one sign."""
        return (*self.splits, *self.signed, *self.mixes)

    @property
    def axes(self) -> tuple[tuple[str, str], ...]:
        """Pairs of values along the tangents; where those of a pair differ, the model needs dp/du."""
        return tuple(pair for parameter in self.parameters for pair in getattr(parameter, "axes", ()))

    def tables(self, variant: str) -> tuple[MadeTable, ...]:
        """Return what the host computes from the values of a material."""
        return tuple(table for parameter in self.parameters for table in tables_of(parameter, variant))

    @property
    def variants(self) -> tuple[str, ...]:
        """Names of the variants, the options of all choices and flags in order; one empty name: there are none."""
        found: list[tuple[str, ...]] = [()]
        for parameter in self.parameters:
            if isinstance(parameter, Choice | Flag):
                found = [(*chosen, option) for chosen in found for option in parameter.options]
        return tuple(variant_of((self.when, *chosen)) for chosen in found)

    @property
    def has_smooth(self) -> bool:
        """Whether there is a lobe that a connection of two points can meet."""
        return LOBE_SMOOTH in self.lobes

    @property
    def has_delta(self) -> bool:
        """Whether there is a lobe of a single direction."""
        return self.mirrors or self.transmits

    @property
    def transmits(self) -> bool:
        """Whether light passes the surface in a delta lobe."""
        return LOBE_DELTA_TRANSMISSION in self.lobes or self.has_null

    @property
    def has_null(self) -> bool:
        """Whether light passes the surface without being turned: a delta lobe too."""
        return LOBE_NULL in self.lobes

    @property
    def mirrors(self) -> bool:
        """Whether the surface shows mirror images."""
        return LOBE_DELTA_REFLECTION in self.lobes


def variant_of(options: Iterable[str]) -> str:
    """Return the name of a variant from the options that were chosen."""
    return " ".join(filter(None, options))


def key_of(plugin: str, variant: str = "", children: tuple[str, ...] = ()) -> str:
    """Return the name of a model's variant, for example "roughconductor (ggx)".

    With the keys of nested models it is that of a composite, for example "blendbsdf(diffuse, roughconductor (ggx))".
    """
    nested = f"({', '.join(children)})" if children else ""
    return f"{plugin}{nested} ({variant})" if variant else f"{plugin}{nested}"
