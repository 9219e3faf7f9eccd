"""What ``warp-psdr fit`` is told: a scene, target images, the unknown parameters, and how to look for them.

As a file, TOML or JSON, with paths relative to the file:

.. code-block:: toml

    scene = "bunny.xml"
    targets = ["targets/view_0.exr", "targets/view_1.exr"]    # one per sensor of the scene, in order
    output = "out/bunny"
    iterations = 200
    spp = 16

    [parameters."bunny.bsdf.reflectance.data"]
    lr = 0.02
    initial = 0.5

    [integrator]
    max_depth = 4
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warp_psdr.options.integrator import PathIntegrator

__all__ = ["FitConfig", "Unknown"]

LOSSES = ("l2", "l1", "huber", "relative_l2")
INTEGRATOR_FIELDS = ("max_depth", "rr_depth", "hide_emitters", "sampler", "boundary")
#: Seeds are 32-bit on the device.
MAX_SEED = 2**32 - 1
#: Counts are 32-bit on the device.
MAX_COUNT = 2**31 - 1
#: Size of a configuration's file: a thousand targets take a hundredth. Readers of TOML take quadratic time.
MAX_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """One parameter that is to be recovered.

    Attributes:
        lr: Learning rate: about the largest change of an entry in one step, in the parameter's own unit.
        initial: Value to start from: a number or one number a channel for every entry, the name of a ``.npy`` or image
            file of the parameter's shape, or ``None`` for what the scene says.
    """

    lr: float
    initial: float | tuple[float, ...] | Path | None = None


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Everything that determines a fit. Two equal configurations give equal bits.

    Attributes:
        scene: Scene file.
        targets: Target images (EXR, linear), one a view.
        parameters: The unknown parameters by their name in ``psdr.traverse``.
        output: Folder for checkpoints and results.
        sensors: Sensor of every target; ``None``: sensor i for target i.
        iterations: Steps of the optimiser.
        views_per_step: Views rendered in a step, in shuffled order; ``None``: all of them in every step.
        spp: Samples a pixel of the image in a step.
        spp_grad: Samples a pixel of its gradient; ``None``: as many as ``spp``.
        final_spp: Samples a pixel of the pictures at the end.
        seed: Seeds of all steps derive from it.
        loss: Name of a function in ``psdr.losses``.
        lr_half_life: Steps after which all learning rates have halved; ``None``: they stay.
        betas: Adam's decay rates of the running means of the gradient and of its square, see ``psdr.optim.Adam``. A
            second one below 0.999 forgets the large gradients of the first steps sooner.
        mask_updates: Leave entries of zero gradient alone, see ``psdr.optim.Adam``.
        checkpoint_every: Steps from one checkpoint to the next.
        integrator: Options of ``psdr.PathIntegrator`` that replace those of the scene file: ``max_depth``,
            ``rr_depth``, ``hide_emitters``, ``sampler``, and ``boundary`` ("none" leaves the boundary term out).
        defaults: Values for the ``$parameters`` of the scene file.
        allow_outside: Folders in or below which the scene may read files beside its own, see ``psdr.load_file``. What
            the configuration itself names may lie anywhere: it is to be trusted like a command.
        max_collisions: How many tentative collisions a flight through a medium may take, see ``psdr.load_file``.
        device: Warp device.

    Raises:
        TypeError: If a value has the wrong type.
        ValueError: If a value is out of range; each error names the field, what was got, and what was expected.
    """

    scene: Path
    targets: tuple[Path, ...]
    parameters: Mapping[str, Unknown]
    output: Path
    sensors: tuple[int, ...] | None = None
    iterations: int = 200
    views_per_step: int | None = None
    spp: int = 16
    spp_grad: int | None = None
    final_spp: int = 64
    seed: int = 0
    loss: str = "l2"
    lr_half_life: float | None = None
    betas: tuple[float, float] = (0.9, 0.999)
    mask_updates: bool = False
    checkpoint_every: int = 25
    integrator: Mapping[str, int | bool | str] = field(default_factory=dict)
    defaults: Mapping[str, str | int | float] = field(default_factory=dict)
    allow_outside: tuple[Path, ...] = ()
    max_collisions: float = 1e7
    device: str = "cpu"

    def __post_init__(self):
        """Check and normalise every field."""
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731  # the dataclass is frozen
        put("scene", _path("scene", self.scene))
        put("output", _path("output", self.output))
        put("targets", tuple(_path(f"targets[{i}]", p) for i, p in enumerate(_list("targets", self.targets))))
        if not self.targets:
            raise ValueError("fit config: targets: got none, expected one image a view")
        if self.sensors is not None:
            sensors = _list("sensors", self.sensors)
            put("sensors", tuple(_whole(f"sensors[{i}]", s, 0) for i, s in enumerate(sensors)))
            if len(self.sensors) != len(self.targets):
                raise ValueError(
                    f"fit config: sensors: got {len(self.sensors)} for {len(self.targets)} targets; give one a target"
                )
        put("parameters", _unknowns(self.parameters))
        for name in ("iterations", "spp", "final_spp", "checkpoint_every"):
            _whole(name, getattr(self, name), 1)
        _whole("seed", self.seed, 0, MAX_SEED)
        if self.spp_grad is not None:
            _whole("spp_grad", self.spp_grad, 1)
        if self.views_per_step is not None and _whole("views_per_step", self.views_per_step, 1) > len(self.targets):
            raise ValueError(
                f"fit config: views_per_step: got {self.views_per_step}, expected at most the {len(self.targets)} views"
            )
        if self.loss not in LOSSES:
            raise ValueError(f"fit config: loss: got {self.loss!r}, expected one of {', '.join(LOSSES)}")
        if self.lr_half_life is not None:
            put("lr_half_life", _positive("lr_half_life", self.lr_half_life))
        put("betas", tuple(_number(f"betas[{i}]", beta) for i, beta in enumerate(_list("betas", self.betas))))
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise ValueError(f"fit config: betas: got {list(self.betas)}, expected two numbers in [0, 1)")
        if not isinstance(self.mask_updates, bool):
            raise TypeError(f"fit config: mask_updates: got {self.mask_updates!r}, expected true or false")
        if not isinstance(self.device, str):
            raise TypeError(f"fit config: device: got {self.device!r}, expected a name such as 'cpu' or 'cuda:0'")
        put("max_collisions", _positive("max_collisions", self.max_collisions))
        put("integrator", _integrator(self.integrator))
        put("defaults", _defaults(self.defaults))
        folders = _list("allow_outside", self.allow_outside)
        put("allow_outside", tuple(_path(f"allow_outside[{i}]", folder) for i, folder in enumerate(folders)))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> FitConfig:
        """Read a TOML or JSON file; relative paths in it start at its folder.

        Raises:
            FileNotFoundError: If there is no such file.
            TypeError: If a value has the wrong type.
            ValueError: If the file is malformed, or a field is unknown, missing or out of range.
        """
        path = Path(path)
        if not os.path.isfile(path):
            raise FileNotFoundError(f"fit config {path} does not exist")
        if path.suffix.lower() not in (".toml", ".json"):
            raise ValueError(f"fit config {path}: got suffix {path.suffix!r}, expected .toml or .json")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"fit config {path}: got {size} bytes, expected at most {MAX_BYTES}; is it another file?")
        try:
            text = path.read_text(encoding="utf-8")
            values = tomllib.loads(text) if path.suffix.lower() == ".toml" else json.loads(text)
        except (ValueError, RecursionError) as error:  # numbers of thousands of digits and broken UTF-8 included
            raise ValueError(f"fit config {path} is malformed: {error}") from error
        return cls.from_mapping(values, folder=path.parent)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], *, folder: str | os.PathLike[str] = ".") -> FitConfig:
        """Make a configuration from plain values; relative paths start at ``folder``.

        Raises:
            TypeError: If a value has the wrong type.
            ValueError: If a field is unknown, missing or out of range.
        """
        if not isinstance(values, Mapping):
            raise TypeError(f"fit config: got {type(values).__name__}, expected a table of fields")
        fields = dataclasses.fields(cls)
        _known("fit config", values, [f.name for f in fields])
        required = [f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING]
        missing = [name for name in required if name not in values]
        if missing:
            raise ValueError(f"fit config: {', '.join(missing)} missing; expected at least {', '.join(required)}")
        config = cls(**values)
        folder = Path(folder)
        unknowns = {
            name: dataclasses.replace(unknown, initial=folder / unknown.initial)
            if isinstance(unknown.initial, Path)
            else unknown
            for name, unknown in config.parameters.items()
        }
        return dataclasses.replace(
            config,
            scene=folder / config.scene,
            output=folder / config.output,
            targets=tuple(folder / target for target in config.targets),
            allow_outside=tuple(folder / outside for outside in config.allow_outside),
            parameters=unknowns,
        )

    def fingerprint(self) -> dict[str, Any]:
        """Return what a checkpoint must have been made with to be continued: all that changes the bits of a step.

        ``iterations`` is not part of it, so that a finished run can be prolonged; nor are file names.
        """
        names = ("views_per_step", "spp", "spp_grad", "seed", "loss", "lr_half_life", "mask_updates", "device")
        values: dict[str, Any] = {name: getattr(self, name) for name in names}
        values["betas"] = list(self.betas)
        values["sensors"] = list(self.views)
        values["integrator"] = dict(self.integrator)
        values["defaults"] = dict(self.defaults)
        values["lr"] = {name: unknown.lr for name, unknown in self.parameters.items()}
        return values

    @property
    def views(self) -> tuple[int, ...]:
        """Sensor of every target."""
        return self.sensors if self.sensors is not None else tuple(range(len(self.targets)))


