"""Ten thousand scenes of shapes without triangles: few samples each, all of them together.

``python -m tests.boundary.many_shapes FILE FIRST LAST [WORLD]`` measures scenes of ``random_shapes`` and appends a line
each to FILE, in which it goes on where it ended; ``python -m tests.boundary.many_shapes FILE`` reports.

A scene is rendered and differentiated in both modes, which have equal random numbers and must be transposes of each
other; nothing may be infinite or dropped. One in five is compared with differences, of which one, D_0, weighs the
others. So a = <D_0, E> and b = <D_0, D> have equal means if derivatives E are right, and sum a / sum b over scenes is a
slope without the bias of noisy weights. Where a and b differ by more than their errors they are measured again with
more samples.
"""

import json
import sys
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np

import warp_psdr as psdr

from .measure import SUMMATION, move
from .random_shapes import WORLDS, draw
from .scenes import SCENES, load

#: Of a derivative, and of an image in a difference; each round that a scene is measured again takes four times as many.
SPP, DIFFERENCE_SPP, ROUNDS = 16, 128, 3
#: One in so many scenes is compared with differences.
COMPARED = 5
#: Independent images of a derivative, and of its difference.
BATCHES = 2
#: Pixels on a side.
BLOCK = 4
#: Standard errors beyond which a scene is measured again.
DOUBTFUL = 3.5


def noise(difference: np.ndarray) -> float:
    """Return the variance of a sum over pixels, from one difference of two; filters correlate pixels of a block."""
    rows, columns, channels = difference.shape
    blocks = difference.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK, channels)
    return float((blocks.sum(axis=(1, 3, 4)) ** 2).sum())


def derivatives(case, more: int, seed: int) -> list[np.ndarray]:
    """Return independent derivative images."""
    scene, params = load(case.scene)
    given = {n: np.float32(case.tangent(params[n].numpy().astype(np.float64))) for n in case.names}
    options = {"integrator": case.integrator(), "spp": SPP * more}
    images = [psdr.render_forward(scene, params, given, seed=seed + k, **options).numpy() for k in range(BATCHES)]
    return [x.astype(np.float64) for x in images]


def ran(case, seed: int) -> dict:
    """Return by how much the modes differ, and whether all that is returned is finite, and any of it not zero."""
    scene, params = load(case.scene)
    options = {"integrator": case.integrator(), "spp": SPP, "seed": seed}
    shown = psdr.render(scene, params, **options).numpy()
    given = {n: np.float32(case.tangent(params[n].numpy().astype(np.float64))) for n in case.names}
    forward = psdr.render_forward(scene, params, given, **options).numpy().astype(np.float64)
    weights = np.random.default_rng(seed).uniform(0.5, 1.5, forward.shape).astype(np.float32)
    params.requires_grad_only(*case.names)
    params.zero_grad()
    psdr.render_backward(scene, params, weights, **options)
    grads = {n: params[n].grad.numpy().astype(np.float64) for n in case.names}
    reverse = sum(float((grads[n] * given[n]).sum()) for n in case.names)
    size = float((weights * np.abs(forward)).sum()) + 1e-6 * float(shown.mean())
    return {
        "transposed": abs(reverse - float((weights * forward).sum())) / size,
        "finite": bool(all(np.isfinite(x).all() for x in (shown, forward, *grads.values()))),
        "zero": not any(g.any() for g in grads.values()),
    }


def compared(case, more: int, seed: int) -> dict:
    """Return a, b, and the variance of a - b."""
    scene, params = load(case.scene)
    base = {n: params[n].numpy().astype(np.float64) for n in case.names}
    tangents = {n: np.asarray(case.tangent(v), np.float64) for n, v in base.items()}

    def image(sign: float, seed: int) -> np.ndarray:
        move(params, {n: base[n] + sign * case.step * t for n, t in tangents.items()})
        options = {"integrator": case.integrator(), "spp": DIFFERENCE_SPP * more, "seed": seed}
        return psdr.render(scene, params, **options).numpy().astype(np.float64)

    def difference(seed: int) -> np.ndarray:
        return (image(1.0, seed) - image(-1.0, seed)) / (2.0 * case.step)

    try:
        d = [difference(seed + 10 * k) for k in range(BATCHES + 1)]
    finally:
        move(params, base)
    e = derivatives(case, more, seed + 100)
    w = d[0] / max(float(np.abs(d[0]).max()), 1e-30)
    spread = [noise(w * (x[0] - x[1])) / 4.0 for x in (e, d[1:])]
    return {
        "weight": float((w * d[0]).sum()),
        "a": float((w * np.mean(e, axis=0)).sum()),
        "b": float((w * np.mean(d[1:], axis=0)).sum()),
        "variance": sum(spread),
    }


