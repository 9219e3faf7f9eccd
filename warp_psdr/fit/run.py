"""The main job: recover named parameters of a scene from target images.

Every step renders some of the views, compares them with their targets, and lets Adam follow the gradient. Whatever is
random in step t derives from the configuration's seed and from t alone, so that a run that was stopped and resumed
gives the same bits as one that was not.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr import image_io, losses, optim
from warp_psdr.arrays import read_array
from warp_psdr.files import held
from warp_psdr.fit import checkpoint
from warp_psdr.fit.config import FitConfig, Unknown, integrator_options
from warp_psdr.plan import choice
from warp_psdr.plan.integrator import from_description
from warp_psdr.plan.transient import require_steady
from warp_psdr.progress import progress
from warp_psdr.topology.mesh_checks import MeshWatch

if TYPE_CHECKING:
    from warp_psdr.distributed.pool import Pool

__all__ = ["FitConfig", "FitResult", "Unknown", "fit"]

CHECKPOINT = "checkpoint.npz"
#: What the random numbers of a step are for: the seeds of its renders, or the order of the views.
RENDER_STREAM, ORDER_STREAM = 0, 1


@dataclass(frozen=True, kw_only=True, repr=False)
class FitResult:
    """What a fit found; notebooks show its numbers and the pictures of its views.

    Attributes:
        parameters: The recovered values by name, NumPy, in the parameters' shapes.
        losses: Loss of every step, shape ``(steps,)``.
        completed: Whether all iterations were made; ``False`` after Ctrl-C, and then there are no results but a
            checkpoint to resume from.
        output: Folder of the results.
        psnr: Decibels of every view at the end, of the sRGB images in [0, 1].
        invalid: Samples that were not finite, and dropped, by kind; see ``psdr.invalid_samples``.
    """

    parameters: Mapping[str, np.ndarray]
    losses: np.ndarray
    completed: bool
    output: Path
    psnr: tuple[float, ...] = ()
    invalid: Mapping[str, int] = field(default_factory=dict)

    def __repr__(self) -> str:
        from warp_psdr.fit.report import in_one_line

        return f"<FitResult: {in_one_line(self)}>"

    def _repr_html_(self) -> str:
        from warp_psdr.fit.report import shown

        return shown(self)


@dataclass(eq=False, kw_only=True)
class Problem:
    """A configuration with everything that it names, loaded and checked."""

    config: FitConfig
    scene: Any
    params: Any
    integrator: Any
    targets: list[np.ndarray]
    device_targets: list[wp.array] = field(default_factory=list)
    #: Samples that were dropped before the run was resumed, by kind.
    dropped: dict[str, int] = field(default_factory=dict)
    #: What renders; None: this process.
    pool: Pool | None = None

    def backward_all(self, views: Sequence[tuple[int, int, float]], following: Sequence[int] = ()) -> list[float]:
        """Add the gradients of some views, (number, seed, weight) each, and return their losses.

        ``following``: the views of the next step, whose targets a pool sends meanwhile.
        """
        if self.pool is None:
            return [self.backward(*view) for view in views]
        return self.pool.views.backward(self, views, following)

    def backward(self, view: int, seed: int, weight: float) -> float:
        """Render a view, add the gradient of ``weight`` times its loss to the parameters' and return the loss."""
        config = self.config
        tape = wp.Tape()
        with tape:
            image = psdr.render(
                self.scene,
                self.params,
                sensor=config.views[view],
                integrator=self.integrator,
                spp=config.spp,
                spp_grad=config.spp if config.spp_grad is None else config.spp_grad,
                seed=seed,
                tape=tape,
            )
            loss = getattr(losses, config.loss)(image, self.device_targets[view])
        value = float(loss.numpy()[0])
        if math.isfinite(value):  # else there is no gradient, and the caller says so
            tape.backward(grads={loss: wp.full(1, weight, dtype=wp.float32, device=loss.device)})
        return value

    def render(self, view: int, seed: int) -> np.ndarray:
        """Return a picture of a view as it is now, ``(H, W, 3)``, at the final sample count."""
        render = psdr.render if self.pool is None else self.pool.render
        options = {"sensor": self.config.views[view], "integrator": self.integrator, "seed": seed}
        return render(self.scene, self.params, spp=self.config.final_spp, **options).numpy()

    def gradients(self, step: int) -> dict[str, np.ndarray]:
        """Return the gradient of the mean loss over all views, for pictures; leaves the parameters' gradients zero."""
        views = range(len(self.targets))
        self.backward_all([(view, _seed(self.config, step, view), 1.0 / len(views)) for view in views])
        result = {name: self.params[name].grad.numpy().copy() for name in self.config.parameters}
        self.params.zero_grad()
        return result

    def values(self) -> dict[str, np.ndarray]:
        """Return the unknowns as they are now."""
        return {name: self.params[name].numpy().copy() for name in self.config.parameters}

    def invalid(self) -> dict[str, int]:
        """Return the samples that were dropped since the run's start, by kind; see ``psdr.invalid_samples``."""
        counts = psdr.invalid_samples(self.scene)
        return {kind: count + self.dropped.get(kind, 0) for kind, count in counts.items()}

    def stored(self, name: str) -> wp.array:
        """Return the device's own numbers of an unknown, flat: near the scene's origin they are finer than float32."""
        p = self.scene.parameters[name]
        return self.scene.values[p.offset : p.offset + p.size]


