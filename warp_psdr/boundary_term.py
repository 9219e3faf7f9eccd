"""Drivers of the boundary term: what moves, what is refused, and the launches over samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr import workers
from warp_psdr.boundary import Method, PathSpace
from warp_psdr.device import launch
from warp_psdr.edges import all_edges, bent_faces, primary_edges, secondary_edges, terminator_faces
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.pierced import make_pierced_kernel
from warp_psdr.kernels.boundary.primary import make_primary_kernel
from warp_psdr.kernels.boundary.secondary import make_secondary_kernel
from warp_psdr.kernels.boundary.terminator import make_terminator_kernel
from warp_psdr.kernels.emitter.spot import MIN_FALLOFF
from warp_psdr.kernels.reduction import add_images
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.scene.layout import CAMERA, LIGHT_POSE, POSITIONS, SHAPE_POSE, TEXCOORDS, TO_UV

if TYPE_CHECKING:
    from warp_psdr.kernels.path import PathConfig
    from warp_psdr.options import PathIntegrator
    from warp_psdr.scene.scene import Scene

#: Share of the segments whose direction is drawn from the wedge instead of towards a light. With direct light only,
#: what is not a light contributes nothing.
WEDGE_SHARE_DIRECT, WEDGE_SHARE = 0.1, 0.5
#: Sub-streams of the boundary term's random numbers.
PRIMARY, SECONDARY, TERMINATOR = 0, 1, 2
#: Images of forward mode's lanes together hold at most this many floats (64 MB).
LANE_IMAGE_FLOATS = 1 << 24
REMEDY = "say PathIntegrator(boundary=None) to get the interior term alone"


@dataclass(frozen=True)
class Motion:
    """What moves discontinuities.

    Attributes:
        shapes: numbers of the shapes whose vertices move.
        camera: the camera moves.
        light_pose: a point, spot or directional light moves or turns.
    """

    shapes: frozenset[int]
    camera: bool
    light_pose: bool


def motion(scene: Scene, names: list[str]) -> Motion:
    """Return what the named parameters move."""
    uses = [(scene.parameters[n].uses, scene.parameters[n].owner) for n in names]
    return Motion(
        shapes=frozenset(owner for use, owner in uses if use & {POSITIONS, SHAPE_POSE}),
        camera=any(CAMERA in use for use, _owner in uses),
        light_pose=any(LIGHT_POSE in use for use, _owner in uses),
    )


def choose(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str], moving: tuple) -> Method:
    """Return the method that estimates the boundary term of the named parameters.

    Args:
        scene: the scene.
        config: what its path loop compiles.
        integrator: names the method, or "auto".
        names: what is differentiated.
        moving: which discontinuities move, in words.

    Raises:
        ValueError: no method covers the case.
    """
    method = integrator.boundary if isinstance(integrator.boundary, Method) else PathSpace()
    reason = _uncovered(scene, config, names, integrator.max_depth)
    if reason:
        raise ValueError(
            f"the requested gradient has a boundary term ({'; '.join(moving)}), which boundary.PathSpace() cannot "
            f"estimate here: {reason}; {REMEDY}"
        )
    return method


def _uncovered(scene: Scene, config: PathConfig, names: list[str], max_depth: int) -> str:
    """Say why the boundary term cannot be estimated; empty: it can."""
    if {c.BSDF_CONDUCTOR, c.BSDF_DIELECTRIC} & set(config.bsdfs):
        return "discontinuities seen through smooth mirrors or glass are not implemented; use a roughconductor instead"
    if config.hide_emitters and config.area:
        return "hide_emitters makes area lights transparent to the camera, which is not implemented; show them"
    moves = motion(scene, names)
    steps = any(t.kind == c.TEXTURE_BITMAP and t.filter == c.FILTER_NEAREST for t in scene.builder.textures)
    if steps:
        return "a texture with filter_type 'nearest' jumps inside of triangles; use 'bilinear'"
    if any(scene.parameters[n].uses & {TO_UV, TEXCOORDS} for n in names) and any(
        t.kind == c.TEXTURE_FACE for t in scene.builder.textures
    ):
        return "a texture with steps slides; use a vertex attribute"
    values = scene.values.numpy()
    for e in scene.builder.emitters:
        if e.kind == c.EMITTER_SPOT:
            cutoff, beam = values[e.cutoff : e.cutoff + 2].tolist()
            if math.radians(cutoff - beam) <= MIN_FALLOFF:
                return "a spot light's cone has a hard edge; make beam_width smaller than cutoff_angle"
    if max_depth != 1 and max_depth != 2 and bent_faces(scene).any():
        return (
            "the curves along which interpolated normals turn away are covered as the camera sees them, not as other "
            "surfaces do; use max_depth=2, or face_normals=True on the meshes"
        )
    return _intersection(scene, moves)


def _intersection(scene: Scene, moves: Motion) -> str:
    """Name two surfaces that run through each other in a curve that moves, or is seen by a moving camera."""
    if not scene.face_count or not (moves.shapes or moves.camera):
        return ""
    edges, found = all_edges(scene)
    faces = wp.zeros(len(found.length), dtype=wp.int32, device=scene.device)
    kernel = make_pierced_kernel(scene.accelerator.backend, scene.accelerator.width)
    launch(kernel, dim=len(found.length), inputs=[scene.data(), edges], outputs=[faces], device=scene.device)
    shape_of = scene.builder.face_shape
    for edge, face in enumerate(faces.numpy()):
        if face >= 0:
            a, b = int(shape_of[found.faces[found.first[edge]]]), int(shape_of[face])
            if moves.camera or {a, b} & moves.shapes:
                paths = [scene.description.shapes[s].path for s in (a, b)]
                return (
                    f"shapes {paths[0]!r} and {paths[1]!r} run through each other, and curves of intersection are not "
                    "implemented; move them apart"
                )
    return ""


def backward(
    scene: Scene, plan, names: list[str], adjoint: wp.array, buffers: wp.array, *, sensor: int, spp: int, seed: int
) -> None:
    """Add the gradient of the boundary term to the lanes' flat buffers.

    Args:
        scene: the scene.
        plan: with the method in ``boundary``.
        names: what is differentiated.
        adjoint: (H, W) of vec3.
        buffers: (lanes, values).
        sensor: which camera.
        spp: samples a pixel of the interior term.
        seed: of the boundary term's stream.
    """
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    for kernel, inputs, samples in _terms(scene, plan, names, "reverse", sensor, spp, seed):
        _launch(
            scene,
            kernel,
            samples,
            lambda first, lane, inputs=inputs: (inputs(first, adjoint), [buffers[lane], dummy]),
            lanes=buffers.shape[0],
        )


def forward(
    scene: Scene, plan, names: list[str], tangents: wp.array, image: wp.array, *, sensor: int, spp: int, seed: int
) -> None:
    """Add the derivative of the boundary term along flat tangents to an image (arguments as in ``backward``)."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    height, width = image.shape
    lanes = max(2, min(workers.LANES, LANE_IMAGE_FLOATS // (3 * height * width))) if scene.device.is_cpu else 1
    images = wp.zeros((lanes, height, width), dtype=wp.vec3, device=scene.device)
    for kernel, inputs, samples in _terms(scene, plan, names, "forward", sensor, spp, seed):
        _launch(
            scene,
            kernel,
            samples,
            lambda first, lane, inputs=inputs: (inputs(first, dummy), [tangents, images[lane]]),
            lanes=lanes,
        )
    launch(add_images, dim=(height, width), inputs=[images], outputs=[image], device=scene.device)


def _terms(scene: Scene, plan, names: list[str], role: str, sensor: int, spp: int, seed: int):
    """Yield the kernel, the arguments and the number of samples of the primary and of the secondary term."""
    moves = motion(scene, names)
    camera, data = scene.camera(sensor), scene.data()
    # The estimators stratify over the edges; everything else is independent.
    config = replace(plan.config, sampler="independent")
    pixels = camera.crop_width * camera.crop_height
    method = plan.boundary
    edges = primary_edges(scene, sensor, set(moves.shapes), camera_moves=moves.camera)
    if edges is not None:
        samples = pixels * (method.spp_primary or spp)
        yield (
            make_primary_kernel(config, role, moves.camera),
            lambda first, adjoint, edges=edges, n=samples: [
                data, camera, edges, first, n, mix_seed(seed, PRIMARY), plan.max_depth, plan.rr_depth, adjoint,
            ],
            samples,
        )  # fmt: skip
    found = terminator_faces(scene, sensor, set(moves.shapes), camera_moves=moves.camera) if config.scatter else None
    if found is not None:
        samples = pixels * (method.spp_primary or spp)
        yield (
            make_terminator_kernel(config, role, moves.camera),
            lambda first, adjoint, found=found, n=samples: [
                data, camera, *found, first, n, mix_seed(seed, TERMINATOR), plan.max_depth, plan.rr_depth, adjoint,
            ],
            samples,
        )  # fmt: skip
    edges = secondary_edges(scene, set(moves.shapes)) if plan.max_depth != 1 else None
    if edges is not None and scene.builder.emitters:
        samples = pixels * (method.spp_secondary or spp)
        share = WEDGE_SHARE_DIRECT if plan.max_depth == 2 else WEDGE_SHARE
        yield (
            make_secondary_kernel(config, role, moves.camera, moves.light_pose),
            lambda first, adjoint, edges=edges, n=samples: [
                data, camera, edges, first, n, mix_seed(seed, SECONDARY), plan.max_depth, plan.rr_depth, share, adjoint,
            ],
            samples,
        )  # fmt: skip


def _launch(scene: Scene, kernel: wp.Kernel, samples: int, arguments, *, lanes: int) -> None:
    """Run a kernel over samples: in one launch on CUDA, in lanes on the worker threads on the CPU."""
    wp.load_module(kernel.module, device=scene.device)  # compile once, before the threads start
    if not scene.device.is_cpu:
        inputs, outputs = arguments(0, 0)
        launch(kernel, dim=samples, inputs=inputs, outputs=outputs, device=scene.device)
        return
    parts = workers.chunks(samples, lanes)

    def lane(i: int) -> None:
        for first, n in parts[i]:
            inputs, outputs = arguments(first, i)
            launch(kernel, dim=n, inputs=inputs, outputs=outputs, device=scene.device)

    workers.run_lanes(lane, lanes)