def _unknowns(parameters: Any) -> dict[str, Unknown]:
    if not isinstance(parameters, Mapping):
        raise TypeError(f"fit config: parameters: got {parameters!r}, expected a table of names, each with its lr")
    if not parameters:
        raise ValueError("fit config: parameters: got none, expected at least one unknown, each with its lr")
    result = {}
    for name, unknown in parameters.items():
        where = f"parameters.{name!r}"
        if isinstance(unknown, Unknown):
            unknown = {"lr": unknown.lr, "initial": unknown.initial}
        if not isinstance(unknown, Mapping):
            raise TypeError(f"fit config: {where}: got {unknown!r}, expected a table with lr and, if wanted, initial")
        _known(f"fit config: {where}", unknown, ["lr", "initial"])
        if "lr" not in unknown:
            raise ValueError(f"fit config: {where}: lr missing; expected a positive number")
        initial = unknown.get("initial")
        if isinstance(initial, str | os.PathLike):
            initial = _path(f"{where}.initial", initial)
        elif isinstance(initial, Sequence):
            initial = tuple(_number(f"{where}.initial[{i}]", value) for i, value in enumerate(initial))
        elif initial is not None:
            initial = _number(f"{where}.initial", initial)
        result[str(name)] = Unknown(lr=_positive(f"{where}.lr", unknown["lr"]), initial=initial)
    return result


