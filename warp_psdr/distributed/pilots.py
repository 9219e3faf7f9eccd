"""What accuracy costs, measured in a process of a pool."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp_psdr as psdr
from warp_psdr.distributed import jobs

if TYPE_CHECKING:
    from warp_psdr.accuracy.report import Report
    from warp_psdr.scene.scene import Scene


def run_accuracy(
    setting: jobs.Setting, scene: Scene, names: list[str], adjoint: Any, tangents: dict | None, options: dict[str, Any]
) -> Report:
    """Measure it here; arguments as of ``psdr.accuracy``, ``names`` in place of what was requested."""
    with jobs.alone(setting):
        params = psdr.traverse(scene)
        params.requires_grad(*names)
        return psdr.accuracy(scene, params, adjoint, tangents=tangents, **options)