def fit(
    config: FitConfig,
    *,
    resume: bool = False,
    overwrite: bool = False,
    iterations: int | None = None,
    pool: Pool | None = None,
) -> FitResult:
    """Recover parameters from images.

    A checkpoint is written every ``config.checkpoint_every`` steps, at the end, and after Ctrl-C or SIGTERM, which end
    the run at the next whole step; a second Ctrl-C ends it at once.

    Args:
        config: What to do.
        resume: Continue from the checkpoint in the output folder, if there is one.
        overwrite: Start again although there is a checkpoint.
        iterations: Replaces that of ``config``.
        pool: Processes that render the views (``psdr.distributed.Pool``); the bits do not depend on it. If it is lost,
            a checkpoint of the last whole step is written.

    Returns:
        The recovered values; pictures, parameter files and a summary are in ``config.output``.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If the configuration does not fit the scene, the checkpoint belongs to another configuration, or a
            loss or gradient is not finite, or a step ruins a parameter (``mesh_checks``), or another run writes to the
            output folder; then the last checkpoint is whole.
        OSError: If the output folder cannot be written to, or the disk is full; then the last checkpoint is whole, and
            the run can be resumed from it.
    """
    if iterations is not None:
        config = replace(config, iterations=iterations)
    path = config.output / CHECKPOINT
    may_exist = resume or overwrite
    require_free(path, may_exist)
    problem = load_problem(config)
    problem.pool = pool
    adam = optim.Adam(
        problem.params,
        {name: unknown.lr for name, unknown in config.parameters.items()},
        betas=config.betas,
        mask_updates=config.mask_updates,
    )
    config.output.mkdir(parents=True, exist_ok=True)
    with held(config.output):
        require_free(path, may_exist)  # a run may have ended there since
        return _fit(problem, adam, path, resume=resume)


def require_free(path: Path, may_exist: bool) -> None:
    """Raise if there is a checkpoint that nobody wants to continue, or to lose."""
    if path.exists() and not may_exist:
        raise ValueError(f"{path} exists: resume it (--resume), start again (--overwrite), or choose another output")


def _fit(problem: Problem, adam: optim.Adam, path: Path, *, resume: bool) -> FitResult:
    """Make the steps that a checkpoint at ``path`` has not made, and write the results."""
    from warp_psdr.fit.report import write_report, write_start

    config = problem.config
    run = _digests(problem)
    history: list[float] = []
    if resume and path.exists():
        history = _restore(path, problem, adam, run)
    if not history:
        write_start(problem)
    watch = MeshWatch(problem.params)
    with _stop_requests() as stop, progress("fit", config.iterations, start=len(history)) as report:
        while len(history) < config.iterations:
            step = len(history)
            try:
                with watch.step(step + 1):
                    history.append(_step(problem, adam, step))
            except (RuntimeError, OSError):
                if problem.pool is not None and history:  # the step has not changed anything yet
                    _save(path, problem, adam, run, history)
                raise
            report(step + 1, f"loss {history[-1]:.4g}")
            if stop.is_set() or (step + 1) % config.checkpoint_every == 0 or step + 1 == config.iterations:
                _save(path, problem, adam, run, history)
            if stop.is_set() and step + 1 < config.iterations:
                return FitResult(
                    parameters=problem.values(),
                    losses=np.array(history),
                    completed=False,
                    output=config.output,
                    invalid=problem.invalid(),
                )
    psnr = write_report(problem, np.array(history))
    return FitResult(
        parameters=problem.values(),
        losses=np.array(history),
        completed=True,
        output=config.output,
        psnr=psnr,
        invalid=problem.invalid(),
    )


