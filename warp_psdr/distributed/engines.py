"""What runs a pool's jobs: any ``concurrent.futures.Executor``, or Dask. Each mends what it can of lost processes.

A batch of jobs that belong together is a *tree*: their results are merged pairwise, neighbours first, whichever comes
first. Its root is a ``concurrent.futures.Future``.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    InvalidStateError,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from warp_psdr import workers
from warp_psdr.distributed.jobs import KEPT_BYTES, Done, JobError, Missing, attend, attended, merge, merge_all
from warp_psdr.distributed.traffic import Traffic
from warp_psdr.distributed.wire import Parcel, Store

if TYPE_CHECKING:
    from distributed import Client

#: Data up to this size goes with every job that needs it; larger data goes to a process once.
SMALL = 1 << 12
#: Data from this size on is copied between Dask's workers; it has to be sent anew if all that have it are lost.
LARGE = 8 << 20
#: Parcels whose way is remembered.
REMEMBERED = 4096
#: Seconds that a process has to end by itself.
PATIENCE = 5.0
#: Seconds between two looks at a client that looks for its scheduler.
LOOK = 0.1
#: Results that a task of Dask's merges at most, a power of two.
MERGED = 8
#: Times that a job is sent again after its process was lost, without any other having been done meanwhile.
LOSSES = 5


@dataclass(frozen=True)
class Job:
    """A job: ``function(*arguments, {digest: data})``.

    Attributes:
        function: of ``jobs.py``.
        arguments: all but its data.
        parcels: what it needs.
    """

    function: Callable[..., Done | Missing]
    arguments: tuple[Any, ...]
    parcels: tuple[Parcel, ...]


@dataclass
class Pending:
    """A tree whose jobs run.

    Attributes:
        root: its merged result.
        jobs: the engine's futures.
    """

    root: Future[Done]
    jobs: list[Any] = field(default_factory=list)

    def cancel(self) -> None:
        """Take back the jobs that have not begun, and wait for none."""
        _fail(self.root, CancelledError())
        for job in list(self.jobs):
            if not job.done():
                job.cancel()


class Engine(Protocol):
    """Runs jobs."""

    traffic: Traffic

    @property
    def processes(self) -> int:
        """How many jobs run at a time."""

    def tree(self, jobs: Sequence[Job], told: Callable[[], None]) -> Pending:
        """Run jobs, a power of two, of one function and the same data, and return what gives the merged result.

        ``told`` is called as each is done.
        """

    def send(self, data: Parcel) -> None:
        """Send data ahead of the job that needs it, where that is possible."""

    def call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run any function, and again if its process is lost."""

    def close(self) -> None:
        """Let go of what the engine has made itself."""


class _Tree:
    """Merges results pairwise by their numbers, as they come."""

    def __init__(self, count: int, root: Future):
        self._count, self._root = count, root
        self._nodes: dict[tuple[int, int], Done] = {}
        self._lock = threading.Lock()

    def add(self, number: int, done: Done) -> None:
        """Add a leaf; the root is set with the last one."""
        width = 1
        while width < self._count:
            with self._lock:
                other = self._nodes.pop((width, number ^ width), None)
                if other is None:
                    self._nodes[width, number] = done
                    return
            done = merge(done, other) if number < number ^ width else merge(other, done)
            number &= ~width
            width *= 2
        with contextlib.suppress(InvalidStateError):  # cancelled meanwhile
            self._root.set_result(done)


