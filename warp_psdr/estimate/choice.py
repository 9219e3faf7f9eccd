"""The pilot of ``interior="auto"``: compares variance times cost of the methods that could serve a request.

A pilot compiles the kernels of the methods it compares, which takes as long as many gradients of a small scene. It
therefore waits until a request has spent ``SPENT`` samples. Every method then draws ``ROUNDS`` times ``BATCHES``
batches of some pixels with equal random numbers. Launches on the CPU keep sums of blocks of pixels apart, whose
variances add up. Costs are fixed factors, never timed, so that equal calls in equal order choose alike, with any number
of workers. A call that was replayed is replayed again when it is repeated with the same seed and values.

Derivation: ``docs/theory/interior.md#which-method``.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import compiler, workers
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.estimate.passes import camera_gradient_kernels, interior_backward, interior_forward
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.interior import Branches
from warp_psdr.plan import choice
from warp_psdr.plan.choice import Choice
from warp_psdr.scene.edits import checksum

if TYPE_CHECKING:
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: Samples of a request's gradients after which there is a pilot.
SPENT = 1 << 21
#: Samples a pixel of a batch, pixels at most, and batches; of one that keeps no sums apart, so many more.
SPP, PIXELS, BATCHES, WHOLE = 2, 1024, 8, 8
#: Numbers whose variances tell enough without sums apart.
MANY = 4096
#: Least gain that pays: it is told with a noise of some ten percent.
PAYS = 1.1
#: Rounds of batches, and how many of their standard errors are added to the variance of what may take replay's place:
#: rare large samples are missed by most rounds.
ROUNDS, DOUBT = 4, 2.0
#: Stream of the pilot's random numbers.
PILOT = 0x63686F69
#: Calls whose random numbers are remembered.
REMEMBERED = 4096


def choose(
    scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int, given: wp.array | None
) -> Plan:
    """Return the plan of a gradient whose method of the interior is left to the plan.

    Args:
        scene: the scene.
        plan: of the gradient.
        names: what is differentiated.
        role: "reverse" or "forward".
        sensor: which camera.
        spp: samples a pixel.
        seed: of the call.
        given: the adjoint, (H, W) of vec3, or the flat tangents; None: the caller knows that no pilot is due.
    """
    if not plan.offered:
        return plan
    found = choice.known(scene, names, plan.max_depth)
    # Values are read back only while calls are remembered, and where the seed is that of such a one.
    if found.decided and all(seed != used for used, _values in found.plain):
        return choice.by(plan, found.method)
    call = (seed, checksum(scene.values))
    if call in found.plain:
        return choice.by(plan, None)
    if due(scene, plan, names):
        assert given is not None
        decide(found, scene, plan, names, role, sensor, seed, given)
    if found.method is not None:
        return choice.by(plan, found.method)
    if not found.decided:
        camera = scene.camera(sensor)
        found.spent += float(spp) * camera.crop_width * camera.crop_height
        if len(found.plain) < REMEMBERED:
            found.plain.add(call)
    return choice.by(plan, None)


def taken(scene: Scene, plan: Plan, names: list[str]) -> Branches | None:
    """Return the method that a pilot chose for a plan that ``choose`` returned; None: the plan has its own."""
    if not plan.offered:
        return None
    method = choice.known(scene, names, plan.max_depth).method
    return method if method is not None and plan == choice.by(plan, method) else None


def due(scene: Scene, plan: Plan, names: list[str]) -> bool:
    """Return whether ``choose`` would run a pilot now, which needs what it is given."""
    if not plan.offered:
        return False
    found = choice.known(scene, names, plan.max_depth)
    return not found.decided and found.spent >= SPENT


def decide(
    found: Choice, scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, seed: int, given: wp.array
) -> None:
    """Run the pilot and keep what it says."""
    assert plan.wanted is not None
    methods = choice.candidates(plan)
    plans = [choice.by(plan, method) for method in (None, *(method for _kind, method in methods))]
    with compiler.because("to compare methods for this repeated gradient"):
        compiler.begin([k for p in plans for k in camera_gradient_kernels(p, role)], scene.device)
        # (rounds, plans, parameters)
        rounds = np.array(
            [
                [variance(scene, p, names, role, sensor, mix_seed(mix_seed(seed, PILOT), r), given) for p in plans]
                for r in range(ROUNDS)
            ]
        )
    variances = rounds.mean(axis=0)
    variances[1:] += DOUBT * rounds[:, 1:].std(axis=0, ddof=1) / np.sqrt(ROUNDS)
    found.decided = True
    told = (variances > 0.0).all(axis=0)
    if not told.any():
        return
    gains = np.log(variances[0, told] / variances[1:, told]).mean(axis=-1)
    # Each kind draws for parameters of its own: side by side their gains multiply.
    kinds = {kind: [i for i, (k, _method) in enumerate(methods) if k == kind] for kind, _method in methods}
    worths: list[tuple[float, Branches | None]] = [(float(np.log(PAYS)), None)]
    for some in product(*([None, *rows] for rows in kinds.values())):
        taken = [i for i in some if i is not None]
        if taken:
            method = choice.both(tuple(methods[i][1] for i in taken))
            cost = choice.cost_of(method, plan.config, plan.wanted)
            worths.append((float(sum(gains[i] for i in taken) - np.log(cost)), method))
    found.method = max(worths, key=lambda worth: worth[0])[1]
    for kind, rows in kinds.items():
        costs = {i: choice.cost_of(methods[i][1], plan.config, plan.wanted) for i in rows}
        i = max(rows, key=lambda i: gains[i] - np.log(costs[i]))
        found.gains[kind], found.costs[kind] = float(np.exp(gains[i])), costs[i]


def variance(
    scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, seed: int, given: wp.array
) -> list[float]:
    """Return the variance of the gradient by every parameter, summed over its numbers; of an image over all of it."""
    camera = scene.camera(sensor)
    order = workers.pixel_order(camera.crop_width, camera.crop_height)
    if role == "reverse":
        order = order[given.numpy().reshape(-1, 3).any(axis=-1)[order]]
    step = max(len(order) // PIXELS, 1)
    pixels = wp.array(order[step // 2 :: step][:PIXELS], dtype=wp.int32, device=scene.device)
    batches = BATCHES if scene.device.is_cpu or role == "forward" else WHOLE * BATCHES
    draw = _image if role == "forward" else _sums
    total = squares = np.zeros(())
    for number in range(batches):
        values = draw(scene, plan, names, sensor, mix_seed(seed, number), given, pixels)
        total, squares = total + values, squares + values * values
    found = np.maximum(squares - total * total / batches, 0.0) / (batches - 1)
    if role == "forward":
        return [float(found.sum())]
    ends = np.cumsum([scene.parameters[name].size for name in names])[:-1]
    return [float(part.sum()) for part in np.split(found, ends, axis=1)]


def _image(scene: Scene, plan: Plan, _names, sensor: int, seed: int, given: wp.array, pixels: wp.array) -> np.ndarray:
    camera = scene.camera(sensor)
    image = wp.zeros((camera.crop_height, camera.crop_width), dtype=wp.vec3, device=scene.device)
    interior_forward(scene, plan, sensor, Draw(SPP), seed, given, image, pixels=pixels)
    return image.numpy().astype(np.float64).reshape(-1)


def _sums(
    scene: Scene, plan: Plan, names: list[str], sensor: int, seed: int, given: wp.array, pixels: wp.array
) -> np.ndarray:
    """Return what a batch adds to the gradient, (blocks of pixels, numbers); of many numbers in one block."""
    sums = GradientSums(scene, names)
    interior_backward(scene, plan, sensor, Draw(SPP), seed, given, sums, pixels=pixels)
    parameters = [scene.parameters[name] for name in names]
    many = sum(p.size for p in parameters) > MANY
    rows = [sums.result(shard).numpy() for shard in ((None,) if many else range(sums.shards))]
    return np.stack([np.concatenate([row[p.offset : p.offset + p.size] for p in parameters]) for row in rows]).astype(
        np.float64
    )
