"""What the processes of a pool run: shares of calls, and views of a fit. A job is a function of its arguments alone.

A process keeps the scenes that it was sent, and of the last call what does not depend on the share. One job runs at a
time in a process: threads of Dask's wait for each other, and the job that runs has all threads of the process.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import pickle
import platform
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr import forks, losses, workers
from warp_psdr.distributed.values import Changed, restore
from warp_psdr.distributed.wire import Packed, Store, add, pack
from warp_psdr.estimate import calls
from warp_psdr.estimate.draw import Draw
from warp_psdr.invalid import Count
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.options.interior import Method
from warp_psdr.plan import choice
from warp_psdr.plan.plan import decide
from warp_psdr.scene.acceleration import set_vector_width, vector_width
from warp_psdr.scene.edits import State
from warp_psdr.scene.scene import Scene
from warp_psdr.workers import Share

#: Scenes that a process keeps, and other data, bytes.
SCENES, KEPT_BYTES = 4, 1 << 31


class JobError(RuntimeError):
    """A job failed; the message names it and its process, and holds the traceback there."""


@dataclass(frozen=True)
class Setting:
    """What processes have to agree about.

    Attributes:
        version: of this package.
        warp: version of Warp.
        width: of vectors, in scenes that a process loads itself; those that it is sent have their own.
        threads: that a job runs on; None: what the process has.
    """

    version: str
    warp: str
    width: int
    threads: int | None

    @classmethod
    def here(cls, threads: int | None) -> Setting:
        """Return this process's own."""
        return cls(psdr.__version__, wp.config.version, vector_width(), threads)


@dataclass(frozen=True)
class Derivative:
    """What a job that differentiates is told.

    Attributes:
        names: of what is differentiated.
        method: of the interior term, where the caller's pilot chose one.
    """

    names: tuple[str, ...]
    method: Method | None


@dataclass(frozen=True)
class Call:
    """A call before one sensor, of which a job draws a share.

    Attributes:
        role: "image", "reverse" or "forward".
        scene: digest of the scene, as the pool first saw it.
        changed: digest of what has changed since.
        sensor: number of the camera.
        integrator: of the call.
        spp: samples a pixel.
        seed: of the call.
        derivative: of roles other than "image".
        given: digest of the adjoint, or of the flat tangents.
    """

    role: str
    scene: str
    changed: str
    sensor: int
    integrator: PathIntegrator
    spp: int
    seed: int
    derivative: Derivative | None = None
    given: str = ""


@dataclass(frozen=True)
class View:
    """One view of a step of a fit: its image, its loss, and the gradient of that.

    Attributes:
        image: the call of its image, with what is differentiated.
        spp_grad: samples a pixel of the gradient.
        loss: name of the loss.
        weight: of the view's loss in the step's.
        target: digest of its target.
    """

    image: Call
    spp_grad: int
    loss: str
    weight: float
    target: str


@dataclass(frozen=True)
class Done:
    """What a job, or several, returned.

    Attributes:
        parts: sums by kind.
        invalid: kind -> samples drawn, those that were not finite, and the first of these.
        seconds: that the jobs ran.
        loss: of a view; None: not finite, and there is no gradient.
    """

    parts: Mapping[str, Packed]
    invalid: Mapping[str, Count] = field(default_factory=dict)
    seconds: float = 0.0
    loss: float | None = None

    @property
    def nbytes(self) -> int:
        """Size of the sums, bytes."""
        return sum(part.nbytes for part in self.parts.values())


@dataclass(frozen=True)
class Missing:
    """A process has not got this data yet; the job is to be sent again with it."""

    digests: tuple[str, ...]


_lock = threading.Lock()
_data = Store(KEPT_BYTES)
#: What the job that runs was given, by digest: it stays also if it is larger than all that is kept.
_given: dict[str, bytes] = {}
_scenes = Store(SCENES)
#: (digest of the scene, of what has changed): what each scene holds now.
_holds: dict[str, str] = {}
_last: tuple[Any, Any] = (None, None)