def doubtful(x: dict) -> bool:
    """Whether a and b differ by more than their errors."""
    return abs(x["a"] - x["b"]) > DOUBTFUL * np.sqrt(x["variance"])


def line(seed: int) -> dict:
    """Return what is said of a scene."""
    case = draw(seed)
    found = {"seed": seed, "what": "".join(c for c in case.what if not c.isdigit()), "depth": case.depth}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found |= ran(case, seed)
            if seed // len(WORLDS) % COMPARED == 0:
                rounds = []
                while len(rounds) <= ROUNDS and (not rounds or doubtful(rounds[-1])):
                    rounds.append(compared(case, 4 ** len(rounds), 1000 * (len(rounds) + 1) + seed))
                found["rounds"] = rounds
        except ValueError as problem:
            found["refused"] = str(problem)[:200]
    found["said"] = sorted({str(w.message)[:160] for w in said if issubclass(w.category, RuntimeWarning)})
    SCENES.pop(case.scene, None)
    return found


def report(lines: list[dict]) -> None:
    """Print slopes by worlds and by what moves, with jackknife errors over the scenes, and what is wrong."""
    done = [x for x in lines if "refused" not in x]
    rows = [x for x in done if "rounds" in x]
    again = sum(len(x["rounds"]) > 1 for x in rows)
    print(f"{len(lines)} scenes, {len(lines) - len(done)} refused, {len(rows)} compared, {again} of these again")
    groups = defaultdict(list)
    for x in rows:
        world = x["seed"] % len(WORLDS)
        _camera, _filter, lamp, kinds = WORLDS[world]
        for name in ("all", f"world {world}: {lamp} {' '.join(kinds)}", x["what"]):
            # The first round of each, for what weighs it must not know how its E and D turned out.
            if x["rounds"][0]["weight"] > 0.0:
                groups[name].append(x["rounds"][0])
    for name, held in groups.items():
        a, b = (np.array([x[k] / x["weight"] for x in held]) for k in ("a", "b"))
        left = (a.sum() - a) / (b.sum() - b)
        error = np.sqrt((len(left) - 1) / len(left) * ((left - left.mean()) ** 2).sum())
        print(f"{name:60} {len(held):6} scenes, slope {a.sum() / b.sum():.4f} +- {error:.4f}")
    for x in done:
        faults = {"not finite": not x["finite"], "not transposed": x["transposed"] > SUMMATION}
        bad = [fault for fault, present in faults.items() if present] + x["said"]
        if len(x.get("rounds", [])) > ROUNDS and doubtful(x["rounds"][-1]):
            last = x["rounds"][-1]
            bad.append(f"a {last['a']:.4g}, b {last['b']:.4g} +- {np.sqrt(last['variance']):.2g}")
        if bad:
            print(x["seed"], x["what"], x["depth"], bad)
    print(sum(x["zero"] for x in done), "have no derivative")
    for x in lines:
        if "refused" in x:
            print(x["seed"], x["what"], x["refused"])


if __name__ == "__main__":
    file = Path(sys.argv[1])
    held = [json.loads(x) for x in file.read_text().splitlines()] if file.exists() else []
    if len(sys.argv) > 2:
        done = {x["seed"] for x in held}
        only = int(sys.argv[4]) if len(sys.argv) > 4 else None
        with file.open("a") as written:
            for seed in range(int(sys.argv[2]), int(sys.argv[3])):
                if seed not in done and only in (None, seed % len(WORLDS)):
                    written.write(json.dumps(line(seed)) + "\n")
                    written.flush()
    else:
        report(held)
