"""The supported plugins, and typed access to a plugin's parameters with messages that name the place."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.kernels.bsdf.dispatch import COMPOSITES, MODELS
from warp_psdr.scene.catalogue import INSTEAD, MITSUBA, kind_of
from warp_psdr.scene.errors import ReportedError, SceneError, did_you_mean, error, listing
from warp_psdr.scene.kinds.table import KINDS
from warp_psdr.scene.transforms import FLOAT_MAX, as_matrix

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: Supported plugins by the XML tag (category) that introduces them.
PLUGINS: dict[str, tuple[str, ...]] = {
    "scene": ("scene",),
    "shape": (
        *("rectangle", "cube", *dict.fromkeys(kind.plugin for kind in KINDS)),
        *("obj", "ply", "serialized", "gltf", "glb", "stl", "off", "mesh"),
        *("shapegroup", "instance", "merge"),
    ),
    "bsdf": (*dict.fromkeys(model.plugin for model in (*MODELS, *COMPOSITES)), "twosided"),
    "texture": (
        *("bitmap", "checkerboard", "mesh_attribute", "volume"),
        *("rgb", "srgb", "spectrum", "uniform", "rawconstant", "d65", "blackbody", "regular", "irregular"),
    ),
    "emitter": ("area", "directionalarea", "constant", "envmap", "point", "spot", "projector", "directional", "sunsky"),
    "sensor": ("perspective", "orthographic", "thinlens", "radiancemeter", "irradiancemeter", "batch"),
    "film": ("hdrfilm", "transient_hdr_film"),
    "rfilter": ("box", "tent", "gaussian"),
    "sampler": ("independent", "sobol", "multijitter", "stratified", "orthogonal", "ldsampler"),
    "medium": ("homogeneous", "heterogeneous"),
    "phase": ("isotropic", "hg", "rayleigh", "tabphase", "blendphase", "sggx"),
    "volume": ("constvolume", "gridvolume"),
    "integrator": (
        *("path", "direct", "prb", "prb_basic", "prb_projective", "direct_projective", "ptracer"),
        *("volpath", "volpathmis", "prbvolpath", "aov", "moment"),
    ),
}

#: Whole numbers are 32-bit on the device.
INTEGER_MAX = 2**31 - 1
#: Keys of a plugin's dictionary that are no parameters.
RESERVED = ("type", "id")


class Node(dict):
    """A plugin's dictionary that knows where it was written and under which XML tag.

    Args:
        where: Place in the file, for messages.
        category: The tag, a key of ``PLUGINS``; empty when unknown.
    """

    __slots__ = ("category", "where")

    def __init__(self, values: dict | None = None, where: str = "", category: str = ""):
        super().__init__(values or {})
        self.where = where
        self.category = category


def plugin_type(node: dict, where: str) -> str:
    """Return a plugin dictionary's ``type``.

    Raises:
        ValueError: If there is none.
    """
    name = node.get("type")
    if not isinstance(name, str):
        raise error(where, f"a plugin's 'type' is {name!r}", "name the plugin, for example {'type': 'diffuse'}")
    return name


def category_of(node: dict, where: str) -> str:
    """Return the category of a plugin dictionary: "shape", "bsdf", ...

    Raises:
        ValueError: If the plugin is not supported, or stands under the wrong tag.
    """
    name = plugin_type(node, where)
    wanted = getattr(node, "category", "")
    found = next((category for category, names in PLUGINS.items() if name in names), "")
    if wanted and found != wanted and name not in PLUGINS.get(wanted, ()):
        raise unsupported_plugin(name, where, wanted)
    if not found:
        raise unsupported_plugin(name, where)
    return wanted or found


def unsupported_plugin(name: str, where: str, category: str = "") -> SceneError:
    """Return the exception for a plugin that is not supported (here); it suggests plugins of the same kind only."""
    category = category or kind_of(name)
    if category and category not in PLUGINS:
        return error(where, f"a <{category}> ('{name}') is not supported", f"supported: {listing(PLUGINS)}")
    names = PLUGINS[category] if category else [n for names in PLUGINS.values() for n in names]
    # A name of Mitsuba's is no slip of the pen.
    hint = "" if name in MITSUBA.get(category, ()) else did_you_mean(name, names)
    kind = category or "plugin"
    plural = f"{category} plugins" if category else "plugins"
    if name in INSTEAD.get(category, {}):
        return error(where, f"unsupported {category} '{name}'", INSTEAD[category][name])
    return error(where, f"unsupported {kind} '{name}'{hint}", f"supported {plural}: {listing(names)}")


def _reported(read: Callable[..., Any]) -> Callable[..., Any]:
    """Let a reader of parameters report what is wrong and go on with the default, if there is one."""

    @functools.wraps(read)
    def wrapped(self: Properties, name: str, default: Any = None, *args: Any, **kwargs: Any) -> Any:
        try:
            return read(self, name, default, *args, **kwargs)
        except SceneError as problem:
            if default is None:
                raise
            self.context.report(problem)
            return read(Properties({"type": self.type}, self.where, self.path, self.context), name, default, **kwargs)

    return wrapped


class Properties:
    """A plugin's parameters; each may be taken once, and what is left at the end is an error.

    Problems of values and unknown parameters are reported to the context, which raises them when the whole scene is
    read.

    Args:
        node: The plugin's dictionary.
        where: Its place, for messages.
        path: The name under which ``psdr.traverse`` lists its parameters.
        context: The load in progress.
    """

    def __init__(self, node: dict, where: str, path: str, context: Context):
        self.node = node
        self.where = where
        self.path = path
        self.context = context
        self.type = plugin_type(node, where)
        self._left = {key: value for key, value in node.items() if key not in RESERVED}
        self._asked: list[str] = []
        #: Whether a nested plugin was left out because its problems are reported.
        self.incomplete = False

    def place(self, name: str) -> str:
        """Return the place of a parameter, for messages."""
        return f"{self.where}, parameter '{name}'"

    def has(self, *names: str) -> bool:
        """Return whether any of the parameters is given."""
        return any(name in self.node for name in names)

    def take(self, name: str, default: Any = None) -> Any:
        """Return a parameter as it was given."""
        self._asked.append(name)
        return self._left.pop(name, default)

    def ignore(self, *names: str, reason: str) -> None:
        """Take parameters that do not matter here, with a note for each that is given."""
        for name in names:
            if name in self._left:
                self.context.note(f"{self.place(name)} is ignored: {reason}")
            self.take(name)

    @_reported
    def number(
        self,
        name: str,
        default: float | None,
        *,
        minimum: float = -np.inf,
        maximum: float = np.inf,
        exclusive: bool = False,
    ) -> float:
        """Return a finite number inside the range; ``exclusive`` leaves its ends out."""
        value = self.take(name, default)
        if isinstance(value, (bool, np.bool_)) or not _is_number(value):
            raise error(self.place(name), f"got {value!r}", "give one number")
        try:
            number = float(np.asarray(value).reshape(()))
        except OverflowError:  # a whole number of hundreds of digits
            number = np.inf
        inside = minimum < number < maximum if exclusive else minimum <= number <= maximum
        if not (abs(number) <= FLOAT_MAX and inside):
            raise error(self.place(name), f"got {number:g}", f"give {_range(minimum, maximum, exclusive)}")
        return number

    @_reported
    def integer(self, name: str, default: int, *, minimum: int | None = None, maximum: int = INTEGER_MAX) -> int:
        """Return a whole number, at least ``minimum`` and at most ``maximum``."""
        number = self.number(name, default)
        if number != round(number) or (minimum is not None and number < minimum):
            limit = "" if minimum is None else f" of at least {minimum}"
            raise error(self.place(name), f"got {number:g}", f"give a whole number{limit}")
        if abs(number) > maximum:
            raise error(self.place(name), f"got {number:g}", f"give at most {maximum}")
        return round(number)

    @_reported
    def boolean(self, name: str, default: bool) -> bool:
        """Return a truth value."""
        value = self.take(name, default)
        if not isinstance(value, (bool, np.bool_)):
            raise error(self.place(name), f"got {value!r}", "give true or false")
        return bool(value)

    @_reported
    def string(self, name: str, default: str, choices: Iterable[str] = ()) -> str:
        """Return a text, one of ``choices`` if there are any."""
        value = self.take(name, default)
        names = tuple(choices)
        if not isinstance(value, str) or (names and value not in names):
            hint = did_you_mean(value, names) if isinstance(value, str) else ""
            remedy = f"give one of: {listing(names)}" if names else "give a text"
            raise error(self.place(name), f"got {value!r}{hint}", remedy)
        return value

    @_reported
    def vector(self, name: str, default: Iterable[float]) -> np.ndarray:
        """Return three finite numbers, float64."""
        value = self.take(name, default)
        try:
            vector = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            vector = np.empty(0)
        if vector.shape != (3,) or not (np.abs(vector) <= FLOAT_MAX).all():
            raise error(self.place(name), f"got {value!r}", "give three finite numbers")
        return vector

    def transform(self, name: str) -> np.ndarray:
        """Return an invertible affine 4x4 matrix, float64; identity when it is not given."""
        return self.context.attempt(lambda: self._transform(name), np.eye(4))

    def _transform(self, name: str) -> np.ndarray:
        value = self.take(name)
        if value is None:
            return np.eye(4)
        try:
            matrix = as_matrix(value)
        except SceneError as problem:
            raise SceneError(f"{self.place(name)}: {problem}") from None
        if np.abs(matrix).max() > FLOAT_MAX:
            raise error(self.place(name), "the matrix holds numbers beyond 32-bit floats", "scale the scene down")
        singular = np.linalg.svd(matrix[:3, :3], compute_uv=False)
        if singular[-1] <= 1e-10 * singular[0] or singular[0] == 0.0:
            raise error(
                self.place(name), "the matrix is singular", "give an invertible one (no zero scale, no repeated rows)"
            )
        return matrix

    def plugins(self) -> list[tuple[str, dict, str, str]]:
        """Return the nested plugins, references resolved, as (key, node, where, category); unusable ones are taken."""
        found = []
        for key, value in list(self._left.items()):
            if isinstance(value, dict):
                nested = self.context.attempt(functools.partial(self._nested, key, value), None)
                if nested is None:
                    self.take(key)
                    self.incomplete = True
                else:
                    found.append(nested)
        return found

    def _nested(self, key: str, value: dict) -> tuple[str, dict, str, str]:
        node, where = self.context.resolve(value, self.context.inside(self.where, key, value))
        if id(node) in self.context.broken:
            raise ReportedError(where)
        return key, node, where, category_of(node, where)

    def children(self, category: str, limit: int = 1) -> list[tuple[str, dict, str]]:
        """Take the nested plugins of a category, whatever their keys, as (key, node, where), at most ``limit``."""
        found = [(key, node, where) for key, node, where, kind in self.plugins() if kind == category]
        if len(found) > limit:
            keys = listing(f"'{key}'" for key, _, _ in found)
            problem = error(self.where, f"{len(found)} {category} plugins ({keys})", f"give at most {limit}")
            self.context.report(problem)
        for key, _, _ in found:
            self.take(key)
        return found[:limit]

    def finish(self) -> None:
        """Report the parameters that nothing asked for."""
        for name in list(self._left):
            self.context.attempt(functools.partial(self._refuse, name), None)

    def _refuse(self, name: str) -> None:
        # Nested plugins without a name of their own have one of the reader's.
        known = sorted(asked for asked in set(self._asked) if not asked.startswith("_arg_"))
        remedy = f"its parameters are: {listing(known) or 'none'}"
        value = self._left[name]
        if isinstance(value, dict):
            _, node, where, category = self._nested(name, value)
            unnamed = name.startswith("_arg_")
            if category != "texture" or name in known or unnamed:
                called = "without a name" if unnamed else f"as '{name}'"
                problem = f"a '{self.type}' takes no {category} plugin here (got '{node.get('type')}' {called})"
                raise error(where, problem, remedy)
        raise error(self.where, f"'{self.type}' has no parameter '{name}'{did_you_mean(name, known)}", remedy)


def _is_number(value: Any) -> bool:
    if isinstance(value, (int, float, np.number)):
        return True
    return isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "iuf"


def _range(minimum: float, maximum: float, exclusive: bool) -> str:
    if np.isinf(minimum) and np.isinf(maximum):
        return "a finite number"
    if np.isinf(maximum):
        return f"a finite number {'above' if exclusive else 'of at least'} {minimum:g}"
    if np.isinf(minimum):
        return f"a finite number {'below' if exclusive else 'of at most'} {maximum:g}"
    ends = ", ends excluded" if exclusive else ""
    return f"a number between {minimum:g} and {maximum:g}{ends}"