def share(setting: Setting, call: Call, share: Share, given: Mapping[str, bytes | None]) -> Done | Missing:
    """Draw a share of a call.

    Args:
        setting: of the pool.
        call: what is drawn.
        share: which part of its samples.
        given: digest -> data that the job needs; None: it was sent before.

    Raises:
        JobError: it names the call, the share and this process.
    """
    what = f"share {share.number} of {share.parts}, sensor {call.sensor}, seed {call.seed}, {call.role}"
    return _run(setting, what, given, lambda: _share(call, share))


def view(setting: Setting, view: View, given: Mapping[str, bytes | None]) -> Done | Missing:
    """Return the loss of a view and its gradient, "gradient": the requested parameters' one after the other, float32.

    Raises:
        JobError: it names the view and this process.
    """
    what = f"view of sensor {view.image.sensor}, seed {view.image.seed}"
    return _run(setting, what, given, lambda: _view(view))


def merge(one: Done, other: Done) -> Done:
    """Return what two neighbouring shares add up to."""
    kinds = one.parts.keys()
    parts = {kind: add(one.parts[kind], other.parts[kind]) for kind in kinds}
    invalid = dict(one.invalid)
    for kind, count in other.invalid.items():
        had = invalid.get(kind, Count())
        first = had.first or count.first
        invalid[kind] = Count(had.samples + count.samples, had.invalid + count.invalid, first)
    return Done(parts, invalid, one.seconds + other.seconds)


def merge_all(*results: Done) -> Done:
    """Return what neighbouring shares, a power of two, add up to: pairwise, as ``merge`` alone would."""
    level = list(results)
    while len(level) > 1:
        level = [merge(a, b) for a, b in zip(level[::2], level[1::2], strict=True)]
    return level[0]


@contextlib.contextmanager
def alone(setting: Setting) -> Iterator[None]:
    """Keep the process's other jobs waiting, and give it the pool's width of vectors and number of threads."""
    with _lock:
        if vector_width() != setting.width:
            set_vector_width(setting.width)
        if setting.threads is not None and setting.threads != workers.workers():
            workers.set_workers(setting.threads)
        yield


def attended(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a process of an executor, after ``attend``."""
    attend()
    return function(*arguments)


@functools.cache
def attend() -> None:
    """Leave Ctrl-C to the process that started this one, and end with it, also if it is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=_follow, args=(parent,), daemon=True).start()


#: A process that is forked has another parent, and no thread that follows it.
forks.in_child(attend.cache_clear)


def _follow(parent: Any) -> None:
    parent.join()
    os._exit(1)


def named() -> str:
    """Return this process's name, for errors."""
    return f"process {os.getpid()} on {platform.node()}"


def _run(setting: Setting, what: str, given: Mapping[str, bytes | None], job: Callable[[], Done]) -> Done | Missing:
    """Run a job in a process that agrees with the pool and has all its data."""
    global _given
    here = Setting.here(setting.threads)
    if (here.version, here.warp) != (setting.version, setting.warp):
        raise JobError(
            f"{named()} has warp_psdr {here.version} and Warp {here.warp}, the caller {setting.version} and "
            f"{setting.warp}; results may differ: install the same versions on both"
        )
    with alone(setting):
        missing = tuple(digest for digest, data in given.items() if data is None and digest not in _data)
        if missing:
            return Missing(missing)
        kept = {digest: _data.get(digest) for digest in given if digest in _data}
        _given = {digest: data for digest, data in given.items() if data is not None} | kept
        for digest in _given.keys() - kept.keys():
            _data.put(digest, _given[digest], len(_given[digest]))
        begun = time.perf_counter()
        try:
            return replace(job(), seconds=time.perf_counter() - begun)
        except Exception as error:
            raise JobError(f"{what}: {named()}: {error!r}\n{traceback.format_exc()}") from None


