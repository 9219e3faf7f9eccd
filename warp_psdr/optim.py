"""Optimisers that keep every parameter inside its valid range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.kernels import adam as kernels
from warp_psdr.scene.kinds.sdfgrid import SdfGrid
from warp_psdr.scene.layout import POSITIONS, SHAPE_GRID
from warp_psdr.scene.parameters import check_independent

if TYPE_CHECKING:
    from warp_psdr.topology.laplacian import GridSmoother, Smoother

__all__ = ["Adam", "LargeSteps"]

#: Weight of the Laplacian where none is given: that of [NJJ21], alpha = 0.95.
LAMBDA = 19.0


class Adam:
    """Adam [KB15] with projection onto the valid range of every parameter.

    Values change in place, on their device. A step reads the gradients, writes the values, tells the scene about them
    (``params.update``) and sets the gradients back to zero.

    Args:
        params: Parameters of a scene, from ``psdr.traverse``; those to optimise had ``params.requires_grad(name)``.
        lr: Learning rate, the same for every parameter that requires a gradient, or one per name. Roughly the largest
            change of an entry in one step, in the parameter's own unit.
        betas: Decay rates of the running means of the gradient and of its square, in [0, 1).
        epsilon: Added to the root of the mean square; in units of the gradient.
        mask_updates: Leave the entries alone whose gradient is exactly zero in a step, value and running means: for
            textures and environment maps of which one view sees but a part.

    Raises:
        TypeError: If a learning rate is no number.
        ValueError: If a name is unknown or requires no gradient, a number is out of range, or values and what follows
            them are given: a pose and its vertices, positions and their computed normals.
    """

    def __init__(
        self,
        params: Any,
        lr: float | Mapping[str, float],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
        mask_updates: bool = False,
    ):
        if isinstance(lr, Mapping):
            rates = {name: _number(f"lr of {name!r}", rate) for name, rate in lr.items()}
        else:
            rate = _number("lr", lr)
            rates = {name: rate for name in params if params[name].grad is not None}
        if not rates:
            raise ValueError("no parameter to optimise; call params.requires_grad(name, ...) or give lr as a dict")
        for name, rate in rates.items():
            if name not in params:
                raise ValueError(f"lr: the scene has no parameter {name!r}; print(params) lists them")
            if params[name].grad is None:
                raise ValueError(f"lr: {name!r} requires no gradient; call params.requires_grad({name!r}) first")
            if not (math.isfinite(rate) and rate > 0.0):
                raise ValueError(f"lr of {name!r}: got {rate}, expected a positive number")
        check_independent(params.scene, rates)
        if len(betas) != 2:
            raise ValueError(f"betas: got {betas!r}, expected two numbers in [0, 1)")
        for index, beta in enumerate(betas):
            if not 0.0 <= beta < 1.0:
                raise ValueError(f"betas[{index}]: got {beta}, expected a number in [0, 1)")
        if not (math.isfinite(epsilon) and epsilon > 0.0):
            raise ValueError(f"epsilon: got {epsilon}, expected a positive number")
        self.lr = rates
        self.steps = 0
        self._params = params
        self._betas = (float(betas[0]), float(betas[1]))
        self._epsilon = float(epsilon)
        self._mask_updates = bool(mask_updates)
        self._moments: dict[str, tuple[wp.array, wp.array]] = {}
        for name in rates:
            values = flat(params[name])
            self._moments[name] = (wp.zeros_like(values), wp.zeros_like(values))

    def step(self, *, scale: float = 1.0) -> None:
        """Make one step, project, update the scene and zero the gradients.

        Args:
            scale: Factor on every learning rate, for schedules; not negative.

        Raises:
            ValueError: If a gradient, or its square, is not finite, or ``scale`` is out of range; then no parameter has
                changed.
        """
        if not 0.0 <= scale < math.inf:
            raise ValueError(f"scale: got {scale!r}, expected a finite number that is not negative")
        self._require_usable_gradients()
        self.steps += 1
        for name, rate in self.lr.items():
            self._advance(name, rate * scale)
        self._params.update(*self.lr)
        self._params.zero_grad()

    def _advance(self, name: str, rate: float) -> None:
        """Move one parameter; ``steps`` already counts this step."""
        parameter = self._params[name]
        low, high = self._params.bounds(name)
        values, gradient = flat(parameter), flat(parameter.grad)
        m, v = self._moments[name]
        beta_1, beta_2 = self._betas
        kernel = kernels.make_adam(self._mask_updates)
        compiler.ensure([kernel], values.device)
        wp.launch(
            kernel,
            dim=values.shape,
            inputs=[
                gradient,
                rate,
                beta_1,
                beta_2,
                1.0 - beta_1**self.steps,
                1.0 - beta_2**self.steps,
                self._epsilon,
                low,
                high,
            ],
            outputs=[m, v, values],
            device=values.device,
        )

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return all that a later ``load_state_dict`` needs to continue with equal bits.

        Returns:
            ``"steps"``, a whole number of shape ``()``, and per parameter ``"<name>/m"`` and ``"<name>/v"``, its
            running means, flattened, float32.
        """
        state = {"steps": np.array(self.steps, dtype=np.int64)}
        for name, (m, v) in self._moments.items():
            state[f"{name}/m"] = m.numpy().copy()
            state[f"{name}/v"] = v.numpy().copy()
        return state

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over what ``state_dict`` returned.

        Raises:
            ValueError: If the state belongs to other parameters or is not valid; then nothing has changed.
        """
        expected = {"steps", *(f"{name}/{moment}" for name in self._moments for moment in "mv")}
        if set(state) != expected:
            differing = sorted(set(state) ^ expected)
            raise ValueError(f"optimiser state: got other parameters than expected; they differ in {differing}")
        steps = np.asarray(state["steps"])
        if steps.shape != () or steps.dtype.kind not in "iu" or steps < 0:
            raise ValueError(f"optimiser state: steps is {steps!r}, expected a whole number >= 0")
        for name, moments in self._moments.items():
            for key, moment in zip((f"{name}/m", f"{name}/v"), moments, strict=True):
                values = np.asarray(state[key])
                if values.shape != moment.shape or values.dtype != np.float32 or not np.isfinite(values).all():
                    raise ValueError(
                        f"optimiser state: {key!r} has shape {values.shape} and dtype {values.dtype}, "
                        f"expected finite float32 values of shape {moment.shape}"
                    )
        for name, moments in self._moments.items():
            for key, moment in zip((f"{name}/m", f"{name}/v"), moments, strict=True):
                moment.assign(np.ascontiguousarray(state[key]))
        self.steps = int(steps)

    def _require_usable_gradients(self) -> None:
        """Check all gradients before any value changes: one small read-back for all parameters."""
        device = next(iter(self._moments.values()))[0].device
        counts = wp.zeros(len(self.lr), dtype=wp.int32, device=device)
        for index, name in enumerate(self.lr):
            if self._params[name].grad is None:
                raise ValueError(f"{name!r} requires no gradient any more; name it in params.requires_grad(...), too")
            gradient = flat(self._params[name].grad)
            compiler.ensure([kernels.make_count_unusable(), kernels.make_adam(self._mask_updates)], device)
            wp.launch(
                kernels.make_count_unusable(),
                dim=gradient.shape,
                inputs=[gradient, index],
                outputs=[counts],
                device=device,
            )
        for name, count in zip(self.lr, counts.numpy(), strict=True):
            if count:
                size = flat(self._params[name]).size
                raise ValueError(
                    f"gradient of {name!r}: {count} of {size} entries are not finite, or square to infinity, at step "
                    f"{self.steps + 1}; the parameters are unchanged. A smaller learning rate, or a look at the scene "
                    "at this step, helps to find out why"
                )


class LargeSteps(Adam):
    """Positions and grids in the preconditioned space of [NJJ21], with AdamUniform; all other parameters with Adam.

    Positions v are written as v = (I + lambda L)^-1 u, L the combinatorial Laplacian of the mesh on position-welded
    vertices (``warp_psdr/topology/laplacian.py``), and u is optimised: its gradient is (I + lambda L)^-1 dv, v's
    smoothed, and a step of u moves v by the smoothed step. So a gradient that lives on a silhouette moves the surface
    around it too, and triangles keep their shape. AdamUniform divides by one number a mesh, the largest root mean
    square of an entry, so that a direction is not bent. Since v is linear in u, u is never stored: v moves by (I +
    lambda L)^-1 du, and what else edits v between two steps is kept.

    The matrix is factorised once, in double precision, from the positions that the scene was loaded with. The ``grid``
    of an ``sdfgrid`` is smoothed likewise, L the Laplacian of its nodes: what light says about the few voxels that the
    surface passes moves the distances around them, too, and what one step adds is band-limited.

    ``state_dict`` and ``load_state_dict`` are those of ``Adam``.

    Args:
        params: Parameters of a scene, from ``psdr.traverse``; those to optimise had ``params.requires_grad(name)``.
        lr: Learning rate, the same for every parameter that requires a gradient, or one per name. For positions roughly
            the largest move of a vertex in one step, in world units, where neighbours move alike; for grids in their
            own unit.
        lambda_: Weight of the Laplacian, > 0; larger is smoother: the step spreads over some sqrt(lambda) edges.
            Default 19.
        alpha: The same in (0, 1): lambda = alpha / (1 - alpha). Give one of the two.
        fixed: Vertices that do not move, for names of vertex positions: a mask of shape (N,).
        betas: Decay rates of the running means of the gradient and of its square, in [0, 1).
        epsilon: Added to the root of the mean square; in units of the gradient.
        mask_updates: As in ``Adam``, for the other parameters; positions of a mesh move together.

    Raises:
        ValueError: If a name is unknown or requires no gradient, neither vertex positions nor grids are among the
            names, a number is out of range, or ``fixed`` does not fit.
    """

    def __init__(
        self,
        params: Any,
        lr: float | Mapping[str, float],
        *,
        lambda_: float | None = None,
        alpha: float | None = None,
        fixed: Mapping[str, np.ndarray] | None = None,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-8,
        mask_updates: bool = False,
    ):
        from warp_psdr.topology.laplacian import GridSmoother, Smoother

        super().__init__(params, lr, betas=betas, epsilon=epsilon, mask_updates=mask_updates)
        self.lambda_ = _laplacian_weight(lambda_, alpha)
        scene = params.scene
        found = {n: scene.parameters[n] for n in self.lr}
        owners = {n: p.owner for n, p in found.items() if POSITIONS in p.uses}
        shapes = scene.description.shapes
        own = {n: p for n, p in found.items() if SHAPE_GRID in p.uses}
        grids = {n: p.shape for n, p in own.items() if isinstance(shapes[p.owner].geometry, SdfGrid)}
        if not owners and not grids:
            raise ValueError(
                f"LargeSteps: none of {list(self.lr)} are vertex positions or a grid, which it is for; use "
                "psdr.optim.Adam"
            )
        fixed = dict(fixed or {})
        for name in fixed:
            if name not in owners:
                raise ValueError(f"fixed: {name!r} is none of the optimised vertex positions {list(owners)}")
        self._smoothers: dict[str, Smoother | GridSmoother] = {
            n: GridSmoother(tuple(shape[:3]), self.lambda_) for n, shape in grids.items()
        }
        for name, owner in owners.items():
            # What was loaded, not what is there now: an optimiser that resumes must weld the same vertices.
            shape = scene.description.shapes[owner]
            mask = fixed.get(name)
            if mask is not None:
                mask = np.asarray(mask)
                if mask.dtype != bool or mask.shape != (len(shape.vertices),):
                    raise ValueError(
                        f"fixed: got {mask.dtype} values of shape {mask.shape} for {name!r}; expected a mask (bool) of "
                        f"shape ({len(shape.vertices)},)"
                    )
            try:
                self._smoothers[name] = Smoother(shape.vertices, shape.faces, self.lambda_, mask)
            except ValueError as error:
                raise ValueError(f"LargeSteps: {name!r}: {error}") from None

    def _advance(self, name: str, rate: float) -> None:
        if name not in self._smoothers:
            super()._advance(name, rate)
            return
        smoother, parameter = self._smoothers[name], self._params[name]
        beta_1, beta_2 = self._betas
        gradient = smoother.scatter(smoother.solve(smoother.gather(parameter.grad.numpy())))
        # The moments are rounded to float32 as they are stored, so that a resumed run has equal bits.
        m, v = (moment.numpy().reshape(gradient.shape) for moment in self._moments[name])
        m = (beta_1 * m + (1.0 - beta_1) * gradient).astype(np.float32)
        v = (beta_2 * v + (1.0 - beta_2) * gradient**2).astype(np.float32)
        for moment, values in zip(self._moments[name], (m, v), strict=True):
            moment.assign(values.reshape(-1))
        largest = float(v.max()) / (1.0 - beta_2**self.steps)
        size = rate / (1.0 - beta_1**self.steps) / (math.sqrt(largest) + self._epsilon)
        nodes = smoother.gather(m.astype(np.float64)) / smoother.copies[:, None]
        move = smoother.scatter(smoother.solve(size * nodes))
        before = parameter.numpy()
        parameter.assign((before - move.reshape(before.shape)).astype(np.float32))


def _laplacian_weight(lambda_: float | None, alpha: float | None) -> float:
    if lambda_ is not None and alpha is not None:
        raise ValueError(f"got lambda_={lambda_} and alpha={alpha}, which say the same; give one of them")
    if alpha is not None:
        if not 0.0 < alpha < 1.0:
            raise ValueError(f"alpha: got {alpha}, expected a number in (0, 1)")
        return alpha / (1.0 - alpha)
    weight = LAMBDA if lambda_ is None else float(lambda_)
    if not (math.isfinite(weight) and weight > 0.0):
        raise ValueError(f"lambda_: got {lambda_}, expected a positive number; psdr.optim.Adam has no smoothing")
    return weight


def _number(name: str, value: Any) -> float:
    """Return a number as one; a text is none, even if it reads like one."""
    if isinstance(value, str | bytes | bool) or not hasattr(value, "__float__"):
        raise TypeError(f"{name}: got {value!r}, expected a number, or a dict of one for each parameter")
    return float(value)


def flat(array: wp.array) -> wp.array:
    """Return the float32 numbers of a contiguous array of floats, vectors or matrices, shape ``(n,)``, without a copy.

    Raises:
        TypeError: If the array is not contiguous or holds anything else.
    """
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)  # of a vector or matrix, else the type itself
    if scalar is not wp.float32 or not array.is_contiguous:
        raise TypeError(
            f"got an array of {array.dtype.__name__}, shape {array.shape}; expected contiguous float32 values"
        )
    count = array.size * wp.types.type_size_in_bytes(array.dtype) // wp.types.type_size_in_bytes(wp.float32)
    # The view does not own its memory; ``array`` does, and the caller holds it.
    return wp.array(ptr=array.ptr, dtype=wp.float32, shape=(count,), device=array.device, copy=False)
