"""The named values of a scene: reading, writing, and requests for derivatives."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import html
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.scene.materials.spectra import check_range

if TYPE_CHECKING:
    from warp_psdr.scene.layout import Parameter
    from warp_psdr.scene.scene import Scene


def parameter_of(scene: Scene, name: str) -> Parameter:
    """Return where a parameter is held.

    Raises:
        KeyError: there is no such parameter; the message names those that are close.
    """
    try:
        return scene.parameters[name]
    except KeyError:
        base, _dot, kind = str(name).rpartition(".")
        held = [s.geometry for s in scene.description.shapes if s.geometry is not None and s.path == base]
        if held and kind.startswith("vertex_"):
            missing, own = f"{base!r} is {held[0].title}, which has no vertices", next(iter(held[0].parameters()), "")
            if own:
                raise KeyError(f"{missing}: its parameters are '{base}.{own}' and '{base}.to_world'") from None
            raise KeyError(
                f"{missing}: its parameter is '{base}.to_world'; leave out 'exact' to have it as triangles, with "
                f"{name!r}"
            ) from None
        close = difflib.get_close_matches(str(name), scene.parameters, n=3, cutoff=0.4)
        all_of_them = "print(params), or 'warp-psdr plan SCENE', lists them all"
        hint = f"did you mean {', '.join(map(repr, close))}?" if close else all_of_them
        raise KeyError(f"the scene has no parameter {name!r}; {hint}") from None


def _squeezed(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return a shape without its axes of length one."""
    return tuple(n for n in shape if n != 1)


def traverse(scene: Scene) -> Parameters:
    """Return the parameters of a scene under Mitsuba 3's names.

    Args:
        scene: a loaded scene.

    Returns:
        A mapping from names such as ``"wall.reflectance.value"`` to ``wp.array`` views: colours ``(3,)``, greys and
        numbers ``(1,)``, poses ``(4, 4)``, bitmaps ``(H, W, C)``, positions and normals ``(N,)`` of vec3.
    """
    check_loaded(scene)
    return Parameters(scene)


def check_owner(scene: Scene, params: Parameters) -> None:
    """Refuse parameters of another scene, whose gradients and values lie elsewhere.

    Raises:
        TypeError: these are no parameters.
        ValueError: they belong to another scene.
    """
    if not isinstance(params, Parameters):
        raise TypeError(f"params: got {type(params).__name__}, expected what psdr.traverse(scene) returns")
    if params.scene is not scene:
        raise ValueError("params: they belong to another scene; pass those of psdr.traverse(scene) for this one")


def check_independent(scene: Scene, names: Iterable[str]) -> None:
    """Refuse names of values that follow others among them: vertices a pose, normals a pose or the positions.

    Each has a derivative with the others at rest; set together, what is set stays, whatever it would follow.

    Raises:
        ValueError: there are such names.
    """
    given = set(names)
    for name in sorted(given):
        base, _dot, kind = name.rpartition(".")
        followers = []
        if kind == "to_world":
            followers = ["vertex_positions", "vertex_normals"]
        if kind == "vertex_positions" and (scene.derived_normals([name]) or scene.instances.derived_normals([name])):
            followers = ["vertex_normals"]
        for follower in (f"{base}.{f}" for f in followers):
            if follower in given:
                raise ValueError(f"{follower!r} follows {name!r}: they cannot change together; leave one of them out")


