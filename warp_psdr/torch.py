"""PyTorch: a rendered image as a function of tensors, differentiated by ``loss.backward()``.

.. code-block:: python

    albedo = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
    image = psdr.torch.render(scene, {"wall.reflectance.value": albedo}, spp=64)
    (image - target).square().mean().backward()  # albedo.grad

The layers of a ``neuralsdf`` are parameters like others: a module's own weights may be given, which its optimiser
then moves, ``{"body.layer0.weight": module[0].weight, "body.layer0.bias": module[0].bias, ...}``.

Forward mode (``torch.autograd.forward_ad``) gives derivative images. There are no second derivatives, and hence no
``torch.func`` transforms, which prepare for them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.plan import decide
from warp_psdr.render import render as render_image
from warp_psdr.render import render_backward, render_forward
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.frames import held_at
from warp_psdr.scene.parameters import Parameters, check_independent, parameter_of, traverse

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


def _left_alone(function: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    """Keep ``torch.compile`` from tracing a function, and Warp with it: graphs break where it is called.

    ``torch.compiler.disable`` does so, but imports the compiler, which takes as long as PyTorch itself. So the marks
    that the compiler reads are set here, where this PyTorch has them.
    """
    try:
        from torch._C._dynamo.eval_frame import _FrameAction, _FrameExecStrategy, set_code_exec_strategy
    except ImportError:
        return torch.compiler.disable(function)
    set_code_exec_strategy(function.__code__, _FrameExecStrategy(_FrameAction.SKIP, _FrameAction.SKIP))
    function._torchdynamo_disable = True  # type: ignore[attr-defined]
    return function


@_left_alone
def render(
    scene: Scene,
    parameters: Mapping[str, torch.Tensor],
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    spp_grad: int | None = None,
    seed: int = 0,
) -> torch.Tensor:
    """Render an image that is differentiable with respect to tensors.

    Args:
        scene: A loaded scene; it keeps the tensors' values.
        parameters: Tensors by parameter name, in the parameters' NumPy shapes, for instance (N, 3) for positions, up to
            axes of length one. Those that require a gradient get one. They are not kept within their bounds, as
            ``psdr.optim`` keeps them. Far from the origin float64 keeps the digits of places.
        sensor: Which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        integrator: As of ``psdr.render``; default: what the scene file names, else ``PathIntegrator()``.
        spp: Samples a pixel; default: the sensor's sample count.
        spp_grad: Samples a pixel of the backward pass; default: ``spp``.
        seed: Equal seeds give equal bits; the backward pass is decorrelated from the image.

    Returns:
        Radiance, shape (H, W, 3), or (B, H, W, 3) of a list of sensors, float32, on the device of the first tensor
        (the CPU without any).

    Raises:
        KeyError: There is no such parameter.
        TypeError: No mapping, or a value is no floating-point tensor.
        ValueError: A wrong shape, numbers that are not finite, an option out of range, a pose beside the vertices that
            it moves, or a moving discontinuity that the method of the boundary term does not cover.
    """
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters: got {type(parameters).__name__}, expected tensors by name")
    for name, tensor in parameters.items():
        parameter_of(scene, name)
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
            raise TypeError(f"{name!r}: got {type(tensor).__name__}, expected a floating-point tensor")
    check_independent(scene, parameters)
    wanted = tuple(tensor.requires_grad and torch.is_grad_enabled() for tensor in parameters.values())
    call = _Call(scene, tuple(parameters), wanted, sensor, integrator, spp, spp_grad, seed)
    return _Render.apply(call, *parameters.values())


@dataclass(frozen=True)
class _Call:
    """What is rendered, besides the tensors; ``wanted``: which of them need a gradient."""

    scene: Scene
    names: tuple[str, ...]
    wanted: tuple[bool, ...]
    sensor: Sensor
    integrator: Integrator | None
    spp: int | None
    spp_grad: int | None
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        return {"sensor": self.sensor, "integrator": self.integrator}

    @property
    def gradient_spp(self) -> int | None:
        return self.spp_grad if self.spp_grad is not None else self.spp

    def parameters(self) -> Parameters:
        """Return the scene's parameters, with those requested that need a gradient."""
        params = traverse(self.scene)
        params.requires_grad(*(name for name, wanted in zip(self.names, self.wanted, strict=True) if wanted))
        return params

    def assign(self, tensors: tuple[torch.Tensor, ...]) -> None:
        """Make the scene hold the tensors' values."""
        params = traverse(self.scene)
        for name, tensor in zip(self.names, tensors, strict=True):
            self.scene.bindings.refuse(name)
            value = _numpy(tensor)
            if self.scene.place(name, params.check(name, value, "value", value.dtype.type)):
                self.scene.pending.add(name)  # checksums of world coordinates do not tell all in far scenes
        self.scene.settle()


class _Render(torch.autograd.Function):
    """The image as an operation of PyTorch's graph."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: torch.Tensor) -> torch.Tensor:
        call.assign(tensors)
        if any(call.wanted):
            # What cannot be differentiated is refused here, and not only by backward().
            for number in call.scene.description.views(call.sensor).sensors:
                decide(call.scene, call.parameters(), integrator=call.integrator, sensor=number)
            ctx.state = call.scene.state()
        image = render_image(call.scene, spp=call.spp, spp_grad=call.spp_grad, seed=call.seed, **call.options)
        ctx.call = call
        ctx.like = [(tensor.shape, tensor.dtype, tensor.device) for tensor in tensors]
        return _tensor(image).to(tensors[0].device if tensors else "cpu")

    @staticmethod
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "psdr.torch.render has no second derivatives: leave create_graph out; for products with the Jacobian "
                "use torch.autograd.forward_ad"
            )
        call: _Call = ctx.call
        params = call.parameters()
        with held_at(call.scene, ctx.state):  # another render may have changed the scene since
            given = _adjoint(adjoint, call.scene.device)
            render_backward(call.scene, params, given, spp=call.gradient_spp, seed=call.seed, **call.options)
            gradients = [
                _tensor(params[name].grad).to(dtype=dtype, device=device).reshape(shape) if wanted else None
                for name, wanted, (shape, dtype, device) in zip(call.names, call.wanted, ctx.like, strict=True)
            ]
        return (None, *gradients)

    @staticmethod
    def jvp(ctx: Any, _call: None, *tangents: torch.Tensor | None) -> torch.Tensor:
        call: _Call = ctx.call
        given = {name: _numpy(t) for name, t in zip(call.names, tangents, strict=True) if t is not None}
        params = traverse(call.scene)
        image = render_forward(call.scene, params, given, spp=call.gradient_spp, seed=call.seed, **call.options)
        return _tensor(image).to(ctx.like[0][2])


def _tensor(array: wp.array) -> torch.Tensor:
    """Return an array's memory as a tensor, on the array's device; nobody else holds the array."""
    device = wp.get_device(array.device)
    if device.is_cuda:
        wp.synchronize_device(device)  # PyTorch's streams are others
    return wp.to_torch(array, requires_grad=False)


def _adjoint(tensor: torch.Tensor, device: wp.Device) -> Any:
    """Return the adjoint of an image as an array of vec3 on the scene's device."""
    values = tensor.detach().to(device=wp.device_to_torch(device), dtype=torch.float32).contiguous()
    if values.is_cuda:
        torch.cuda.synchronize(values.device)
    return wp.from_torch(values, dtype=wp.vec3, requires_grad=False)


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    """Return a tensor's values: float64 if it holds that, else float32."""
    values = tensor.detach().cpu()
    return np.ascontiguousarray((values if values.dtype == torch.float64 else values.float()).numpy())
