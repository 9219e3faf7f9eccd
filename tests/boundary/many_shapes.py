"""Ten thousand scenes of shapes without triangles: few samples each, all of them together.

``python -m tests.boundary.many_shapes FILE FIRST LAST [WORLD]`` measures scenes of ``random_shapes`` and appends a line
each to FILE, in which it goes on where it ended; ``python -m tests.boundary.many_shapes FILE`` reports.

A scene is rendered, differentiated in both modes, and by differences of which one, D_0, weighs the others. So
a = <D_0, E> and b = <D_0, D> have equal means if derivatives E are right, and sum a / sum b over scenes is a slope
without the bias of noisy weights. A scene whose a and b differ by more than their errors is measured again with more
samples. Modes have equal random numbers and must be transposes of each other; nothing may be infinite or dropped.
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


def measured(case, more: int, seed: int) -> dict:
    """Return a, b, the variance of a - b, and by how much the modes differ."""
    scene, params = load(case.scene)
    integrator = case.integrator()
    base = {n: params[n].numpy().astype(np.float64) for n in case.names}
    tangents = {n: np.asarray(case.tangent(v), np.float64) for n, v in base.items()}
    given = {n: t.astype(np.float32) for n, t in tangents.items()}

    def image(sign: float, seed: int) -> np.ndarray:
        move(params, {n: base[n] + sign * case.step * t for n, t in tangents.items()})
        shown = psdr.render(scene, params, integrator=integrator, spp=DIFFERENCE_SPP * more, seed=seed)
        return shown.numpy().astype(np.float64)

    def difference(seed: int) -> np.ndarray:
        return (image(1.0, seed) - image(-1.0, seed)) / (2.0 * case.step)

    try:
        d = [difference(seed + 10 * k) for k in range(BATCHES + 1)]
    finally:
        move(params, base)
    shown = psdr.render(scene, params, integrator=integrator, spp=SPP, seed=seed).numpy()
    options = {"integrator": integrator, "spp": SPP * more}
    e = [
        psdr.render_forward(scene, params, given, seed=seed + 100 + k, **options).numpy().astype(np.float64)
        for k in range(BATCHES)
    ]
    weights = np.random.default_rng(seed).uniform(0.5, 1.5, e[0].shape).astype(np.float32)
    params.requires_grad_only(*case.names)
    params.zero_grad()
    psdr.render_backward(scene, params, weights, seed=seed + 100, **options)
    grads = [params[n].grad.numpy().astype(np.float64) for n in case.names]
    reverse = sum(float((g * t).sum()) for g, t in zip(grads, tangents.values(), strict=True))
    size = float((weights * np.abs(e[0])).sum())
    scale = float(shown.mean())
    w = d[0] / scale**2
    spread = [noise(w * (x[0] - x[1])) / 4.0 for x in (e, d[1:])]
    return {
        "weight": float((w * d[0]).sum()),
        "a": float((w * np.mean(e, axis=0)).sum()),
        "b": float((w * np.mean(d[1:], axis=0)).sum()),
        "variance": sum(spread),
        "transposed": abs(reverse - float((weights * e[0]).sum())) / (size + 1e-6 * scale),
        "finite": bool(all(np.isfinite(x).all() for x in (shown, *e, *d, *grads))),
        "zero": not any(g.any() for g in grads),
    }


def line(seed: int) -> dict:
    """Return what is said of a scene."""
    case = draw(seed)
    found = {"seed": seed, "what": "".join(c for c in case.what if not c.isdigit()), "depth": case.depth}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            rounds = []
            for k in range(ROUNDS + 1):
                rounds.append(measured(case, 4**k, 1000 * (k + 1) + seed))
                if abs(rounds[-1]["a"] - rounds[-1]["b"]) <= DOUBTFUL * np.sqrt(rounds[-1]["variance"]):
                    break
            found |= {**rounds[0], "rounds": len(rounds), "last": rounds[-1]}
        except ValueError as problem:
            found["refused"] = str(problem)[:200]
    found["said"] = sorted({str(w.message)[:160] for w in said if issubclass(w.category, RuntimeWarning)})
    SCENES.pop(case.scene, None)
    return found


def report(lines: list[dict]) -> None:
    """Print slopes by worlds and by what moves, with jackknife errors over the scenes, and what is wrong."""
    ran = [x for x in lines if "refused" not in x]
    print(f"{len(lines)} scenes, {len(lines) - len(ran)} refused, {sum(x['rounds'] > 1 for x in ran)} measured again")
    groups = defaultdict(list)
    for x in ran:
        kinds = WORLDS[x["seed"] % len(WORLDS)][3]
        groups["all"].append(x)
        groups[f"world {x['seed'] % len(WORLDS)}: {' '.join(WORLDS[x['seed'] % len(WORLDS)][2:3] + kinds)}"].append(x)
        groups[x["what"]].append(x)
    for name, held in groups.items():
        # What weighs a scene must not know of its E and D; nor may the first round know that there were others.
        a, b, size = (np.array([x[k] for x in held]) for k in ("a", "b", "weight"))
        a, b = (x / np.where(size > 0.0, size, np.inf) for x in (a, b))
        left = (a.sum() - a) / (b.sum() - b)
        error = np.sqrt((len(left) - 1) / len(left) * ((left - left.mean()) ** 2).sum())
        print(f"{name:60} {len(held):6} scenes, slope {a.sum() / b.sum():.4f} +- {error:.4f}")
    for x in ran:
        faults = {"not finite": not x["finite"], "not transposed": x["transposed"] > SUMMATION}
        bad = [fault for fault, present in faults.items() if present]
        if x["last"]["b"] != 0.0 and x["rounds"] > ROUNDS:
            last = x["last"]
            if abs(last["a"] - last["b"]) > DOUBTFUL * np.sqrt(last["variance"]):
                bad.append(f"a {last['a']:.4g}, b {last['b']:.4g} +- {np.sqrt(last['variance']):.2g}")
        if bad or x["said"]:
            print(x["seed"], x["what"], x["depth"], bad, x["said"])
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
