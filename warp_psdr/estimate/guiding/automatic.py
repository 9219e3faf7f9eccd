"""Automatic guiding: ``boundary="auto"`` guides repeated gradients if a pilot finds that it pays.

The first gradients of a request are not guided, because the structure would cost more than it saves, and the kernels of
a pilot take as long to compile as many gradients of a small scene. Once the gradients have cost as much as these
kernels, and a pilot and a structure cost no more than a few times what was spent, both are made. The pilot draws
batches of the guided terms (``BoundaryTerm.guided``: shadow edges and other silhouettes) with and without guiding, and
of all other terms. It compares the variance of the gradient or derivative image times its cost. Costs are counted in
samples, never timed, and kernels count whether or not the cache has them, so that equal calls in equal order give equal
bits. A call that was not guided is not guided when it is repeated with the same seed and values.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.estimate.boundary.drivers import launch_backward, launch_forward
from warp_psdr.estimate.boundary.terms import TERMS, Request, launches
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.passes import STREAM_BOUNDARY, interior_backward, interior_forward
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.guiding import KdTree
from warp_psdr.plan.guiding import Automatic, automatic
from warp_psdr.plan.motion import motion
from warp_psdr.scene.edits import checksum

if TYPE_CHECKING:
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: Batches of the pilot, with and without guiding each.
BATCHES = 8
#: What pilot and structure may cost, over what was spent on the request before.
AFFORDED = 3.0
#: What it takes to compile a kernel, and a call's part that does not grow with its samples, in samples of a gradient
#: with all terms. Measured on the CPU: 4 to 5 processor seconds, .01 s and 1.4 to 3.8 microseconds. On CUDA, from
#: recorded numbers (``docs/data/devices.jsonl``): 7 s, .02 s and .09 microseconds.
KERNEL_COST = {"cpu": 1 << 21, "cuda": 1 << 26}
CALL_COST = {"cpu": 1 << 12, "cuda": 1 << 18}
#: Kernels of a guided term: its integrand, and its guided form; of edges also the one that tells which face the lights.
KERNELS, KERNELS_OF_EDGES = 2, 3
#: Evaluations of the integrand that a leaf costs while a structure is built, about.
LEAF_COST = 24
#: Leaves: fewer follow no integrand, and more than ``guiding.KdTree`` has pay off rarely.
FEWEST_LEAVES, MOST_LEAVES = 128, 16384
#: Cost of a guided sample over that of another one: it meets light more often, so more of its paths are traced to their
#: end. Measured: 1.9 to 2.6 in processor time.
GUIDED_COST = 2.5
#: Samples of the interior and of the other terms, over those of the shadow edges, about.
REST_COST = 2.0
#: Least variance saved for the cost that pays: batches tell it with noise.
PAYS = 1.5
#: Stream of the pilot's random numbers, beside those of the terms.
PILOT = 0x70696C6F
#: Calls whose random numbers are remembered.
REMEMBERED = 4096


def choose(
    scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int, given: wp.array
) -> Plan:
    """Return the plan of a gradient whose boundary method was left to the plan: guided, or not.

    Args:
        scene: the scene.
        plan: of the gradient.
        names: what is differentiated.
        role: "reverse" or "forward".
        sensor: which camera.
        spp: samples a pixel.
        seed: of the call.
        given: the adjoint, (H, W) of vec3, or the flat tangents.
    """
    found = automatic(scene, motion(scene, names), sensor, plan.max_depth)
    if not found.on or not isinstance(plan.boundary, PathSpace) or plan.times is not None:
        return plan
    call = (seed, checksum(scene.values))
    plain = replace(plan, boundary=PathSpace())
    if call in found.plain:
        return plain
    if not found.decided and found.spent:
        with compiler.because("to try guiding for this repeated gradient"):
            _decide(found, scene, plain, names, role, sensor, spp, seed, given)
    if found.method is not None:
        return replace(plan, boundary=PathSpace(guiding=found.method))
    if len(found.plain) < REMEMBERED:
        found.plain.add(call)
    request = Request(scene, plain, motion(scene, names), role, sensor, spp, seed)
    found.spent += (1.0 + REST_COST) * request.pixels * spp
    found.paid += request.pixels * spp + CALL_COST[_kind(scene)]
    return plain


def follow(scene: Scene, plan: Plan, names: list[str], sensor: int, seed: int) -> Plan:
    """Return the plan that ``choose`` gave a call that was made before."""
    found = automatic(scene, motion(scene, names), sensor, plan.max_depth)
    plain = (seed, checksum(scene.values)) in found.plain
    return replace(plan, boundary=PathSpace()) if plain else plan


def _decide(
    found: Automatic,
    scene: Scene,
    plan: Plan,
    names: list[str],
    role: str,
    sensor: int,
    spp: int,
    seed: int,
    given: wp.array,
) -> None:
    """Run the pilot, as soon as it is affordable, and keep what it says."""
    if not _has_paid(found, scene, plan, names, role, sensor, spp, seed):
        return
    camera = scene.camera(sensor)
    batch = max(spp // BATCHES, 1)
    shadows = BATCHES * batch * camera.crop_width * camera.crop_height
    rest = AFFORDED * found.spent - (1.0 + GUIDED_COST + REST_COST) * shadows
    leaves = min(int(rest / LEAF_COST), MOST_LEAVES)
    if leaves < FEWEST_LEAVES:
        return
    method = KdTree(max_leaves=1 << (leaves.bit_length() - 1))  # few sizes
    guided = replace(plan, boundary=PathSpace(guiding=method))
    sizes = [scene.parameters[n].size for n in names] if role == "reverse" else []
    variances, costs = [], []
    for part, shadow in ((plan, True), (guided, True), (plan, False)):
        drawn, samples = [], 0
        for number in range(BATCHES):
            at = mix_seed(mix_seed(seed, PILOT), number)
            values, samples = _batch(scene, part, names, role, sensor, batch, at, given, shadow)
            drawn.append(values)
        variances.append(_variances(drawn, sizes))
        costs.append(samples * (GUIDED_COST if part is guided else 1.0))
    found.decided = True
    if not costs[0]:
        found.said = "no shadow edge moves"
        return
    plain, other, common = (np.array(v) for v in variances)
    told = (plain + common > 0.0) & (other + common > 0.0)
    less = float(np.exp(np.log((plain + common)[told] / (other + common)[told]).mean())) if told.any() else 1.0
    cost = (costs[1] + costs[2]) / (costs[0] + costs[2])
    found.said = f"pilot: the variance is {less:.3g} times less at {cost:.3g} times the cost"
    if less > PAYS * cost:
        found.method = method


def _has_paid(
    found: Automatic, scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int
) -> bool:
    """Return whether gradients have cost as much as the kernels of a pilot, or else say how much of it."""
    if found.kernels < 0:
        request = Request(scene, plan, motion(scene, names), role, sensor, spp, seed)
        guided = [term.name for term in TERMS[PathSpace] if term.guided and launches(term, request)]
        found.kernels = sum(KERNELS_OF_EDGES if name == store.EDGES else KERNELS for name in guided)
    share = found.paid / max(found.kernels * KERNEL_COST[_kind(scene)], 1)
    if share < 1.0:
        cost = f"what compiling a pilot's {found.kernels} kernels does ({share:.0%} so far)"
        found.said = f"once gradients have cost {cost}, if it says that it pays"
    return share >= 1.0


def _kind(scene: Scene) -> str:
    return "cpu" if scene.device.is_cpu else "cuda"


def _batch(
    scene: Scene,
    plan: Plan,
    names: list[str],
    role: str,
    sensor: int,
    spp: int,
    seed: int,
    given: wp.array,
    shadow: bool,
) -> tuple[np.ndarray, int]:
    """Return what a batch adds to the gradient, or to the image, and how many samples it has.

    ``shadow``: of the terms that are guided alone; otherwise of the interior and of all other terms.
    """
    request = Request(scene, plan, motion(scene, names), role, sensor, spp, mix_seed(seed, STREAM_BOUNDARY))
    terms = [t for term in TERMS[PathSpace] if term.guided == shadow for t in launches(term, request)]
    samples = sum(term.samples for term in terms)
    if not shadow:
        samples += request.pixels * spp
    if role == "forward":
        shape = (request.camera.crop_height, request.camera.crop_width)
        image = launch_forward(scene, terms, given, shape)
        if not shadow:
            interior_forward(scene, plan, sensor, Draw(spp), seed, given, image)
        return image.numpy().astype(np.float64).reshape(-1), samples
    sums = GradientSums(scene, names)
    if not shadow:
        interior_backward(scene, plan, sensor, Draw(spp), seed, given, sums)
    launch_backward(scene, terms, given, sums)
    flat = sums.result().numpy().astype(np.float64)
    parameters = [scene.parameters[n] for n in names]
    return np.concatenate([flat[p.offset : p.offset + p.size] for p in parameters]), samples


def _variances(batches: list[np.ndarray], sizes: list[int]) -> list[float]:
    """Return the variance of every parameter, summed over its numbers; of an image over all of it."""
    variance = np.var(np.stack(batches), axis=0, ddof=1)
    return [float(part.sum()) for part in np.split(variance, np.cumsum(sizes[:-1]))]
