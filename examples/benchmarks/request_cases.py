"""Requests for derivatives in one scene file: drawn at random, asked of the plan, and compared with differences.

A program that ``requests.py`` starts: it reads the options of some scenes as JSON, and prints JSON lines, one of kind
"start" before each scene and each request, so that a crash is told from what was asked.
"""

import json
import os
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from common import psdr
from request_draw import CAMERAS, Directions, draw, half_step, sensor_of

from warp_psdr.scene.files.xml import describe_file

#: Least batches, and standard error of a slope at which no batch is added.
FEWEST, ENOUGH = 6, 0.008
#: Times the budget until a slope is called wrong.
DOUBT = 4.0
#: Processor seconds of a batch's derivative and of its images, and most samples of either.
SHARE, MOST_SAMPLES = 0.25, 512
#: First seeds of derivatives and of differences.
SEED, DIFFERENCE_SEED, KINK_SEED = 500, 7000, 90000
#: Standard error above which a slope says nothing.
NOISY = 0.05
#: Relative difference of one-sided differences above which the image has no derivative; curvature's is about the step.
KINK, KINK_BATCHES = 0.2, 16
#: Samples of the calls that are timed.
TIMED = 16


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is asked.

    Attributes:
        file: the scene.
        folder: where the files that it names lie, or below.
        label: the scene's name, which the drawing depends on.
        seed: of the drawing.
        each: most parameters of each kind.
        size: of the film's longer side, in pixels.
        slopes: compare with differences.
        budget: processor seconds of a comparison.
        until: time after which no request begins.
        values: of the files' ``$parameters``.
        done: names of parameters that are not asked for again.
        most: most comparisons; None: all.
    """

    file: str
    folder: str
    label: str
    seed: int = 0
    each: int = 3
    size: int = 48
    slopes: bool = False
    budget: float = 10.0
    until: float = float("inf")
    values: dict[str, str]
    done: Collection[str] = ()
    most: int | None = None


def load(options: Options) -> psdr.Scene:
    """Load a scene with a small film; all else is the file's."""
    text = Path(options.file).read_text(encoding="utf-8", errors="replace")
    values = {name: value for name, value in options.values.items() if f"${name}" in text}
    description = describe_file(options.file, allow_outside=options.folder, **values)
    parts = [part for sensor in description.sensors for part in sensor.nested]
    for sensor in description.sensors:
        if sensor.kind not in CAMERAS or any(sensor is part for part in parts):
            continue
        scale = options.size / max(sensor.film.width, sensor.film.height)
        width, height = (max(1, round(scale * n)) for n in (sensor.film.width, sensor.film.height))
        whole = {"crop_offset_x": 0, "crop_offset_y": 0, "crop_width": width, "crop_height": height}
        sensor.film = replace(sensor.film, width=width, height=height, **whole)
    return psdr.Scene(description, "cpu")


def cpu_seconds() -> float:
    """Return the processor time of this process and of its children."""
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


def slope(derivatives: np.ndarray, differences: np.ndarray) -> tuple[float, float]:
    """Return the slope of the mean derivative on the mean difference, (n, ...) each, and the jackknife's error.

    The squared difference is the product of the means of even and of odd batches, which noise does not raise.
    """

    def of(which: np.ndarray) -> float:
        even, odd = (differences[which[which % 2 == r]].mean(axis=0) for r in (0, 1))
        return float((derivatives[which].mean(axis=0) * (even + odd)).sum() / (2.0 * (even * odd).sum()))

    count = len(derivatives)
    everything = np.arange(count)
    with np.errstate(divide="ignore", invalid="ignore"):
        without = np.array([of(np.delete(everything, i)) for i in everything])
        return of(everything), float(np.sqrt((count - 1) / count * ((without - without.mean()) ** 2).sum()))


def verdict(value: float, error: float) -> str:
    """Return what a slope says."""
    if not np.isfinite(value) or error > NOISY:
        return "noisy"
    return "right" if abs(value - 1.0) <= max(0.02, 3.0 * error) else "wrong"


