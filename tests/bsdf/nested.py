"""Examples of models made of models, put together from those of their children."""

import re

import numpy as np

from warp_psdr.kernels.bsdf.blendbsdf import MIN_SHARE
from warp_psdr.kernels.bsdf.composite import split_key
from warp_psdr.kernels.bsdf.dispatch import declaration_of


def nest(**children: dict) -> dict:
    """Values of a composite: its own, and those of its children under their prefixes."""
    out = {}
    for prefix, mat in children.items():
        out |= {f"{prefix}_{name}": value for name, value in mat.items()} if isinstance(mat, dict) else {prefix: mat}
    return out


def part(mat: dict, prefix: str) -> dict:
    """Values of a child."""
    return {name.removeprefix(f"{prefix}_"): v for name, v in mat.items() if name.startswith(f"{prefix}_")}


def bare(mat: dict) -> dict:
    """Values under the names that they have in the innermost models; of equal names the last one counts."""
    return {re.sub("^((first|second|nested)_)+", "", name): value for name, value in mat.items()}


def blend(examples: dict, key: str) -> dict:
    """What an ``Example`` of a blend needs but for its materials, from those of its children."""
    one, two = (examples[child] for child in split_key(key)[2])
    lobes = [declaration_of(child)[0].lobes for child in split_key(key)[2]]

    def mixed(mat: dict, of_one, of_two):
        w = mat["weight"]
        return (1.0 - w) * of_one(part(mat, "first")) + w * of_two(part(mat, "second"))

    def value(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        f, g = (e.eval or (lambda *_: np.zeros(3)) for e in (one, two))
        return mixed(mat, lambda m: f(m, wi, wo), lambda m: g(m, wi, wo))

    def scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
        def of(example, lobes, m):
            return example.scatter(m, wi, lobe) if lobe in lobes else (None, np.zeros(3))

        wo = of(one, lobes[0], part(mat, "first"))[0]
        wo = of(two, lobes[1], part(mat, "second"))[0] if wo is None else wo
        return wo, mixed(mat, lambda m: of(one, lobes[0], m)[1], lambda m: of(two, lobes[1], m)[1])

    def mitsuba(mat: dict) -> dict | None:
        nested = [example.mitsuba(part(mat, prefix)) for example, prefix in ((one, "first"), (two, "second"))]
        # A model of weight 0 is not drawn there, and here it is, since its derivative is not 0.
        if None in nested or not MIN_SHARE <= mat["weight"] <= 1.0 - MIN_SHARE:
            return None
        return {"type": "blendbsdf", "weight": mat["weight"], "a": nested[0], "b": nested[1]}

    model = declaration_of(key)[0]
    return {
        "eval": value if model.has_smooth else None,
        "scatter": scatter if model.has_delta else None,
        "mitsuba": mitsuba,
        "lossless": lambda mat: one.lossless(part(mat, "first")) and two.lossless(part(mat, "second")),
    }
