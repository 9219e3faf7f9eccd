"""Fits in a pool: a step's views as jobs, and whole fits as jobs.

The caller decides, adds up the views' gradients in their order and steps, so a fit has the bits of one process.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.distributed import jobs
from warp_psdr.distributed.engines import Job, Pending
from warp_psdr.distributed.shares import count, refuse_guiding
from warp_psdr.distributed.wire import Parcel, parcel, unpack
from warp_psdr.estimate import choice
from warp_psdr.estimate.gradient_sums import add_to_gradient
from warp_psdr.fit.config import FitConfig
from warp_psdr.fit.run import CHECKPOINT, FitResult, Problem, fit, require_free
from warp_psdr.plan.plan import decide
from warp_psdr.progress import progress, silence

if TYPE_CHECKING:
    from warp_psdr.distributed.pool import Pool


class Views:
    """The views of a fit in a pool.

    Args:
        pool: runs them.
    """

    def __init__(self, pool: Pool):
        self._pool = pool
        self._targets: weakref.WeakKeyDictionary[Problem, dict[int, Parcel]] = weakref.WeakKeyDictionary()

    def backward(
        self, problem: Problem, views: Sequence[tuple[int, int, float]], following: Sequence[int]
    ) -> list[float]:
        """Add the gradients of some views' losses to the parameters', as ``Problem.backward`` does one after the other.

        Args:
            problem: the fit's.
            views: (number, seed, weight) of each.
            following: the views of the next step, whose targets are sent meanwhile.

        Returns:
            Their losses.
        """
        scene, config, names = problem.scene, problem.config, problem.params.requested
        refuse_guiding(problem.integrator)
        spp_grad = config.spp if config.spp_grad is None else config.spp_grad
        scene.settle()
        whole, change = self._pool.parcels_of(scene)
        found: list[float] = []
        waiting: list[Pending] = []
        for number, seed, weight in views:
            sensor = config.views[number]
            plan = decide(scene, problem.params, integrator=problem.integrator, sensor=sensor)
            if choice.due(scene, plan, names):  # what the pilot says depends on the adjoint
                found += self._taken(problem, waiting)
                waiting = []
                found.append(problem.backward(number, seed, weight))
                continue
            plan = choice.choose(scene, plan, names, "reverse", sensor, spp_grad, seed, None)
            method = choice.taken(scene, plan, names)
            target = self.target(problem, number)
            image = jobs.Call(
                "image", whole.digest, change.digest, sensor, problem.integrator, config.spp, seed,
                jobs.Derivative(tuple(names), method),
            )  # fmt: skip
            view = jobs.View(image, spp_grad, config.loss, weight, target.digest)
            job = Job(jobs.view, (self._pool.setting(), view), (whole, change, target))
            waiting.append(self._pool.run(job))
        for number in following:
            self._pool.send(self.target(problem, number))
        return found + self._taken(problem, waiting)

    def target(self, problem: Problem, view: int) -> Parcel:
        """Return a view's target as it is sent."""
        own = self._targets.setdefault(problem, {})
        if view not in own:
            own[view] = parcel(problem.targets[view])
        return own[view]

    def _taken(self, problem: Problem, waiting: list[Pending]) -> list[float]:
        """Add the gradients of jobs to the parameters', in their order, and return their losses."""
        scene, names, found = problem.scene, problem.params.requested, []
        for done in self._pool.wait(waiting):
            count(scene, done)
            found.append(float("nan") if done.loss is None else done.loss)
            if done.loss is None:
                continue
            total = wp.array(unpack(done.parts["gradient"]), dtype=wp.float32, device=scene.device)
            first = 0
            for name in names:
                add_to_gradient(problem.params[name], total, first)
                first += scene.parameters[name].size
        return found


def run_fit(setting: jobs.Setting, config: FitConfig) -> FitResult:
    """Run a whole fit in this process, or what is left of one whose process was lost."""
    with jobs.alone(setting), silence():
        return fit(config, resume=True)


def map_fits(
    pool: Pool, configs: Sequence[FitConfig | str | Path], *, resume: bool = False, overwrite: bool = False
) -> list[FitResult]:
    """Run fits side by side; ``Pool.map_fits``."""
    loaded = [c if isinstance(c, FitConfig) else FitConfig.from_file(Path(c)) for c in configs]
    outputs = [c.output.resolve() for c in loaded]
    if len(set(outputs)) < len(outputs):
        raise ValueError("map_fits: two fits write to one folder; give each an output of its own")
    for config in loaded:  # here, and once: a fit that is begun again because its process was lost goes on
        require_free(config.output / CHECKPOINT, resume or overwrite)
        if overwrite:
            (config.output / CHECKPOINT).unlink(missing_ok=True)
    futures = {pool.call(run_fit, config): i for i, config in enumerate(loaded)}
    results: dict[int, FitResult] = {}
    errors: list[Exception] = []
    try:
        with progress("fits", len(loaded)) as report:
            for future in as_completed(futures):
                i, name = futures[future], loaded[futures[future]].output.name
                try:
                    results[i] = future.result()
                    said = f"{name}: loss {results[i].losses[-1]:.4g}"
                except Exception as error:
                    error.add_note(f"the fit that writes to {loaded[i].output}")
                    errors.append(error)
                    said = f"{name}: {type(error).__name__}"
                report(len(results) + len(errors), said)
    finally:
        for future in futures:
            future.cancel()
    if errors:
        raise ExceptionGroup(
            f"{len(errors)} of {len(loaded)} fits failed; the results of the others are written", errors
        )
    return [results[i] for i in range(len(loaded))]