class Processes:
    """Jobs on an executor; what is not known to a process is sent when it says so.

    Args:
        executor: of ``concurrent.futures``, or one like it; None: a ``ProcessPoolExecutor`` of its own.
        count: processes of that.

    Raises:
        TypeError: an executor of threads.
    """

    def __init__(self, executor: Executor | None, count: int | None):
        if isinstance(executor, ThreadPoolExecutor):
            raise TypeError(
                f"engine: got a {type(executor).__name__}, expected an executor of processes: a call has all cores of "
                "this process already, without a pool"
            )
        self._own = executor is None
        #: Whether the processes share this machine's cores.
        self.here = executor is None or isinstance(executor, ProcessPoolExecutor)
        self._executor: Executor = ProcessPoolExecutor(count or workers.workers()) if executor is None else executor
        if isinstance(self._executor, ProcessPoolExecutor) and not self._executor._processes:
            _attend_first(self._executor)
        self.processes = int(getattr(self._executor, "_max_workers", 0) or os.cpu_count() or 1)
        self.traffic = Traffic()
        self._times_sent: dict[str, int] = {}
        self._lock = threading.Lock()
        self._losses = 0
        self._closed = False

    def tree(self, jobs: Sequence[Job], told: Callable[[], None]) -> Pending:
        """Run jobs; as of ``Engine``."""
        root: Future[Done] = Future()
        root.set_running_or_notify_cancel()
        pending, tree = Pending(root), _Tree(len(jobs), root)
        for number, job in enumerate(jobs):
            self._submit(job, functools.partial(self._arrived, tree, pending, number, job, told), pending, ())
        return pending

    def call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run any function; as of ``Engine``."""
        result: Future[Any] = Future()
        self._called(result, function, arguments)
        return result

    def _called(self, result: Future[Any], function: Callable[..., Any], arguments: tuple) -> None:
        def arrived(executor: Executor, future: Future) -> None:
            if result.cancelled():
                return
            try:
                value = future.result()
                if result.set_running_or_notify_cancel():
                    result.set_result(value)
            except BrokenExecutor as error:
                try:
                    self._lost(executor, error)
                    self._called(result, function, arguments)
                except Exception as problem:
                    _fail(result, problem)
            except BaseException as error:
                _fail(result, error)

        executor, future = self._sent(function, *arguments)
        future.add_done_callback(functools.partial(arrived, executor))
        result.add_done_callback(lambda result: result.cancelled() and future.cancel())

    def _sent(self, function: Callable[..., Any], *arguments: Any) -> tuple[Executor, Future]:
        """Submit a function, and return what runs it."""
        if self.here:
            function, arguments = attended, (function, *arguments)
        with self._lock:
            executor = self._executor
            try:
                return executor, executor.submit(function, *arguments)
            except BrokenExecutor:
                executor = self._renewed(executor)
                return executor, executor.submit(function, *arguments)

    def send(self, data: Parcel) -> None:
        """Do nothing: executors do not say which process would get it."""

    def close(self) -> None:
        """End the executor if it is the engine's own."""
        with self._lock:
            self._closed = True
            if not self._own:
                return
            processes = list((getattr(self._executor, "_processes", None) or {}).values())
            self._executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()  # a fit stops at its next whole step
        end = time.monotonic() + PATIENCE
        for process in processes:
            process.join(max(end - time.monotonic(), 0.0))
            process.kill()

    def _submit(
        self, job: Job, arrived: Callable[[Executor, Future], None], pending: Pending, missing: tuple[str, ...]
    ) -> None:
        data: dict[str, bytes | None] = {}
        if len(self._times_sent) > REMEMBERED:
            self._times_sent.clear()
        for parcel in job.parcels:
            times = self._times_sent.get(parcel.digest, 0)
            send = len(parcel.data) <= SMALL or times < self.processes or parcel.digest in missing
            data[parcel.digest] = parcel.data if send else None
            self._times_sent[parcel.digest] = times + send
            self.traffic.sent += len(parcel.data) * send
        executor, future = self._sent(job.function, *job.arguments, data)
        pending.jobs.append(future)
        future.add_done_callback(functools.partial(arrived, executor))

    def _arrived(
        self,
        tree: _Tree,
        pending: Pending,
        number: int,
        job: Job,
        told: Callable[[], None],
        executor: Executor,
        future: Future,
    ) -> None:
        """Take a job's result, on a thread of the executor; send it again if its data or its process is missing."""
        again = functools.partial(self._arrived, tree, pending, number, job, told)
        if pending.root.done():
            return
        try:
            result = future.result()
            if isinstance(result, Missing):
                self._submit(job, again, pending, result.digests)
                return
            self._losses = 0
            self.traffic.jobs += 1
            self.traffic.received += result.nbytes
            self.traffic.seconds += result.seconds
            told()
            tree.add(number, result)
        except BrokenExecutor as error:
            try:
                self._lost(executor, error)
                self._submit(job, again, pending, ())
            except Exception as problem:
                _fail(pending.root, problem)
        except BaseException as error:  # also Ctrl-C in that process
            _fail(pending.root, error)

    def _lost(self, executor: Executor, error: BrokenExecutor) -> None:
        """Mend an executor that has lost a process.

        Raises:
            JobError: processes were lost again and again.
            BrokenExecutor: it cannot be mended.
        """
        with self._lock:
            self.traffic.lost += 1
            if self._executor is executor:
                self._losses += 1
                if self._losses > LOSSES:
                    raise JobError(
                        f"{self._losses} times in a row a process ended before its job was done ({error}); is there "
                        "enough memory for so many processes?"
                    )
                self._renewed(executor)

    def _renewed(self, executor: Executor) -> Executor:
        """Put a new executor in place of one whose process died, which takes no more jobs."""
        if self._executor is not executor:
            return self._executor
        if self._closed:
            raise BrokenExecutor("the pool was closed before its jobs were done")
        if not isinstance(executor, ProcessPoolExecutor):
            raise BrokenExecutor(
                f"{type(executor).__name__} has lost a process and takes no more jobs; make a new pool"
            )
        for process in list((executor._processes or {}).values()):
            # The executor ends them too, but later and by SIGTERM, after which a fit goes on to its next step.
            process.kill()
            process.join(PATIENCE)
        if self._own:
            executor.shutdown(wait=False)
        self._own = True
        context = executor._mp_context
        self._executor = ProcessPoolExecutor(self.processes, context, executor._initializer, executor._initargs)
        self._times_sent.clear()
        return self._executor


