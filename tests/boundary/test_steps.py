"""Boundary terms look past edges at some steps (``kernels/step.py``), whose length must not change derivatives.

The same random numbers are used with steps of half and of twice the length, so that no noise hides what is lost where
steps are too short for float32, or too long for what is seen.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import scene as scenes

from . import (
    test_cameras,
    test_crossing,
    test_curves,
    test_exact_kinds,
    test_notches,
    test_rooted,
    test_sdfgrid,
    test_table,
    test_tubes,
)
from .measure import Case, accumulated
from .scenes import SCENES

#: Of the derivative, times the factor of the step: its error is of first order, some 1e-5 in most scenes.
BOUND = 1.0e-4
#: The same beside shapes without triangles: two or three of 65,536 samples that graze meet something else.
GRAZING = 1.0e-3
FACTORS = (0.5, 2.0)
#: Files whose rows hold shapes without triangles.
ROUND = (test_sdfgrid, test_exact_kinds, test_tubes, test_crossing, test_rooted)
#: (rows of a file, the row's name)
ROWS = (
    (test_table, "smooth, scales, depth 2"),
    (test_notches, "wedge, slides, depth 2"),
    (test_table, "soft, all move, depth 2"),
    (test_table, "room, a box on the floor moves, depth 2"),
    (test_table, "floating, a box moves, depth 3"),
    (test_curves, "sunk, the camera moves, depth 2"),
    (test_curves, "knot, a mesh through itself, depth 2"),
    (test_cameras, "lens smooth, focus moves, depth 2"),
    (test_cameras, "parallel smooth, camera moves, depth 2"),
    (test_cameras, "lens mirror, focus moves, depth 2"),
    (test_notches, "prism in a mirror, prism moves, depth 4"),
    (test_notches, "prism, index changes, depth 4"),
    # Creases of grids, rims, joints and open ends of tubes, and curves in which such shapes cut meshes and each other.
    (test_sdfgrid, "grid, lamp, one half, depth 2"),
    (test_sdfgrid, "shaded grid, lamp, z, depth 2"),
    (test_exact_kinds, "exact cylinder, lamp, z, depth 2"),
    (test_exact_kinds, "exact disk, point, x, depth 2"),
    (test_tubes, "helix cones, lamp, x, depth 2"),
    (test_tubes, "tapered tube, lamp, radii, depth 2"),
    (test_crossing, "sunk cylinder, lamp, z, depth 2"),
    (test_crossing, "crossed, lamp, radius, depth 2"),
    (test_rooted, "rooted tubes, lamp, sinks, depth 2"),
)


def row(module, name: str) -> Case:
    (found,) = (case for case in module.CASES if str(case) == name)
    return found


def derivative(case: Case, factor: float, monkeypatch) -> np.ndarray:
    """Return the mean of four batches of a row's derivatives where the ray epsilon is ``factor`` times as long."""
    with monkeypatch.context() as changed:
        changed.setattr(scenes, "RAY_EPSILON", factor * scenes.RAY_EPSILON)
        loaded = psdr.load_dict({"type": "scene", **SCENES[case.scene]()})
    tangents = dict.fromkeys(case.names, case.tangent)
    images = [accumulated(loaded, tangents, case.integrator(), 64, seed) for seed in range(4)]
    return np.mean(images, axis=0, dtype=np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(("module", "name"), [pytest.param(m, n, id=n) for m, n in ROWS])
def test_derivatives_do_not_depend_on_the_step(module, name: str, monkeypatch) -> None:
    case = row(module, name)
    expected = derivative(case, 1.0, monkeypatch)
    square = float((expected * expected).sum())
    assert square > 0.0
    bound = GRAZING if module in ROUND else BOUND
    for factor in FACTORS:
        change = float(((derivative(case, factor, monkeypatch) - expected) * expected).sum()) / square
        assert abs(change) < bound * max(factor, 1.0), f"{factor} times the step: {change:.1e}"