def _share(call: Call, share: Share) -> Done:
    global _last
    scene = _scene_of(call)
    if _last[0] != call:
        _last = (None, None)
        _last = (call, _prepared(scene, call))
    prepared = _last[1]
    before = {kind: (c.samples, c.invalid) for kind, c in scene.invalid.counts.items()}
    parts = prepared.draw(Draw(call.spp, share=share))
    found = {kind: pack(part if isinstance(part, np.ndarray) else part.numpy()) for kind, part in parts.items()}
    return Done(found, _counted(scene, before))


def _prepared(scene: Scene, call: Call) -> calls.ImageCall | calls.DerivativeCall:
    """Return what a call decides once, as the caller did."""
    if call.derivative is None:
        plan = decide(scene, integrator=call.integrator, sensor=call.sensor)
        return calls.ImageCall(scene, plan, call.sensor, call.seed)
    given = _value(call.given)
    dtype = wp.vec3 if call.role == "reverse" else wp.float32
    return _derivative(scene, call, call.role, call.spp, wp.array(given, dtype=dtype, device=scene.device))


def _derivative(scene: Scene, call: Call, role: str, spp: int, given: wp.array) -> calls.DerivativeCall:
    assert call.derivative is not None
    names = list(call.derivative.names)
    plan = decide(scene, integrator=call.integrator, sensor=call.sensor, names=names)
    if call.derivative.method is not None:
        plan = choice.by(plan, call.derivative.method)
    return calls.prepared(scene, plan, names, role, call.sensor, spp, call.seed, given)


def _view(view: View) -> Done:
    call = view.image
    scene = _scene_of(call)
    before = {kind: (c.samples, c.invalid) for kind, c in scene.invalid.counts.items()}
    prepared = _prepared(scene, replace(call, derivative=None))
    assert isinstance(prepared, calls.ImageCall) and call.derivative is not None
    image = prepared.finish(prepared.draw(Draw(call.spp)), requires_grad=True)
    target = wp.array(_value(view.target), dtype=wp.vec3, device=scene.device)
    with wp.Tape() as tape:
        loss = getattr(losses, view.loss)(image, target)
    value = float(loss.numpy()[0])
    if not np.isfinite(value):
        return Done({}, _counted(scene, before))
    tape.backward(grads={loss: wp.full(1, view.weight, dtype=wp.float32, device=loss.device)})
    derivative = _derivative(scene, call, "reverse", view.spp_grad, image.grad)
    total = derivative.gradient(derivative.draw(Draw(view.spp_grad))).numpy()
    parameters = [scene.parameters[name] for name in call.derivative.names]
    gradient = np.concatenate([total[p.offset : p.offset + p.size] for p in parameters])
    return Done({"gradient": pack(gradient)}, _counted(scene, before), loss=value)


def _counted(scene: Scene, before: dict[str, tuple[int, int]]) -> dict[str, Count]:
    """Return the samples that were drawn since."""
    found = {}
    for kind, count in scene.invalid.counts.items():
        samples, invalid = count.samples - before[kind][0], count.invalid - before[kind][1]
        if samples or invalid:
            found[kind] = Count(samples, invalid, count.first if invalid else ())
    return found


def _value(digest: str) -> Any:
    return pickle.loads(_given[digest])


def _scene_of(call: Call) -> Scene:
    """Return a call's scene with its values."""
    global _last
    if call.scene not in _scenes:
        scene = _value(call.scene)
        _scenes.put(call.scene, (scene, scene.state()), 1)
        _holds[call.scene] = ""
    scene, base = _scenes.get(call.scene)
    assert isinstance(scene, Scene) and isinstance(base, State)
    if _holds[call.scene] != call.changed:
        _last = (None, None)
        _holds[call.scene] = "unknown"
        change = _value(call.changed)
        assert isinstance(change, Changed)
        restore(base, scene, change)
        _holds[call.scene] = call.changed
    return scene
