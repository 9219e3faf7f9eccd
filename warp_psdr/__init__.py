"""warp_psdr: physics-based differentiable rendering as NVIDIA Warp kernels."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from warp_psdr import boundary, guiding, interior, losses, optim
from warp_psdr.accuracy.pilot import accuracy
from warp_psdr.estimate.boundary.trace import BoundaryTrace
from warp_psdr.estimate.trace import Trace, trace_sample
from warp_psdr.invalid import invalid_samples
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.plan.plan import Plan, plan
from warp_psdr.render import render, render_backward, render_forward
from warp_psdr.scene.acceleration import set_ray_backend
from warp_psdr.scene.parameters import Parameters, traverse
from warp_psdr.scene.transforms import Transform
from warp_psdr.view.viewer import view
from warp_psdr.workers import set_workers

if TYPE_CHECKING:
    from warp_psdr import fit, image_io, plots
    from warp_psdr import torch as torch
    from warp_psdr.scene.scene import Scene

__version__ = "0.1.0"

__all__ = [
    "BoundaryTrace",
    "Parameters",
    "PathIntegrator",
    "Plan",
    "Trace",
    "Transform",
    "accuracy",
    "boundary",
    "fit",
    "guiding",
    "image_io",
    "interior",
    "invalid_samples",
    "load_dict",
    "load_file",
    "load_string",
    "losses",
    "optim",
    "plan",
    "plots",
    "render",
    "render_backward",
    "render_forward",
    "set_ray_backend",
    "set_workers",
    "trace_sample",
    "traverse",
    "view",
]

#: Modules that need more than Warp and NumPy; each is loaded when it is first used.
_LAZY_MODULES = ("fit", "image_io", "plots", "torch")


def __getattr__(name: str) -> Any:
    if name in _LAZY_MODULES:
        return importlib.import_module(f"warp_psdr.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY_MODULES})


def load_file(path, *, device: str = "cpu", allow_outside=False, **defaults) -> Scene:
    """Load a Mitsuba 3 scene file.

    Args:
        path: an XML file of version 3.x.
        device: Warp device, "cpu" or "cuda:0".
        allow_outside: where the files that the scene names may lie beside the scene's own folder and those below it: a
            folder (and below), several, or True: anywhere, for scenes that you trust. Wherever a name leads to, by
            "..", as an absolute name or by a symbolic link, other files are refused.
        **defaults: values for the file's ``$parameters``.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: the file, or one that it names, does not exist.
        ValueError: the file is malformed or uses what is not supported; the message names the place and the remedy.
    """
    from warp_psdr.scene import describe_file
    from warp_psdr.scene.scene import Scene

    return Scene(describe_file(path, allow_outside=allow_outside, **defaults), device)


def load_string(xml: str, *, device: str = "cpu", base=None, allow_outside=None, **defaults) -> Scene:
    """Load a Mitsuba 3 scene from XML text; see ``load_file``.

    Without ``base``, file names start from the current folder and, the text being the program's own, may lead anywhere.
    ``base`` stands for the scene's folder, which the names may then not leave. For text of strangers give ``base``, or
    ``allow_outside=False``.
    """
    from warp_psdr.scene import describe_string
    from warp_psdr.scene.scene import Scene

    if allow_outside is None:
        allow_outside = base is None
    return Scene(describe_string(xml, base=base, allow_outside=allow_outside, **defaults), device)


def load_dict(scene: dict, *, device: str = "cpu") -> Scene:
    """Load a scene from Mitsuba 3's dictionary form (plain Python and NumPy values).

    Relative file names start from the current folder; the names are the program's own, so any file may be named. See
    ``load_file``.
    """
    from warp_psdr.scene import describe_dict
    from warp_psdr.scene.scene import Scene

    return Scene(describe_dict(scene), device)