def load_problem(config: FitConfig) -> Problem:
    """Load scene and targets, set the unknowns to their initial values, and check that all of it fits together.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If the configuration does not fit the scene.
    """
    for name, file in (("scene", config.scene), *((f"targets[{i}]", file) for i, file in enumerate(config.targets))):
        if not os.path.isfile(file):
            raise FileNotFoundError(f"fit config: {name}: {file} does not exist")
    scene = psdr.load_file(
        config.scene,
        device=config.device,
        allow_outside=config.allow_outside,
        max_collisions=config.max_collisions,
        **config.defaults,
    )
    sensors = scene.description.sensors
    targets = []
    for sensor, file in zip(config.views, config.targets, strict=True):
        if sensor >= len(sensors):
            raise ValueError(
                f"fit config: {file.name} is the target of sensor {sensor}, but {config.scene} has {len(sensors)} "
                f"sensors; list the sensors of the targets in 'sensors'"
            )
        require_steady(scene, sensor, "a fit config")
        film = sensors[sensor].film
        targets.append(read_target(file, (film.crop_height, film.crop_width)))
    # A resumed fit has the bits of one that was not interrupted: checkpoints keep which methods were chosen.
    psdr.guiding.set_automatic(scene, False)
    choice.set_on(scene, True)
    params = psdr.traverse(scene)
    for name, unknown in config.parameters.items():
        if name not in params:
            raise ValueError(f"fit config: parameters: {_no_parameter(params, name)}")
        low, high = params.bounds(name)
        values = params[name].numpy()
        if unknown.initial is not None:
            values = _initial(name, unknown.initial, values)
        if values.min() < low or values.max() > high:
            raise ValueError(
                f"fit config: parameters.{name!r}: starts with values from {values.min():.4g} to {values.max():.4g}, "
                f"expected them in [{low:g}, {high:g}]; give another initial value"
            )
        if unknown.initial is not None:
            params[name] = values
    params.update()
    params.requires_grad(*config.parameters)
    integrator = replace(from_description(scene.description.integrator), **integrator_options(config.integrator))
    device_targets = [wp.array(target, dtype=wp.vec3, device=config.device) for target in targets]
    return Problem(
        config=config,
        scene=scene,
        params=params,
        integrator=integrator,
        targets=targets,
        device_targets=device_targets,
    )


def _step(problem: Problem, adam: optim.Adam, step: int) -> float:
    """Make one step and return its loss, the mean over the views that it rendered."""
    config = problem.config
    views = views_of_step(config, step)
    total = 0.0
    # A view may come twice, at the end of a round and at the start of the next.
    seeded = [(view, _seed(config, step, i), 1.0 / len(views)) for i, view in enumerate(views)]
    losses = problem.backward_all(seeded, views_of_step(config, step + 1))
    for view, loss in zip(views, losses, strict=True):
        if not math.isfinite(loss):
            raise ValueError(
                f"loss of view {view} ({config.targets[view].name}) is {loss} at step {step + 1}; the last checkpoint "
                f"is whole. A smaller learning rate, or a look at the scene at this step, helps to find out why"
            )
        total += loss / len(views)
    half_life = config.lr_half_life
    adam.step(scale=1.0 if half_life is None else 0.5 ** (step / half_life))
    return total


