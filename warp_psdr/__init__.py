"""warp_psdr: physics-based differentiable rendering as NVIDIA Warp kernels."""

from __future__ import annotations

import gc
import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers; at run time names come from ``_PUBLIC``
    from warp_psdr import (
        boundary,
        cameras,
        distributed,
        fit,
        guiding,
        image_io,
        interior,
        losses,
        optim,
        plots,
        scenes,
        sdf,
        unknowns,
    )
    from warp_psdr import torch as torch
    from warp_psdr.accuracy.pilot import accuracy
    from warp_psdr.aov import render_aov
    from warp_psdr.bind import bind
    from warp_psdr.certify.certificate import Certificate
    from warp_psdr.certify.certify import certify
    from warp_psdr.certify.function import certify_function
    from warp_psdr.coverage import Coverage, coverage
    from warp_psdr.estimate.boundary.trace import BoundaryTrace
    from warp_psdr.estimate.compile import Compilation, compile
    from warp_psdr.estimate.trace import Trace, trace_sample
    from warp_psdr.film import Film
    from warp_psdr.image import Image
    from warp_psdr.image_io import read_image, write_image
    from warp_psdr.invalid import invalid_samples
    from warp_psdr.moment import render_moment
    from warp_psdr.newton import from_newton
    from warp_psdr.observe.observation import Observation
    from warp_psdr.observe.photograph import Photograph
    from warp_psdr.observe.solution import Solution
    from warp_psdr.observe.solve import solve
    from warp_psdr.options.integrator import AovIntegrator, PathIntegrator
    from warp_psdr.options.methods import methods
    from warp_psdr.parts import render_parts
    from warp_psdr.plan.plan import Plan, plan
    from warp_psdr.render import render, render_backward, render_forward
    from warp_psdr.rollout import rollout
    from warp_psdr.scene.acceleration import set_ray_backend, set_vector_width
    from warp_psdr.scene.cornell_box import cornell_box
    from warp_psdr.scene.files.own_meshes import load_mesh, preview_scene
    from warp_psdr.scene.load import SceneWarning, load_dict, load_file, load_string
    from warp_psdr.scene.parameters import Parameters, traverse
    from warp_psdr.scene.scene import Scene
    from warp_psdr.scene.transforms import Transform
    from warp_psdr.view.viewer import view
    from warp_psdr.workers import set_workers

__version__ = "0.1.0"

__all__ = [
    "AovIntegrator",
    "BoundaryTrace",
    "Certificate",
    "Compilation",
    "Coverage",
    "Film",
    "Image",
    "Observation",
    "Parameters",
    "PathIntegrator",
    "Photograph",
    "Plan",
    "Scene",
    "SceneWarning",
    "Solution",
    "Trace",
    "Transform",
    "accuracy",
    "bind",
    "boundary",
    "cameras",
    "certify",
    "certify_function",
    "compile",
    "cornell_box",
    "coverage",
    "distributed",
    "fit",
    "from_newton",
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
    "rollout",
    "scenes",
    "sdf",
    "set_ray_backend",
    "set_vector_width",
    "set_workers",
    "solve",
    "trace_sample",
    "traverse",
    "unknowns",
    "view",
    "write_image",
]

#: The module of each public name, and of each public module itself, which is loaded when the name is first used.
#: ``torch`` is not in ``__all__``: a star import would ask for PyTorch.
_PUBLIC = {
    "AovIntegrator": "options.integrator",
    "BoundaryTrace": "estimate.boundary.trace",
    "Certificate": "certify.certificate",
    "Compilation": "estimate.compile",
    "Coverage": "coverage",
    "Film": "film",
    "Image": "image",
    "Observation": "observe.observation",
    "Parameters": "scene.parameters",
    "PathIntegrator": "options.integrator",
    "Photograph": "observe.photograph",
    "Plan": "plan.plan",
    "Scene": "scene.scene",
    "SceneWarning": "scene.load",
    "Solution": "observe.solution",
    "Trace": "estimate.trace",
    "Transform": "scene.transforms",
    "accuracy": "accuracy.pilot",
    "bind": "bind",
    "certify": "certify.certify",
    "certify_function": "certify.function",
    "compile": "estimate.compile",
    "cornell_box": "scene.cornell_box",
    "coverage": "coverage",
    "from_newton": "newton",
    "invalid_samples": "invalid",
    "load_dict": "scene.load",
    "load_file": "scene.load",
    "load_mesh": "scene.files.own_meshes",
    "load_string": "scene.load",
    "methods": "options.methods",
    "plan": "plan.plan",
    "preview_scene": "scene.files.own_meshes",
    "read_image": "image_io",
    "render": "render",
    "render_aov": "aov",
    "render_backward": "render",
    "render_forward": "render",
    "render_moment": "moment",
    "render_parts": "parts",
    "rollout": "rollout",
    "set_ray_backend": "scene.acceleration",
    "set_vector_width": "scene.acceleration",
    "solve": "observe.solve",
    "set_workers": "workers",
    "trace_sample": "estimate.trace",
    "traverse": "scene.parameters",
    "view": "view.viewer",
    "write_image": "image_io",
}
_MODULES = (
    "boundary",
    "cameras",
    "distributed",
    "fit",
    "guiding",
    "image_io",
    "interior",
    "losses",
    "optim",
    "plots",
    "scenes",
    "sdf",
    "torch",
    "unknowns",
)


class _Package(ModuleType):
    """This module: a public name that a submodule has, too (``plan``, ``render``, ``view``), is never the submodule."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _PUBLIC or not isinstance(value, ModuleType):  # Python sets submodules that it has loaded
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC and name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    collects = gc.isenabled()
    gc.disable()  # hundreds of thousands of objects stay: looking for garbage takes a third of the time
    try:
        module = importlib.import_module(f"{__name__}.{_PUBLIC.get(name, name)}")
    finally:
        if collects:
            gc.enable()
    if name in _MODULES:
        return module
    value = getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