def _attend_first(executor: ProcessPoolExecutor) -> None:
    """Let processes that are yet to start ``attend`` before their first job, which may never come."""
    own = executor._initializer
    arguments = () if own is None else (own, *executor._initargs)
    executor._initializer, executor._initargs = attend if own is None else attended, arguments


def _fail(root: Future, error: BaseException) -> None:
    with contextlib.suppress(InvalidStateError):  # done meanwhile
        root.set_exception(error)


class Dask:
    """Jobs on the workers of a Dask cluster, which also merge results; Dask runs again what a lost worker had.

    Args:
        client: connected to its scheduler.
    """

    def __init__(self, client: Client):
        self._client = client
        self.traffic = Traffic()
        self._parcels = Store(KEPT_BYTES)
        self._lock = threading.Lock()

    @property
    def processes(self) -> int:
        """The workers that are there now."""
        return max(len(self._client.scheduler_info(n_workers=-1).get("workers", ())), 1)

    def tree(self, jobs: Sequence[Job], told: Callable[[], None]) -> Pending:
        """Run jobs; as of ``Engine``."""
        root: Future[Done] = Future()
        root.set_running_or_notify_cancel()
        pending = Pending(root)
        self._grow(jobs, told, pending, LOSSES)
        return pending

    def call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run any function; as of ``Engine``."""
        return self._client.get_executor(pure=False).submit(_call, function, arguments)

    def send(self, data: Parcel) -> None:
        """Send data to the scheduler, and from there to a worker."""
        self._parcel(data)

    def close(self) -> None:
        """Let go of the data on the workers."""
        with self._lock:
            self._parcels = Store(KEPT_BYTES)

    def _grow(self, jobs: Sequence[Job], told: Callable[[], None], pending: Pending, more: int) -> None:
        """Send all jobs of a tree; ``more``: how often they may be sent again."""
        try:
            data = [self._parcel(parcel) for parcel in jobs[0].parcels]
            digests = tuple(parcel.digest for parcel in jobs[0].parcels)
            arguments = [job.arguments for job in jobs]
            # A message to the scheduler for each level, not for each task.
            run: dict[str, Any] = {"function": jobs[0].function, "digests": digests, "data": data}
            level = self._client.map(_run, arguments, pure=False, **run)
            pending.jobs = list(level)
            for leaf in level:
                leaf.add_done_callback(functools.partial(_told, told))
            while len(level) > MERGED:
                level = self._client.map(merge_all, *(level[i::MERGED] for i in range(MERGED)), pure=False)
            if len(level) > 1:
                level = [self._client.submit(merge_all, *level, pure=False)]
            pending.jobs.append(level[0])
            level[0].add_done_callback(functools.partial(self._arrived, jobs, told, pending, more))
        except Exception as error:
            _fail(pending.root, self._gone(error))

    def _parcel(self, parcel: Parcel) -> Any:
        """Return data as Dask's tasks take it."""
        with self._lock:
            if parcel.digest in self._parcels:
                return self._parcels.get(parcel.digest)
            if len(parcel.data) <= LARGE:
                future = self._client.submit(_given, parcel.data, pure=False)
            else:
                future = self._client.scatter([parcel.data], broadcast=True, hash=False)[0]
            self._parcels.put(parcel.digest, future, len(parcel.data))
            self.traffic.sent += len(parcel.data)
            return future

    def _arrived(self, jobs: Sequence[Job], told: Callable[[], None], pending: Pending, more: int, future: Any) -> None:
        """Take a tree's result, on a thread of Dask's; send all of it again if Dask has given it up."""
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        if pending.root.done():
            return
        try:
            done = future.result()
            self.traffic.jobs += len(jobs)
            self.traffic.received += done.nbytes
            self.traffic.seconds += done.seconds
            with contextlib.suppress(InvalidStateError):  # cancelled meanwhile
                pending.root.set_result(done)
        except FutureCancelledError as error:  # its scheduler was out of reach, or data that it needs is lost
            arguments = (jobs, told, pending, more, error)
            threading.Thread(target=self._grow_again, args=arguments, daemon=True).start()
        except KilledWorker as error:
            _fail(pending.root, JobError(f"Dask has given up a job that ended one worker after the other: {error}"))
        except BaseException as error:
            _fail(pending.root, error)

    def _grow_again(
        self, jobs: Sequence[Job], told: Callable[[], None], pending: Pending, more: int, error: Exception
    ) -> None:
        """Send a tree again, with all data, once the client has found its scheduler; Dask's client gives up in time."""
        while self._client.status == "connecting" and not pending.root.done():
            time.sleep(LOOK)
        if not more or self._client.status != "running":
            _fail(pending.root, self._gone(error))
        elif not pending.root.done():
            self.traffic.lost += 1
            self.close()
            self._grow(jobs, told, pending, more - 1)

    def _gone(self, error: Exception) -> JobError:
        return JobError(
            f"Dask does not run the jobs ({type(error).__name__}: {error}); its client is {self._client.status}. "
            "Connect a client to a scheduler that runs, and make a new pool"
        )


def _run(arguments: tuple, function: Callable[..., Done], digests: tuple[str, ...], data: list[bytes]) -> Done:
    """Run a job on a worker of Dask, which has all its data."""
    return function(*_own_threads(arguments), dict(zip(digests, data, strict=True)))


def _call(function: Callable[..., Any], arguments: tuple) -> Any:
    """Call a function of a setting and more on a worker of Dask."""
    return function(*_own_threads(arguments))


def _own_threads(arguments: tuple) -> tuple:
    """Return arguments whose first, a setting that leaves the threads open, takes those of this worker."""
    from distributed import get_worker

    setting, *rest = arguments
    if setting.threads is None:
        setting = replace(setting, threads=get_worker().state.nthreads)
    return setting, *rest


def _given(data: bytes) -> bytes:
    """Return data: a task that any worker can run again if the one that had the data is lost."""
    return data


def _told(told: Callable[[], None], future: Any) -> None:
    if future.status == "finished":
        told()
