"""Which kernels calls need, compiled before they are made: ``psdr.compile``, and what loading a scene begins."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_psdr import compiler
from warp_psdr.compiler import Compiled
from warp_psdr.estimate import light
from warp_psdr.estimate.boundary.terms import prepare
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.plan import decide
from warp_psdr.scene.derived_values import pull_kernels
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.plan.integrator import Integrator
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True)
class Compilation:
    """What ``psdr.compile`` has done; ``str`` is a table.

    Attributes:
        compiled: what was compiled, with its own seconds; kernels are compiled side by side.
        seconds: from start to end.
    """

    compiled: tuple[Compiled, ...]
    seconds: float

    def __str__(self) -> str:
        if not self.compiled:
            return f"all kernels were in the cache ({self.seconds:.1f} s)"
        lines = [f"{c.name:<24} {c.seconds:6.1f} s" for c in self.compiled]
        return "\n".join([*lines, f"{len(lines)} compiled side by side in {self.seconds:.1f} s"])


def compile(
    scene: Scene,
    params: Parameters | None = None,
    *,
    integrator: Integrator | None = None,
    sensor: Sensor = 0,
) -> Compilation:
    """Compile all kernels of a scene's image and, with parameters, of the gradient that they request.

    Every call does so for itself; this one is for programs that do not want to wait later, and for images of machines
    that come with a filled kernel cache.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``; None: the image alone.
        integrator: as of ``render``; default: what the scene file names.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.

    Returns:
        What was compiled.

    Raises:
        ValueError: as ``render_backward``, of what cannot be differentiated.
    """
    check_loaded(scene)
    integrator = integrator_of(scene, integrator)
    start, before = time.perf_counter(), len(compiler.done)
    kernels: list = []
    for number in scene.description.views(sensor).sensors:
        plan = decide(scene, integrator=integrator, sensor=number)
        kernels += light.image_kernels(scene, plan, number)
        compiler.begin(kernels, scene.device)
        if params is not None and params.requested:
            names = params.requested
            plan = decide(scene, params, integrator=integrator, sensor=number)
            kernels += [*light.gradient_kernels(plan, "reverse"), *pull_kernels(scene, names)]
            compiler.begin(kernels, scene.device)
            if plan.boundary is not None:
                kernels += prepare(scene, plan, names, number)
    compiler.ensure(kernels, scene.device)
    return Compilation(tuple(compiler.done[before:]), time.perf_counter() - start)


def image_ahead(scene: Scene) -> None:
    """Begin to compile the image's kernel, before the scene is whole.

    It may be a wrong guess about a scene that changes, or that is rendered otherwise; a call finds out by itself.
    """
    try:
        if not integrator_of(scene, None).hide_emitters:  # else the plan builds a ray structure
            plan = decide(scene)
            compiler.begin(light.image_kernels(scene, plan, 0), scene.device)
    except Exception:
        return  # whoever renders gets to hear of it