def views_of_step(config: FitConfig, step: int) -> list[int]:
    """Views of a step: slices of one shuffled round through all views after the other."""
    count = len(config.targets)
    if config.views_per_step is None or config.views_per_step == count:
        return list(range(count))
    positions = range(step * config.views_per_step, (step + 1) * config.views_per_step)
    orders = {p // count: _generator(config, ORDER_STREAM, p // count).permutation(count) for p in positions}
    return [int(orders[p // count][p % count]) for p in positions]


def _seed(config: FitConfig, step: int, number: int) -> int:
    """Return the seed of one of a step's renders: below 2^31, independent between steps and renders."""
    return int(_generator(config, RENDER_STREAM, step, number).integers(2**31))


def _generator(config: FitConfig, *key: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, *key])


def read_target(file: Path, shape: tuple[int, int]) -> np.ndarray:
    """Return a target image, ``(H, W, 3)`` float32, linear."""
    image = np.asarray(image_io.read_image(file), dtype=np.float32)
    if image.shape[:2] != shape:
        height, width = image.shape[:2]
        raise ValueError(f"target {file}: got {width} x {height} pixels, expected the film's {shape[1]} x {shape[0]}")
    if image.shape[2] in (2, 4) and (image[..., -1] < 1.0).any():
        raise ValueError(
            f"target {file}: {int((image[..., -1] < 1.0).sum())} pixels are transparent (alpha below 1), and a fit "
            "compares all of them; put the background behind them, image[..., :3] * alpha + background * (1 - alpha), "
            "and write the target without alpha"
        )
    # Grey, or colour, either with or without alpha.
    image = np.broadcast_to(image[..., :1], (*shape, 3)) if image.shape[2] <= 2 else image[..., :3]
    if not np.isfinite(image).all():
        bad = int((~np.isfinite(image)).any(axis=-1).sum())
        raise ValueError(f"target {file}: {bad} pixels are NaN or infinite; repair or render it again")
    return np.ascontiguousarray(image)


def _initial(name: str, initial: float | tuple[float, ...] | Path, current: np.ndarray) -> np.ndarray:
    """Return the value that a parameter starts with, in the shape of ``current``."""
    where = f"fit config: parameters.{name!r}.initial"
    if not isinstance(initial, Path):
        try:
            with np.errstate(over="ignore"):  # what overflows becomes infinite, which is refused
                return np.broadcast_to(np.asarray(initial, dtype=np.float32), current.shape)
        except ValueError:
            raise ValueError(f"{where}: got {np.size(initial)} numbers, expected one or {current.shape[-1]}") from None
    if not os.path.isfile(initial):
        raise FileNotFoundError(f"{where}: {initial} does not exist")
    try:
        value = read_array(initial) if initial.suffix.lower() == ".npy" else image_io.read_image(initial)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if value.shape != current.shape:
        raise ValueError(f"{where}: {initial} has shape {value.shape}, expected {current.shape}")
    return value


def _no_parameter(params: Any, name: str) -> str:
    """Return the mapping's own words for an unknown name, which suggest others."""
    try:
        params[name]
    except KeyError as error:
        return str(error.args[0])
    return f"the scene has no parameter {name!r}"


def _digests(problem: Problem) -> dict[str, Any]:
    """Return what identifies a run, before its first step: its configuration, and the contents of what it names."""

    def digest(data: bytes) -> str:
        return hashlib.sha256(data).hexdigest()

    others = [array.numpy() for name, array in problem.params.items() if name not in problem.config.parameters]
    return {
        **problem.config.fingerprint(),
        "scene": digest(problem.config.scene.read_bytes()),
        "values": digest(problem.scene.indices.numpy().tobytes() + b"".join(v.tobytes() for v in others)),
        "targets": [digest(target.tobytes()) for target in problem.targets],
        "initial": {name: digest(value.tobytes()) for name, value in problem.values().items()},
    }


def _save(path: Path, problem: Problem, adam: optim.Adam, run: dict[str, Any], history: list[float]) -> None:
    arrays = {f"parameter/{name}": value for name, value in problem.values().items()}
    arrays |= {f"adam/{key}": value for key, value in adam.state_dict().items()}
    if problem.scene.origin.any():
        arrays |= {f"stored/{name}": problem.stored(name).numpy() for name in problem.config.parameters}
    arrays["losses"] = np.array(history, dtype=np.float64)
    checkpoint.save(path, arrays, {"run": run, "invalid": problem.invalid(), "interior": choice.stored(problem.scene)})


def _restore(path: Path, problem: Problem, adam: optim.Adam, run: dict[str, Any]) -> list[float]:
    """Take over a checkpoint and return the losses of its steps."""
    arrays, values = checkpoint.load(path)
    expected = json.loads(json.dumps(run))  # as the checkpoint stores it: tuples are lists
    found = values.get("run")
    if found != expected:
        found = found if isinstance(found, dict) else {}
        differing = sorted(key for key in {*found, *expected} if found.get(key) != expected.get(key))
        raise ValueError(
            f"{path} belongs to another run: {', '.join(differing)} differ. Restore the configuration that it was made "
            f"with, or start again (--overwrite)"
        )
    try:
        losses = arrays["losses"]
        if losses.ndim != 1 or not np.isfinite(losses).all():
            raise ValueError(f"the losses have shape {losses.shape}, or are not finite")
        history = losses.tolist()
        for name in problem.config.parameters:
            found = arrays[f"parameter/{name}"].astype(np.float32)
            problem.params[name] = found
            if problem.scene.origin.any():
                stored = arrays[f"stored/{name}"]
                if stored.shape != problem.stored(name).shape or not np.isfinite(stored).all():
                    raise ValueError(f"'stored/{name}' has shape {stored.shape}, or is not finite")
                problem.stored(name).assign(stored.astype(np.float32))
        problem.dropped = {str(kind): int(count) for kind, count in dict(values.get("invalid", {})).items()}
        choice.restore(problem.scene, values.get("interior", []))
        adam.load_state_dict({key.removeprefix("adam/"): v for key, v in arrays.items() if key.startswith("adam/")})
    except KeyError as error:
        raise ValueError(f"{path} lacks {error}; start again (--overwrite)") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {error}; start again (--overwrite)") from error
    if adam.steps != len(history) or len(history) > problem.config.iterations:
        raise ValueError(
            f"{path} holds {len(history)} losses of {adam.steps} steps, expected as many, and at most "
            f"{problem.config.iterations} iterations; raise 'iterations' or start again (--overwrite)"
        )
    problem.params.update()
    return history


@contextlib.contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C or SIGTERM into an event that is looked at between steps; the second acts as usual."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only there can signals be handled
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def request(number: int, frame: Any) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, request)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
