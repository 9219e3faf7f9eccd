"""What pools are asked for: scenes of other tests, whose kernels are compiled, and all that calls return, as arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warp_psdr as psdr
from tests.estimate.test_workers import INTEGRATOR, SIZE
from tests.fit.scenes import write_fit
from tests.gradients import scenes
from tests.interior.test_light_tracing import POINT, corner
from tests.path.test_light_tracing import LIGHT_TRACING
from tests.sensor.test_batch import ONE, batch, cameras, parts
from warp_psdr.distributed import Pool
from warp_psdr.fit import checkpoint
from warp_psdr.fit.run import CHECKPOINT


@dataclass(frozen=True)
class Case:
    """A scene, and what is asked of it.

    Attributes:
        node: the scene's description.
        integrator: of the calls.
        names: of the gradient, and of the derivative image where there is one.
        forward: whether there is one.
        sensor: of the calls.
    """

    node: Callable[[], dict[str, Any]]
    integrator: psdr.PathIntegrator
    names: tuple[str, ...] = ()
    forward: bool = False
    sensor: Any = 0

    def load(self) -> tuple[Any, Any]:
        """Return the scene and its parameters."""
        scene = psdr.load_dict(self.node())
        params = psdr.traverse(scene)
        if self.names:
            params.requires_grad(*self.names)
        return scene, params


def gap(rfilter: str = "box", size: int = SIZE) -> dict[str, Any]:
    """Describe the scene of ``tests/estimate/test_workers.py``."""
    node = scenes.gap_scene()
    node["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": rfilter}}
    return {"type": "scene", **node}


def alone() -> dict[str, Any]:
    """Describe two cameras."""
    sampler = {"type": "independent", "sample_count": 8}
    return parts({name: {**camera, "sampler": sampler} for name, camera in cameras().items()})


SEEN = ("cube.bsdf.reflectance.value", "*.to_world", "lamp.position")
LIT = ("floor.bsdf.reflectance.value", "point.intensity.value", "point.position")
CASES = {
    "gap": Case(gap, INTEGRATOR, ("*",)),
    "gaussian filter": Case(lambda: gap("gaussian"), INTEGRATOR),
    "two sensors": Case(alone, ONE, SEEN, sensor=["wide", "long"]),
    "batch": Case(lambda: parts({"rig": batch()}), ONE, SEEN, sensor="rig"),
    "light paths": Case(
        lambda: corner(point=POINT), psdr.PathIntegrator(max_depth=4, interior=LIGHT_TRACING, boundary=None), LIT, True
    ),
}
GAP = CASES["gap"]


def answers(case: Case, scene: Any, params: Any, pool: Pool | None = None, seed: int = 1) -> dict[str, np.ndarray]:
    """Return all that a case asks for, of a pool or of this process."""
    renders, options = (
        psdr if pool is None else pool,
        {"integrator": case.integrator, "sensor": case.sensor, "seed": seed},
    )
    image = renders.render(scene, params, spp=4, **options).numpy()
    found = {"image": image}
    if case.names:
        params.zero_grad()
        adjoint = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
        returned = renders.render_backward(scene, params, adjoint, spp=4, **options)
        found |= {name: params[name].grad.numpy().copy() for name in params.requested}
        if pool is not None:
            assert returned.keys() == set(params.requested)
            for name, gradient in returned.items():
                np.testing.assert_array_equal(gradient.reshape(-1), found[name].reshape(-1), err_msg=name)
    if case.forward:
        tangents = {n: np.random.default_rng(1).normal(size=params[n].numpy().shape) for n in case.names}
        found["forward"] = renders.render_forward(scene, params, tangents, spp=4, **options).numpy()
    return found


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Fail unless all bits are equal, and unless they could differ.

    Raises:
        AssertionError: also for an image that is black, or a gradient that is zero.
    """
    assert found.keys() == expected.keys() and expected["image"].any()
    assert len(expected) == 1 or any(values.any() for name, values in expected.items() if name != "image")
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name].view(np.uint8), values.view(np.uint8), err_msg=name)


def fit_of_two_views(folder: Path, iterations: int = 20) -> Path:
    """Write the fit of ``tests/fit/scenes.py`` with both views in every step, and return its file."""
    folder.mkdir()
    path = write_fit(folder, iterations)
    path.write_text(path.read_text().replace("views_per_step = 1", "views_per_step = 2"))
    return path


def assert_same_fit(found: Path, expected: Path) -> None:
    """Fail unless all that the checkpoints of two fits hold has equal bits: losses, values, moments of Adam.

    Raises:
        AssertionError: they differ.
    """
    (own, _values), (other, _other_values) = (checkpoint.load(output / CHECKPOINT) for output in (found, expected))
    assert own.keys() == other.keys() and len(other["losses"]) > 1
    for name, values in other.items():
        assert own[name].tobytes() == values.tobytes(), name
