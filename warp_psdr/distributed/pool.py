"""A pool of processes that render shares of a call, views of a fit, or fits: with the bits of one process.

Derivation: ``docs/cluster.md``.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Executor, Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.distributed import jobs
from warp_psdr.distributed.engines import Dask, Engine, Job, Pending, Processes
from warp_psdr.distributed.shares import Fractions, count, on_device, refuse_guiding, shares
from warp_psdr.distributed.traffic import Report
from warp_psdr.distributed.values import changed
from warp_psdr.distributed.wire import Parcel, parcel, unpack
from warp_psdr.estimate import calls, choice
from warp_psdr.estimate.arguments import (
    adjoint_array,
    checked_seed,
    flat,
    flat_tangents,
    requested,
    sample_count,
)
from warp_psdr.estimate.gradient_sums import add_to_gradient
from warp_psdr.estimate.views import assembled, count_of_views, each, of_one, shape_of_views
from warp_psdr.image import Image
from warp_psdr.invalid import warns
from warp_psdr.options.integrator import Integrator, PathIntegrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.plan import Plan, decide
from warp_psdr.plan.transient import shape_of
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.scene.parameters import check_owner
from warp_psdr.topology import contacts
from warp_psdr.workers import Share

if TYPE_CHECKING:
    from distributed import Client

    from warp_psdr.accuracy import report as accuracy
    from warp_psdr.distributed import fits
    from warp_psdr.fit.config import FitConfig
    from warp_psdr.fit.run import FitResult
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.edits import State
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


class Pool:
    """Processes that share the work of calls, with the bits of a call in this process.

    Args:
        engine: what runs the jobs: a ``dask.distributed.Client``, or the address of Dask's scheduler, "tcp://..."; any
            ``concurrent.futures.Executor`` of processes (``mpi4py.futures`` has one); or "local" for processes on this
            machine.
        processes: of "local"; default: one for every core.
        threads: of every job; default: of "local" and of a ``ProcessPoolExecutor`` the cores of this machine over the
            processes, of Dask those of the worker (``--nthreads``), elsewhere all cores that a process may use.

    Raises:
        ValueError: another engine, or a number of processes for an engine that has its own.
        ImportError: an address, and Dask is not installed.
        OSError: there is no scheduler at the address.
    """

    def __init__(
        self, engine: Client | Executor | str = "local", *, processes: int | None = None, threads: int | None = None
    ):
        self._client = _connected(engine) if isinstance(engine, str) and engine != "local" else None
        self._engine = _engine(self._client or engine, processes)
        if threads is None and isinstance(self._engine, Processes) and self._engine.here:
            threads = max(workers.workers() // self._engine.processes, 1)
        self._threads = threads
        self._bases: weakref.WeakKeyDictionary[Scene, tuple[State, Parcel]] = weakref.WeakKeyDictionary()
        self._closed = False

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes that the pool has started; a client or executor that it was given stays open."""
        if not self._closed:
            self._closed = True
            self._engine.close()
            if self._client is not None:
                self._client.close()

    @property
    def report(self) -> Report:
        """What was done so far."""
        return Report(self._engine.processes, **vars(self._engine.traffic))

    @warns
    def render(
        self,
        scene: Scene,
        params: Parameters | None = None,
        *,
        sensor: Sensor = 0,
        integrator: Integrator | None = None,
        spp: int | None = None,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
    ) -> Image:
        """Render an image, as ``psdr.render`` does, with its bits.

        Args:
            scene: a loaded scene; its values go to the processes, once.
            params: its parameters; not needed.
            sensor: which camera; of a ``batch`` all its cameras; several in a list.
            integrator: as of ``psdr.render``.
            spp: samples a pixel; default: the sensor's sample count.
            seed: of the call.
            progress: called with the finished fraction of the jobs.

        Returns:
            As ``psdr.render``.

        Raises:
            ValueError: as ``psdr.render``, or the pool is closed.
            JobError: a job failed.
        """
        self._check(scene, params)
        views = scene.description.views(sensor)
        path, seed = integrator_of(scene, integrator), checked_seed(seed)
        spp = count_of_views(scene, views, spp) if views.several else spp
        started, parcels = [], self.parcels_of(scene)
        told = Fractions(progress)
        for number in views.sensors:
            call = calls.ImageCall(scene, decide(scene, integrator=path, sensor=number), number, seed)
            count = sample_count(scene, number, spp)
            started.append((call, self._start(call, path, count, len(views.sensors), parcels, told)))
        return _image(scene, views, [call.finish(parts) for call, parts in self._finished(scene, started)])

    @warns
    def render_backward(
        self,
        scene: Scene,
        params: Parameters,
        adjoint,
        *,
        sensor: Sensor = 0,
        integrator: Integrator | None = None,
        spp: int | None = None,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
    ) -> dict[str, np.ndarray]:
        """Return the gradient of ``sum(adjoint * image)``, and add it to ``params[name].grad``.

        The bits are those of ``psdr.render_backward``.

        Args:
            scene: a loaded scene.
            params: its parameters, after ``requires_grad``.
            adjoint: as of ``psdr.render_backward``.
            sensor: which camera; of a ``batch`` all its cameras; several in a list.
            integrator: as of ``psdr.render``; a pool does not guide, of its own accord or otherwise.
            spp: samples a pixel; default: the sensor's sample count.
            seed: of the call.
            progress: called with the finished fraction of the jobs.

        Returns:
            The gradient that this call has added, by name, float32, in the parameters' NumPy shapes.

        Raises:
            ValueError: as ``psdr.render_backward``, the pool is closed, or the boundary term is guided.
            JobError: a job failed.
        """
        self._check(scene, params)
        views = scene.description.views(sensor)
        path, names, seed = integrator_of(scene, integrator), requested(scene, params), checked_seed(seed)
        spp = count_of_views(scene, views, spp) if views.several else spp
        whole = shape_of_views(scene, views) if views.several else shape_of(scene, views.sensors[0])
        adjoints = adjoint_array(adjoint, whole, scene.device)
        started, parcels = [], self.parcels_of(scene)
        told = Fractions(progress)
        for number, place, _told in each(scene, views, None):
            own = adjoints
            if views.several:
                own = adjoint_array(
                    of_one(scene, views, adjoints.numpy(), place), shape_of(scene, number), scene.device
                )
            plan = decide(scene, params, integrator=path, sensor=number)
            count = sample_count(scene, number, spp)
            call = self._derivative(scene, plan, path, names, "reverse", number, count, seed, flat(own))
            started.append((call, self._start(call, path, count, len(views.sensors), parcels, told)))
        gradient = {name: np.zeros(scene.parameters[name].numpy_shape, np.float32) for name in names}
        for call, parts in self._finished(scene, started):
            total = call.gradient(parts)
            for name in names:
                p = scene.parameters[name]
                gradient[name] += total.numpy()[p.offset : p.offset + p.size].reshape(p.numpy_shape)
                add_to_gradient(params[name], total, p.offset)
        return gradient

    @warns
    def render_forward(
        self,
        scene: Scene,
        params: Parameters,
        tangents: dict,
        *,
        sensor: Sensor = 0,
        integrator: Integrator | None = None,
        spp: int | None = None,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
    ) -> Image:
        """Render the derivative of the image along a direction, as ``psdr.render_forward`` does, with its bits.

        Args:
            scene: a loaded scene.
            params: its parameters.
            tangents: as of ``psdr.render_forward``.
            sensor: which camera; of a ``batch`` all its cameras; several in a list.
            integrator: as of ``psdr.render``; a pool does not guide, of its own accord or otherwise.
            spp: samples a pixel; default: the sensor's sample count.
            seed: of the call.
            progress: called with the finished fraction of the jobs.

        Returns:
            As ``psdr.render_forward``.

        Raises:
            ValueError: as ``psdr.render_forward``, the pool is closed, or the boundary term is guided.
            JobError: a job failed.
        """
        self._check(scene, params)
        if not tangents:
            raise ValueError("render_forward needs at least one tangent: {'parameter name': direction}")
        views = scene.description.views(sensor)
        path, names, seed = integrator_of(scene, integrator), list(tangents), checked_seed(seed)
        spp = count_of_views(scene, views, spp) if views.several else spp
        target = flat_tangents(scene, params, tangents)
        started, parcels = [], self.parcels_of(scene)
        told = Fractions(progress)
        for number in views.sensors:
            plan = decide(scene, integrator=path, sensor=number, names=names)
            if plan.boundary is not None:
                contacts.warn(scene, target.numpy())
            count = sample_count(scene, number, spp)
            call = self._derivative(scene, plan, path, names, "forward", number, count, seed, target)
            started.append((call, self._start(call, path, count, len(views.sensors), parcels, told)))
        images = [call.image(parts) for call, parts in self._finished(scene, started)]
        return _image(scene, views, images, signed=True)

    def accuracy(
        self,
        scene: Scene,
        params: Parameters | None = None,
        adjoint=None,
        *,
        tangents: dict | None = None,
        **options,
    ) -> accuracy.Report:
        """Measure what accuracy costs, as ``psdr.accuracy`` does, in one process of the pool: what it costs there.

        Args:
            scene: a loaded scene.
            params: its parameters; with an adjoint after ``requires_grad``.
            adjoint: as of ``psdr.accuracy``.
            tangents: as of ``psdr.accuracy``.
            **options: further arguments of ``psdr.accuracy``, but for ``progress``.

        Returns:
            The report, which budgets of this process take, too.

        Raises:
            ValueError: as ``psdr.accuracy``, or the pool is closed.
        """
        from warp_psdr.distributed.pilots import run_accuracy

        self._check(scene, params)
        names = [] if params is None else params.requested
        if isinstance(adjoint, wp.array):
            adjoint = adjoint.numpy()
        if tangents is not None:
            tangents = {name: t.numpy() if isinstance(t, wp.array) else t for name, t in tangents.items()}
        return self.call(run_accuracy, scene, names, adjoint, tangents, options).result()

    def fit(
        self,
        config: FitConfig | str | Path,
        *,
        resume: bool = False,
        overwrite: bool = False,
        iterations: int | None = None,
    ) -> FitResult:
        """Recover parameters from images, as ``psdr.fit.fit`` does, with its bits: a step's views are jobs.

        Args:
            config: what to do, or the TOML or JSON file that says so.
            resume: continue from the checkpoint in the output folder, if there is one.
            overwrite: start again although there is a checkpoint.
            iterations: replaces that of ``config``.

        Returns:
            The recovered values; results are written by this process.

        Raises:
            ValueError: as ``psdr.fit.fit``, or the pool is closed.
            JobError: a job failed; a checkpoint of the last whole step is written.
            RuntimeError: the processes are gone; likewise.
        """
        from warp_psdr.fit.config import FitConfig
        from warp_psdr.fit.run import fit

        self._check_open()
        config = config if isinstance(config, FitConfig) else FitConfig.from_file(Path(config))
        return fit(config, resume=resume, overwrite=overwrite, iterations=iterations, pool=self)

    def map_fits(
        self, configs: Sequence[FitConfig | str | Path], *, resume: bool = False, overwrite: bool = False
    ) -> list[FitResult]:
        """Run independent fits side by side, each in one process: many starts, many scenes.

        Processes read the files that the configurations name, and write the results, so they share a file system. One
        whose process is lost goes on from its checkpoint in another.

        Args:
            configs: what to do, each with an output folder of its own.
            resume: continue from the checkpoints in the output folders, where there are any.
            overwrite: start again although there are checkpoints.

        Returns:
            Their results, in the order of the configurations.

        Raises:
            ValueError: the pool is closed, two fits have one output folder, or there is a checkpoint that is neither to
                be resumed nor to be lost.
            ExceptionGroup: of the errors of those that failed, after all others have ended.
        """
        from warp_psdr.distributed.fits import map_fits

        self._check_open()
        return map_fits(self, configs, resume=resume, overwrite=overwrite)

    # -- jobs ------------------------------------------------------------------------------------------------------

    def setting(self) -> jobs.Setting:
        """Return what this pool's processes have to agree about."""
        return jobs.Setting.here(self._threads)

    def parcels_of(self, scene: Scene) -> tuple[Parcel, Parcel]:
        """Return a scene as the pool first saw it, and what has changed since."""
        if scene not in self._bases:
            self._bases[scene] = (scene.state(), parcel(scene))
        base, whole = self._bases[scene]
        return whole, parcel(changed(base, scene))

    def send(self, data: Parcel) -> None:
        """Send data ahead of the job that needs it, where that is possible."""
        self._engine.send(data)

    def run(self, job: Job) -> Pending:
        """Run one job."""
        return self._engine.tree([job], lambda: None)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run a function of the pool's setting and some arguments in one process."""
        return self._engine.call(function, self.setting(), *arguments)

    @functools.cached_property
    def views(self) -> fits.Views:
        """The views of fits."""
        from warp_psdr.distributed.fits import Views

        return Views(self)

    def wait(self, started: Sequence[Pending]) -> list[jobs.Done]:
        """Return the results of jobs; an error, or Ctrl-C, takes back those that have not begun."""
        try:
            return [pending.root.result() for pending in started]
        except BaseException as error:
            for pending in started:
                pending.cancel()
            if isinstance(error, CancelledError):
                raise RuntimeError("the pool's jobs were cancelled: its scheduler or executor has gone") from None
            raise

    def _check(self, scene: Scene, params: Parameters | None) -> None:
        self._check_open()
        check_loaded(scene)
        if params is not None:
            check_owner(scene, params)

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError("the pool is closed; make another one")

    def _derivative(
        self,
        scene: Scene,
        plan: Plan,
        integrator: PathIntegrator,
        names: list[str],
        role: str,
        sensor: int,
        spp: int,
        seed: int,
        given: wp.array,
    ) -> calls.DerivativeCall:
        """Return a call with what depends on the calls before it chosen here, once."""
        refuse_guiding(integrator)
        plan = choice.choose(scene, plan, names, role, sensor, spp, seed, given)
        return calls.DerivativeCall(scene, plan, names, role, sensor, spp, seed, given, [])

    def _start(
        self,
        call: calls.ImageCall | calls.DerivativeCall,
        integrator: PathIntegrator,
        spp: int,
        sensors: int,
        sent: tuple[Parcel, Parcel],
        told: Fractions,
    ) -> Pending:
        """Send the shares of a call on a scene that was sent."""
        whole, change = sent
        parcels, role, derivative, given = [whole, change], "image", None, ""
        if isinstance(call, calls.DerivativeCall):
            role = call.role
            derivative = jobs.Derivative(tuple(call.names), choice.taken(call.scene, call.plan, call.names))
            parcels.append(parcel(call.given.numpy()))
            given = parcels[-1].digest
        told_to = jobs.Call(
            role, whole.digest, change.digest, call.sensor, integrator, spp, call.seed, derivative, given
        )
        shards = call.shards if call.scene.device.is_cpu else workers.SHARDS
        count, setting = shares(self._engine.processes, sensors, shards), self.setting()
        drawn = [Job(jobs.share, (setting, told_to, Share(n, count)), tuple(parcels)) for n in range(count)]
        return self._engine.tree(drawn, told.expect(count))

    def _finished(self, scene: Scene, started: list[tuple[Any, Pending]]):
        """Yield every call with what its shares add up to, and count the samples that they dropped."""
        for done, (call, _pending) in zip(self.wait([p for _call, p in started]), started, strict=True):
            count(scene, done)
            yield call, {kind: on_device(unpack(part), scene) for kind, part in done.parts.items()}