class Parameters(Mapping):
    """Named views onto the values of a scene.

    Reading gives the live array; ``params[name] = values`` copies into it. The next call that renders follows all
    edits; ``update`` does so at once.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._views = {name: scene.view(name) for name in scene.parameters}
        self._requested: list[str] = []

    def __reduce__(self):
        """Return what a copy, or another process, makes the same parameters of; gradients stay behind."""
        return _traversed_again, (self._scene, self._requested)

    def __getitem__(self, name: str) -> wp.array:
        self._parameter(name)
        bound = self._scene.bindings.get(name)
        return self._views[name] if bound is None else bound

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __repr__(self) -> str:
        width = max((len(n) for n in self._views), default=0)
        lines = [
            f"  {n:<{width}}  {p.dtype.__name__:<8} {p.shape!s:<14} {', '.join(sorted(p.uses))}"
            f"{'  (gradient requested)' if n in self._requested else ''}"
            for n, p in self._scene.parameters.items()
        ]
        return "Parameters[\n" + "\n".join(lines) + "\n]"

    def _repr_html_(self) -> str:
        """Return the table that a notebook shows."""
        rows = [
            (n, p.dtype.__name__, str(p.shape), ", ".join(sorted(p.uses)), "requested" if n in self._requested else "")
            for n, p in self._scene.parameters.items()
        ]
        return html.table(("parameter", "type", "shape", "acts on", "gradient"), rows)

    def __setitem__(self, name: str, values) -> None:
        """Copy new values in; the scene follows with ``update``, or with the next call that renders.

        Args:
            name: a parameter's name.
            values: in the parameter's shape, or its numbers in one row (NumPy, Warp, or a sequence); one fills it.

        Raises:
            KeyError: there is no such parameter.
            ValueError: a wrong shape, values that are not finite, or out of the parameter's range (``bounds``). What is
                written in place (``params[name].assign``) is looked at for media and grids of shapes alone.
        """
        # What is single precision already is compared with what is there in single precision, and kept where equal.
        single = isinstance(values, wp.array) or getattr(values, "dtype", None) == np.float32
        checked = self.check(name, values, "value", np.float32 if single else np.float64)
        check_range(checked.astype(np.float32, copy=False), "params", *self.bounds(name), repr(name))
        bound = self._scene.bindings.get(name)
        if bound is not None:
            bound.assign(checked.astype(np.float32, copy=False))
        else:
            self._scene.place(name, checked)
        self._scene.pending.add(name)

    def bind(self, name: str, array: wp.array | None) -> None:
        """Let an array of yours be a parameter: ``params[name]`` is that array, and its gradient arrives in its own.

        What it holds is read whenever the scene follows edits, with each call that renders. A simulator's array of
        positions is bound once a frame, for renderings on one tape: every frame then keeps its own array. If the array
        has a gradient, the parameter is requested as by ``requires_grad``.

        Args:
            name: a parameter's name.
            array: contiguous, of the parameter's type and shape, on the scene's device. None: the scene's own array is
                the parameter again, with the values that were followed last.

        Raises:
            KeyError: there is no such parameter.
            TypeError: this is no array of the parameter's type.
            ValueError: another shape or device.
        """
        self._parameter(name)
        self._scene.bindings.set(name, array)
        if name in self._requested or (array is not None and array.requires_grad):
            self.requires_grad(name)

    def check(self, name: str, values, what: str, dtype: type = np.float32) -> np.ndarray:
        """Return ``values`` as float32 (or ``dtype``) in the parameter's NumPy shape.

        Raises:
            KeyError: there is no such parameter.
            ValueError: a wrong shape, or not finite.
        """
        p = self._parameter(name)
        array = values.numpy() if isinstance(values, wp.array) else values
        try:
            array = np.asarray(array, dtype=dtype)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{what} of {name!r}: expected numbers of shape {p.numpy_shape}, got {values!r}"
            ) from error
        if array.ndim == 0:
            array = np.full(p.numpy_shape, array, dtype)
        if array.shape != (p.size,) and _squeezed(array.shape) != _squeezed(p.numpy_shape):
            raise ValueError(
                f"{what} of {name!r}: got shape {array.shape}, expected {p.numpy_shape} ({p.size} numbers); "
                "the size of a parameter is fixed when the scene is loaded"
            )
        with np.errstate(over="ignore"):  # what overflows becomes infinite
            finite = np.isfinite(array.astype(np.float32, copy=False))
        if not finite.all():
            raise ValueError(f"{what} of {name!r}: {np.count_nonzero(~finite)} numbers are NaN or infinite")
        return np.ascontiguousarray(array.reshape(p.numpy_shape))

    def update(self, *names: str) -> None:
        """Make the scene follow edits: normals, triangle records, ray structure, light sampling, as far as needed.

        A pose moves the vertices of its shape, also those that were edited before. What is edited together with it
        stays as it is.

        Args:
            *names: what was changed. Without names: what was assigned, and what differs from what the scene followed
                last, since kernels or ``assign`` wrote it in place (a checksum of positions, poses and lights tells;
                normals of a shape in a group, which its instances follow, have to be named).
        """
        for name in names:
            self._parameter(name)
        self._scene.settle(names)

    def requires_grad(self, *patterns: str) -> None:
        """Ask for derivatives of these parameters, beside those that were asked for before; nothing else is paid for.

        Args:
            *patterns: names, or shell patterns such as ``"*.reflectance.value"``.

        Raises:
            KeyError: a name or pattern matches nothing.
            TypeError: what is given is no name.
        """
        self._request([*self._requested, *self._matching(patterns)])

    def requires_grad_only(self, *patterns: str) -> None:
        """Ask for derivatives of these parameters alone: others lose their gradients; without names, all of them do.

        Args:
            *patterns: as of ``requires_grad``.

        Raises:
            KeyError: a name or pattern matches nothing.
            TypeError: what is given is no name.
        """
        self._request(self._matching(patterns))

    def _matching(self, patterns: Iterable[str]) -> list[str]:
        found: list[str] = []
        for pattern in patterns:
            if not isinstance(pattern, str):
                raise TypeError(f"requires_grad: got {pattern!r}, expected names: requires_grad(*names)")
            matches = [pattern] if pattern in self._views else fnmatch.filter(self._views, pattern)
            if not matches:
                self._parameter(pattern)
            found += matches
        return found

    def _request(self, names: list[str]) -> None:
        requested = list(dict.fromkeys(names))
        for name in self._requested:
            if name not in requested:
                self[name].requires_grad = False
                vars(self[name]).pop("std", None)
        for name in requested:
            if self[name].grad is None:
                self[name].requires_grad = True
        self._requested = requested

    @property
    def requested(self) -> list[str]:
        """Names of what ``requires_grad`` was asked for."""
        return list(self._requested)

    def zero_grad(self) -> None:
        """Set the gradients of the requested parameters, and their standard deviations, to zero."""
        for name in self._requested:
            self[name].grad.zero_()
            if (std := getattr(self[name], "std", None)) is not None:
                std.zero_()

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the valid range of a parameter's values, for example (0, 1) for a reflectance."""
        return self._parameter(name).bounds

    @property
    def scene(self) -> Scene:
        """The scene that these parameters belong to."""
        return self._scene

    def _parameter(self, name: str) -> Parameter:
        return parameter_of(self._scene, name)


def _traversed_again(scene: Scene, requested: list[str]) -> Parameters:
    params = Parameters(scene)
    params.requires_grad(*requested)
    return params
