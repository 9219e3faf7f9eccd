"""warp_psdr: physics-based differentiable rendering as NVIDIA Warp kernels."""

from __future__ import annotations

import gc
import importlib
from typing import TYPE_CHECKING, Any

_collects = gc.isenabled()
gc.disable()  # hundreds of thousands of objects stay: looking for garbage takes a third of the time
try:
    from warp_psdr import boundary, guiding, interior, losses, optim
    from warp_psdr.accuracy.pilot import accuracy
    from warp_psdr.aov import render_aov
    from warp_psdr.estimate.boundary.trace import BoundaryTrace
    from warp_psdr.estimate.compile import Compilation, compile
    from warp_psdr.estimate.trace import Trace, trace_sample
    from warp_psdr.image import Image
    from warp_psdr.invalid import invalid_samples
    from warp_psdr.moment import render_moment
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.options.methods import methods
    from warp_psdr.parts import render_parts
    from warp_psdr.plan.plan import Plan, plan
    from warp_psdr.render import render, render_backward, render_forward
    from warp_psdr.scene.acceleration import set_ray_backend
    from warp_psdr.scene.cornell_box import cornell_box
    from warp_psdr.scene.load import SceneWarning, load_dict, load_file, load_string
    from warp_psdr.scene.parameters import Parameters, traverse
    from warp_psdr.scene.transforms import Transform
    from warp_psdr.view.viewer import view
    from warp_psdr.workers import set_workers
finally:
    if _collects:
        gc.enable()

if TYPE_CHECKING:
    from warp_psdr import fit, image_io, plots, scenes, sdf
    from warp_psdr import torch as torch
    from warp_psdr.image_io import read_image, write_image
    from warp_psdr.scene.own_meshes import load_mesh, preview_scene
    from warp_psdr.scene.scene import Scene

__version__ = "0.1.0"

__all__ = [
    "BoundaryTrace",
    "Compilation",
    "Image",
    "Parameters",
    "PathIntegrator",
    "Plan",
    "Scene",
    "SceneWarning",
    "Trace",
    "Transform",
    "accuracy",
    "boundary",
    "compile",
    "cornell_box",
    "fit",
    "guiding",
    "image_io",
    "interior",
    "invalid_samples",
    "load_dict",
    "load_file",
    "load_mesh",
    "load_string",
    "losses",
    "methods",
    "optim",
    "plan",
    "plots",
    "preview_scene",
    "read_image",
    "render",
    "render_aov",
    "render_backward",
    "render_forward",
    "render_moment",
    "render_parts",
    "scenes",
    "sdf",
    "set_ray_backend",
    "set_workers",
    "trace_sample",
    "traverse",
    "view",
    "write_image",
]

#: Modules that few programs need, or that need more than Warp and NumPy; each is loaded when it is first used.
#: ``torch`` is not in ``__all__``: a star import would ask for PyTorch.
_LAZY_MODULES = ("fit", "image_io", "plots", "scenes", "sdf", "torch")
_LAZY_NAMES = {
    "Scene": "warp_psdr.scene.scene",
    "load_mesh": "warp_psdr.scene.own_meshes",
    "preview_scene": "warp_psdr.scene.own_meshes",
    "read_image": "warp_psdr.image_io",
    "write_image": "warp_psdr.image_io",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY_MODULES:
        return importlib.import_module(f"warp_psdr.{name}")
    if name in _LAZY_NAMES:
        return getattr(importlib.import_module(_LAZY_NAMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