def _integrator(options: Any) -> dict[str, int | bool | str]:
    if not isinstance(options, Mapping):
        raise TypeError(f"fit config: integrator: got {options!r}, expected a table")
    _known("fit config: integrator", options, INTEGRATOR_FIELDS)
    try:
        PathIntegrator(**integrator_options(options))
    except ValueError as error:
        raise ValueError(f"fit config: integrator: {error}") from None
    return dict(options)


def _defaults(defaults: Any) -> dict[str, str | int | float]:
    if not isinstance(defaults, Mapping):
        raise TypeError(f"fit config: defaults: got {defaults!r}, expected a table of the scene's $parameters")
    for name, value in defaults.items():
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise TypeError(f"fit config: defaults.{name}: got {value!r}, expected a number or a text")
    return dict(defaults)


def integrator_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of ``psdr.PathIntegrator``: TOML has no null, so "none" leaves the boundary term out."""
    return {name: None if name == "boundary" and value == "none" else value for name, value in options.items()}


def _known(where: str, values: Mapping[str, Any], names: Sequence[str]) -> None:
    for name in values:
        if name not in names:
            close = difflib.get_close_matches(str(name), names, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise ValueError(f"{where}: unknown field {name!r}, expected one of {', '.join(names)}{hint}")


def _path(where: str, value: Any) -> Path:
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        raise TypeError(f"fit config: {where}: got {value!r}, expected the name of a file")
    return Path(value)


def _list(where: str, value: Any) -> Sequence[Any]:
    if isinstance(value, str | bytes) or not isinstance(value, Sequence):
        raise TypeError(f"fit config: {where}: got {value!r}, expected a list")
    return value


def _whole(where: str, value: Any, low: int, high: int = MAX_COUNT) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"fit config: {where}: got {value!r}, expected a whole number")
    if value < low:
        raise ValueError(f"fit config: {where}: got {value}, expected at least {low}")
    if value > high:
        raise ValueError(
            f"fit config: {where}: got {value if value < 2**64 else float('inf')}, expected at most {high}"
        )
    return value


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"fit config: {where}: got {value!r}, expected a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"fit config: {where}: got {number}, expected a finite number")
    return number


def _positive(where: str, value: Any) -> float:
    number = _number(where, value)
    if number <= 0.0:
        raise ValueError(f"fit config: {where}: got {value}, expected a positive number")
    return number