def _image(scene: Scene, views: Views, images: list[Image], *, signed: bool = False) -> Image:
    """Return the images of a call's sensors as one."""
    if not views.several:
        return images[0]
    found = dict(zip(views.sensors, images, strict=True))
    return assembled(scene, views, lambda number, _told: found[number], None, signed=signed)


def _connected(address: str) -> Client:
    """Return a client of the scheduler at an address."""
    if "://" not in address:
        raise ValueError(f"engine: got {address!r}, expected 'local' or the address of a Dask scheduler, 'tcp://...'")
    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError("a Dask scheduler needs dask.distributed: pip install 'warp-psdr[cluster]'") from error
    return Client(address, set_as_default=False)


def _engine(engine: Any, processes: int | None) -> Engine:
    if isinstance(engine, Executor):
        if processes is not None:
            raise ValueError("processes: an executor has its own; leave them out")
        return Processes(engine, None)
    if engine == "local":
        return Processes(None, processes)
    if type(engine).__module__.partition(".")[0] == "distributed":
        if processes is not None:
            raise ValueError("processes: Dask's cluster has its own; leave them out")
        return Dask(engine)
    raise ValueError(
        f"engine: got {engine!r}, expected a dask.distributed.Client (pip install 'warp-psdr[cluster]') or its "
        "scheduler's address, a concurrent.futures.Executor, or 'local'"
    )
