"""PyTorch: a rendered image as a function of tensors, differentiated by ``loss.backward()``.

.. code-block:: python

    albedo = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
    image = psdr.torch.render(scene, {"wall.reflectance.value": albedo}, spp=64)
    (image - target).square().mean().backward()  # albedo.grad
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr.options import PathIntegrator
from warp_psdr.parameters import check_independent, traverse
from warp_psdr.render import render as render_image
from warp_psdr.render import render_backward

try:
    import torch
except ImportError as error:
    raise ImportError(
        "warp_psdr.torch needs PyTorch, which is not installed: pip install torch (on a machine without a GPU take the "
        "CPU build, see https://pytorch.org/get-started)"
    ) from error

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

__all__ = ["render"]


def render(
    scene: Scene,
    parameters: Mapping[str, torch.Tensor],
    *,
    sensor: int = 0,
    integrator: PathIntegrator | None = None,
    spp: int | None = None,
    spp_grad: int | None = None,
    seed: int = 0,
) -> torch.Tensor:
    """Render an image that is differentiable with respect to tensors.

    Args:
        scene: A loaded scene; it keeps the tensors' values.
        parameters: Tensors by parameter name, in the parameters' NumPy shapes, for instance (N, 3) for positions. Those
            that require a gradient get one.
        sensor: Which camera.
        integrator: Default: what the scene file names, else ``PathIntegrator()``.
        spp: Samples a pixel; default: the sensor's sample count.
        spp_grad: Samples a pixel of the backward pass; default: ``spp``.
        seed: Equal seeds give equal bits; the backward pass is decorrelated from the image.

    Returns:
        Radiance, shape (H, W, 3), float32, on the device of the first tensor (the CPU without any).

    Raises:
        KeyError: There is no such parameter.
        TypeError: A value is no floating-point tensor.
        ValueError: A wrong shape, numbers that are not finite, an option out of range, a pose beside the vertices that
            it moves, or a moving discontinuity that the method of the boundary term does not cover.
    """
    for name, tensor in parameters.items():
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
            raise TypeError(f"{name!r}: got {type(tensor).__name__}, expected a floating-point tensor")
    check_independent(scene, parameters)
    call = _Call(scene, tuple(parameters), sensor, integrator, spp, spp_grad, seed)
    return _Render.apply(call, *parameters.values())


@dataclass(frozen=True)
class _Call:
    """What is rendered, besides the tensors."""

    scene: Scene
    names: tuple[str, ...]
    sensor: int
    integrator: PathIntegrator | None
    spp: int | None
    spp_grad: int | None
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        return {"sensor": self.sensor, "integrator": self.integrator, "seed": self.seed}

    def state(self, params: Any) -> dict[str, np.ndarray]:
        """Return a copy of all values of the scene, but for those that follow from a pose."""
        posed = [name.removesuffix("to_world") for name in params if name.endswith(".to_world")]
        follow = {pose + name for pose in posed for name in ("vertex_positions", "vertex_normals")}
        return {name: params[name].numpy().copy() for name in params if name not in follow.difference(self.names)}

    def assign(self, values: Mapping[str, np.ndarray]) -> Any:
        """Make the scene hold the values and return its parameters."""
        params = traverse(self.scene)
        for name, value in values.items():
            value = params.check(name, value, "value")
            if not np.array_equal(value, params[name].numpy()):
                params[name] = value
        params.update()
        return params


class _Render(torch.autograd.Function):
    """The image as an operation of PyTorch's graph."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: torch.Tensor) -> torch.Tensor:
        params = call.assign({name: _numpy(tensor) for name, tensor in zip(call.names, tensors, strict=True)})
        wanted = [name for name, needed in zip(call.names, ctx.needs_input_grad[1:], strict=True) if needed]
        params.requires_grad(*wanted)
        # With a tape, what cannot be differentiated is refused here, and not only by backward().
        tape = wp.Tape() if wanted else None
        image = render_image(call.scene, params, spp=call.spp, spp_grad=call.spp_grad, tape=tape, **call.options)
        ctx.call = call
        ctx.state = call.state(params)
        ctx.save_for_backward(*tensors)
        return torch.from_numpy(image.numpy().copy()).to(tensors[0].device if tensors else "cpu")

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        call: _Call = ctx.call
        tensors = ctx.saved_tensors
        # Another render may have changed the scene since; it gets these values for now, and its own ones back.
        later = call.state(traverse(call.scene))
        params = call.assign(ctx.state)
        needed = ctx.needs_input_grad[1:]
        params.requires_grad(*(name for name, wanted in zip(call.names, needed, strict=True) if wanted))
        spp = call.spp_grad if call.spp_grad is not None else call.spp
        render_backward(call.scene, params, _numpy(adjoint), spp=spp, **call.options)
        gradients = [
            torch.from_numpy(params[name].grad.numpy().copy()).to(tensor).reshape(tensor.shape) if wanted else None
            for name, tensor, wanted in zip(call.names, tensors, needed, strict=True)
        ]
        call.assign(later)
        return (None, *gradients)


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)