class Comparison:
    """A forward derivative and central differences of images with equal random numbers, batch by batch."""

    def __init__(self, scene: psdr.Scene, kind: str, name: str, sensor: int, tangent: np.ndarray):
        self._scene, self._name, self._sensor, self._tangent = scene, name, sensor, tangent
        self._params = psdr.traverse(scene)
        self._base = self._params[name].numpy().copy()
        self._half = half_step(kind, name)

    def _derivative(self, spp: int, seed: int) -> np.ndarray:
        tangents = {self._name: self._tangent.astype(np.float32)}
        image = psdr.render_forward(self._scene, self._params, tangents, spp=spp, seed=seed, sensor=self._sensor)
        return image.numpy().astype(np.float64)

    def _image(self, spp: int, seed: int) -> np.ndarray:
        return psdr.render(self._scene, spp=spp, seed=seed, sensor=self._sensor).numpy().astype(np.float64)

    def _moved(self, step: float, spp: int, seed: int) -> np.ndarray:
        """Return the image at some step along the tangent."""
        try:
            self._set((self._base + step * self._tangent).astype(np.float32))
            return self._image(spp, seed)
        finally:
            self._set(self._base)

    def _difference(self, half: float, spp: int, seed: int) -> np.ndarray:
        return (self._moved(half, spp, seed) - self._moved(-half, spp, seed)) / (2.0 * half)

    def _set(self, values: np.ndarray) -> None:
        self._params[self._name] = values
        self._params.update()

    def _kinked(self, spp: int) -> bool:
        """Return whether the image has two one-sided derivatives, as where shapes in contact part."""
        rows = []
        for seed in range(KINK_SEED, KINK_SEED + KINK_BATCHES):
            before, here, after = (self._moved(k * self._half, spp, seed) for k in (-1.0, 0.0, 1.0))
            rows.append(((before - 2.0 * here + after) / self._half, (after - before) / (2.0 * self._half)))
        bends, slopes = (np.array(column) for column in zip(*rows, strict=True))

        def excess(which: np.ndarray) -> float:
            """The squares of both, of means of even and of odd batches, which noise does not raise."""
            even, odd = which[which % 2 == 0], which[which % 2 == 1]
            bend, slope = (float((x[even].mean(axis=0) * x[odd].mean(axis=0)).sum()) for x in (bends, slopes))
            return bend - KINK**2 * slope

        everything = np.arange(KINK_BATCHES)
        without = np.array([excess(np.delete(everything, i)) for i in everything])
        error = np.sqrt((KINK_BATCHES - 1) / KINK_BATCHES * ((without - without.mean()) ** 2).sum())
        return excess(everything) > 3.0 * float(error)

    def run(self, budget: float) -> dict:
        """Return processor seconds of the first calls, the slope, its error, and the slope on twice the step."""
        found: dict = {}
        self._image(TIMED, 1)
        image = _timed(lambda: self._image(TIMED, 2))
        for n, title in enumerate(("cold", "second", "warm"), 1):
            found[title] = _timed(lambda n=n: self._derivative(TIMED, n))
        found["image"] = image
        ours, theirs = (int(np.clip(TIMED * SHARE / t, 4, MOST_SAMPLES)) for t in (found["warm"], 4.0 * image))
        start, batches = cpu_seconds(), []
        while True:
            n = len(batches)
            seed = DIFFERENCE_SEED + n
            fine, wide = (self._difference(k * self._half, theirs, seed) for k in (1.0, 2.0))
            batches.append((self._derivative(ours, SEED + n), fine, wide))
            if len(batches) < FEWEST or len(batches) % 2:
                continue
            derivatives, fine, wide = (np.array(column) for column in zip(*batches, strict=True))
            if not (derivatives.any() or fine.any()):
                return found | {"result": "zero", "batches": len(batches)}
            value, error = slope(derivatives, fine)
            result = verdict(value, error)
            # Errors of few batches come out small: before a slope is called wrong, more are drawn.
            if cpu_seconds() - start > (DOUBT if result == "wrong" else 1.0) * budget:
                break
            if error < ENOUGH and result != "wrong":
                break
        numbers = {"slope": value, "error": error, "wide": slope(derivatives, wide)[0]}
        if result == "wrong" and verdict(2.0 * value - numbers["wide"], error) == "right":
            result = "right"  # what the step leaves of edges that cross pixels is of its first order
        if result == "wrong" and self._kinked(theirs):
            result = "one-sided"
        found |= {name: float(x) if np.isfinite(x) else None for name, x in numbers.items()}
        return found | {"result": result, "batches": len(batches)}


def _timed(call: Callable[[], object]) -> float:
    start = cpu_seconds()
    call()
    return max(cpu_seconds() - start, 1e-3)


def records(options: Options) -> Iterator[dict]:
    """Yield lines on a scene and its requests, one of each request when it begins and one when it is answered."""
    about = {"file": options.label}
    yield {"kind": "start", **about}
    try:
        scene = load(options)
        params = psdr.traverse(scene)
        drawn = draw(scene, options.label, options.seed, options.each)
    except (ValueError, OSError) as error:
        yield {"kind": "scene", **about, "result": "not loaded", "why": _sentence(error)}
        return
    except Exception as error:
        yield {"kind": "scene", **about, "result": "crashed", "why": f"{type(error).__name__}: {_sentence(error)}"}
        return
    compared = 0
    for what, name in _in_turns(drawn) if options.slopes else drawn:
        if name in options.done:
            continue
        if time.time() > options.until:
            return
        line = {**about, "what": what, "name": name}
        yield {"kind": "start", **line}
        line["kind"] = "request"
        try:
            sensor = sensor_of(scene, name)
            line["plan"] = _timed(lambda name=name, sensor=sensor: psdr.plan(scene, names=[name], sensor=sensor))
            line["result"] = "taken"
        except ValueError as error:
            line |= {"result": "refused", "why": _sentence(error)}
        except Exception as error:
            line |= {"result": "crashed", "why": f"{type(error).__name__}: {_sentence(error)}"}
        try:
            if line["result"] == "taken" and options.slopes and (options.most is None or compared < options.most):
                rng = np.random.default_rng([options.seed, zlib.crc32(f"{options.label} {name}".encode())])
                tangent = Directions(scene, params, sensor, rng).of(what, name)
                if tangent.any():
                    line |= Comparison(scene, what, name, sensor, tangent).run(options.budget)
                    compared += 1
                else:
                    line["result"] = "at a bound"
        except ValueError as error:
            line |= {"result": "planned, then refused", "why": _sentence(error)}
        except Exception as error:
            line |= {"result": "crashed", "why": f"{type(error).__name__}: {_sentence(error)}"}
        yield line
    yield {"kind": "scene", **about, "result": "done", "requests": len(drawn)}


def _in_turns(drawn: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return requests by turns of their kinds, which begin with another one in each scene."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for what, name in drawn:
        kinds.setdefault(what, []).append((what, name))
    first = zlib.crc32(repr(drawn).encode()) % max(len(kinds), 1)
    turns = zip_longest(*(list(kinds.values())[first:] + list(kinds.values())[:first]))
    return [request for turn in turns for request in turn if request is not None]


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split())


def main() -> None:
    """Answer what is asked: a list of options."""
    warnings.simplefilter("ignore")  # notes on a scene
    for given in json.load(sys.stdin):
        for line in records(Options(**given)):
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
