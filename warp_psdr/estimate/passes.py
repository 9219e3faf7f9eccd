"""The passes over pixels: the image, and the interior term in reverse and in forward mode.

Each runs over a raster, or over some of its pixels, and adds to what it is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch, launch_shards, shared_copy
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.jobs import PixelSamples
from warp_psdr.invalid import counting
from warp_psdr.kernels.aov import ROW, make_aov_kernel
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.films import collect_band
from warp_psdr.kernels.primal import make_primal_kernel
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.kernels.splat import make_splat_kernel
from warp_psdr.kernels.transient import make_transient_kernel
from warp_psdr.plan.transient import gates_of
from warp_psdr.topology.patches import patch_radii

if TYPE_CHECKING:
    from warp_psdr.estimate.gradient_sums import GradientSums
    from warp_psdr.kernels.jobs import PixelJob
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.plan.plan import Plan
    from warp_psdr.rows.replay import Kept
    from warp_psdr.scene.scene import Scene

#: Random-number streams: the primal image, the interior and the boundary term are independent of each other.
STREAM_PRIMAL, STREAM_INTERIOR, STREAM_BOUNDARY = 0, 1, 2
#: Samples of a pixel that are summed on a film in float32: relative rounding errors of some 1e-5 at most.
FILM_SAMPLES = 1 << 10
Progress = Callable[[float], None]


def splats(camera: Camera) -> bool:
    """Whether a camera's pixel filter lets a sample count for other pixels than its own.

    A narrower one is drawn from: of samples that are uniform over the pixel it would miss some, and a pixel all of its.
    """
    return camera.filter != RFILTER_BOX and camera.filter_radius > 0.5


def image_kernel(scene: Scene, plan: Plan, sensor: int) -> wp.Kernel:
    """Return the kernel of a sensor's image."""
    if plan.times is not None:
        return make_transient_kernel(plan.seen)
    make = make_splat_kernel if splats(scene.camera(sensor)) else make_primal_kernel
    return make(plan.seen)


def film_of(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
    squares: wp.array | None = None,
) -> wp.array:
    """Return a film, (H, W) of vec4d: sums of weighted radiance and of weights, of all pixels or of those listed.

    Args:
        scene: the scene.
        plan: of the image.
        sensor: which camera.
        draw: its samples.
        seed: of the image's stream.
        progress: called with the finished fraction.
        pixels: numbers of pixels of the raster, which a wide filter extends by ``filter_margin``.
        squares: (H, W) of vec3d, what receives the sums of squares where a sample counts in its own pixel alone.
    """
    if splats(scene.camera(sensor)):
        return _splatted(scene, plan, sensor, draw, seed, progress, pixels)
    camera = scene.camera(sensor)
    film = wp.zeros((camera.crop_height, camera.crop_width), dtype=wp.vec4d, device=scene.device)
    if squares is None:
        squares = wp.zeros((0, 0), dtype=wp.vec3d, device=scene.device)
    _to_pixels(scene, plan, sensor, draw, seed, [film, squares], progress, pixels)
    return film


def timed(
    scene: Scene, plan: Plan, sensor: int, draw: Draw, seed: int, film: wp.array, progress: Progress | None = None
) -> None:
    """Add the mean of the samples to the bins of every pixel, (H, W bins) of vec3d."""
    _to_pixels(scene, plan, sensor, draw, seed, [film], progress)


def _to_pixels(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    outputs: list[wp.array],
    progress: Progress | None,
    pixels: wp.array | None = None,
) -> None:
    """Run the image's kernel where a sample counts in its own pixel alone."""
    camera = scene.camera(sensor)
    samples = PixelSamples(
        draw.count, seed, plan.max_depth, plan.rr_depth, scale=1.0 / draw.spp, first_sample=draw.first
    )
    launch_pass(
        scene,
        image_kernel(scene, plan, sensor),
        (camera.crop_width, camera.crop_height),
        samples,
        camera,
        lambda _shard: outputs,
        shards=workers.SHARDS,
        kind="image",
        progress=progress,
        listed=pixels,
        reads=_gates(plan),
        share=draw.share,
    )


def _splatted(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    progress: Progress | None,
    pixels: wp.array | None,
) -> wp.array:
    """Return the film under a filter by which a sample counts for several pixels (``kernels/splat.py``)."""
    camera = scene.camera(sensor)
    margin = filter_margin(camera)
    raster = (camera.crop_width + 2 * margin, camera.crop_height + 2 * margin)
    width, height = camera.crop_width, camera.crop_height
    reach, count = _reach(camera), image_shards(scene, sensor)
    order = workers.pixel_order(*raster) if pixels is None else pixels.numpy()
    band = order // raster[0] * count // raster[1]
    order = wp.array(order[np.argsort(band, kind="stable")], dtype=wp.int32, device=scene.device)
    ends = np.cumsum(np.bincount(band, minlength=count))
    films, first_rows = {}, {}
    for shard in draw.share.of(count) if scene.device.is_cpu else (0,):
        first, stop = (-(-n * raster[1] // count) - margin for n in (shard, shard + 1))
        first, stop = max(first - reach, 0), min(stop + reach, height)
        films[shard] = wp.zeros((max(stop - first, 0), width), dtype=wp.vec4, device=scene.device)
        first_rows[shard] = first
    total = wp.zeros((height, width), dtype=wp.vec4d, device=scene.device)
    samples = PixelSamples(FILM_SAMPLES, seed, plan.max_depth, plan.rr_depth, margin=margin)
    for first_sample, number, reported in blocks_of(draw, FILM_SAMPLES, progress):
        launch_pass(
            scene,
            image_kernel(scene, plan, sensor),
            raster,
            replace(samples, samples=number, first_sample=first_sample),
            camera,
            lambda shard: [films[shard]],
            shards=count,
            kind="image",
            progress=reported,
            listed=order,
            share=draw.share,
            chunks=workers.stretches(ends),
            first_film_rows=first_rows,
        )
        for shard, film in films.items():
            launch(collect_band, dim=film.shape, inputs=[film, first_rows[shard]], outputs=[total], device=scene.device)
            film.zero_()
    return total


def image_shards(scene: Scene, sensor: int) -> int:
    """Return into how many shards the passes of an image are split."""
    camera = scene.camera(sensor)
    if not scene.device.is_cpu:
        return 1
    if not splats(camera):
        return workers.SHARDS
    height = camera.crop_height + 2 * filter_margin(camera)
    return workers.below(min(workers.SHARDS, max(height // (2 * _reach(camera)), 1)))


def _reach(camera: Camera) -> int:
    """Return how many rows beside its own a sample may be written to, also with a weight of zero or after rounding."""
    return filter_reach(camera) + 1


def _gates(plan: Plan) -> list:
    """Return what the kernels of transient films take in front of their jobs."""
    return [] if plan.times is None else [gates_of(plan.times)]


def visible(scene: Scene, plan: Plan, sensor: int, spp: int, seed: int, progress: Progress | None = None) -> np.ndarray:
    """Return what the camera sees first, (H, W, ``kernels.aov.ROW``) float32: means over ``spp`` samples a pixel."""
    camera = scene.camera(sensor)
    rows = wp.zeros((camera.crop_height, camera.crop_width, ROW), dtype=wp.float32, device=scene.device)
    launch_pass(
        scene,
        make_aov_kernel(replace(plan.config, surfaces=replace(plan.config.surfaces, uv=True))),
        (camera.crop_width, camera.crop_height),
        PixelSamples(spp, seed, plan.max_depth, plan.rr_depth),
        camera,
        lambda _shard: [rows],
        shards=workers.SHARDS,
        kind="image",
        progress=progress,
    )
    return rows.numpy()


def filter_reach(camera: Camera) -> int:
    """Return how many pixels away from its own a sample can count, under a filter that lets it (``splats``)."""
    return math.ceil(camera.filter_radius - 0.5)


def filter_margin(camera: Camera) -> int:
    """Return how many pixels beyond the film's border a sample can lie that counts for it."""
    return filter_reach(camera) if camera.sample_border else 0


def interior_backward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    adjoint: wp.array,
    sums: GradientSums,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
    weight: float = 1.0,
) -> None:
    """Add the gradient of the interior term, of all pixels or of those listed, times a weight."""
    camera = scene.camera(sensor)
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    samples = replace(_interior(plan, draw, seed, weight), adjoint=adjoint)
    kernels = camera_gradient_kernels(plan, "reverse")
    for i, kernel in enumerate(kernels):
        launch_pass(
            scene,
            kernel,
            (camera.crop_width, camera.crop_height),
            samples,
            camera,
            lambda shard: [sums.buffer(shard), dummy],
            shards=sums.shards,
            kind="interior",
            progress=part(progress, i / len(kernels), 1.0 / len(kernels)),
            listed=pixels,
            fields=_fields(scene, plan) | {"requested_shapes": _mask(scene, plan.shapes)},
            reads=[*_gates(plan), *(_read(scene, plan) if i == 0 else [])],
            share=draw.share,
        )


def interior_forward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    target: wp.array,
    image: wp.array,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
    weight: float = 1.0,
) -> None:
    """Add the derivative of the interior term along flat tangents, times a weight, to all pixels or those listed."""
    camera = scene.camera(sensor)
    kernels = camera_gradient_kernels(plan, "forward")
    for i, kernel in enumerate(kernels):
        launch_pass(
            scene,
            kernel,
            (camera.crop_width, camera.crop_height),
            _interior(plan, draw, seed, weight),
            camera,
            lambda _shard: [target, image],
            shards=workers.SHARDS,
            kind="interior",
            progress=part(progress, i / len(kernels), 1.0 / len(kernels)),
            listed=pixels,
            fields=_fields(scene, plan) | {"requested_shapes": _mask(scene, plan.shapes)},
            reads=[*_gates(plan), *(_read(scene, plan) if i == 0 else [])],
            share=draw.share,
        )


def _interior(plan: Plan, draw: Draw, seed: int, weight: float) -> PixelSamples:
    """Return the samples of the interior term."""
    return PixelSamples(
        draw.count,
        mix_seed(seed, STREAM_INTERIOR),
        depth_of(plan),
        plan.rr_depth,
        scale=weight / draw.spp,
        first_sample=draw.first,
    )


def _fields(scene: Scene, plan: Plan) -> dict[str, wp.array]:
    """Return fields of ``structs.Scene``: ``radii``, if geometry is differentiated, and cells of environment maps."""
    fields = {"radii": patch_radii(scene)} if plan.wanted is not None and plan.wanted.geometry else {}
    if plan.interior is not None and not plan.interior.compensated:
        fields["env_marginal"], fields["env_conditional"] = scene.lights.cells(False)
    return fields


def camera_gradient_kernels(plan: Plan, role: str) -> list[wp.Kernel]:
    """Return the kernels of the interior term, of role "reverse" or "forward", whose results add up."""
    assert plan.interior is not None and plan.seen_wanted is not None and plan.kept is not None
    what = plan.seen, plan.seen_wanted, role, plan.kept
    return plan.interior.kernels(*what)


def _read(scene: Scene, plan: Plan) -> list:
    """Return what the first kernel of the interior term reads of the scene besides its record."""
    assert plan.interior is not None and plan.seen_wanted is not None and plan.kept is not None
    return plan.interior.reads(scene, plan.seen_wanted, plan.kept)


def _mask(scene: Scene, shapes: frozenset[int] | None) -> wp.array:
    """Return ``structs.Scene.requested_shapes``: 1 for these shapes, 0 for the others; None: 1 for all."""
    mask = np.full(len(scene.builder.shapes) + 1, shapes is None, np.int32)
    mask[sorted(shapes or ())] = 1
    return wp.array(mask, dtype=wp.int32, device=scene.device)


def depth_of(plan: Plan, own: Kept | None = None) -> int:
    """Depth limit of a differential pass: its records, ``own`` or the plan's, have to hold the path."""
    kept = own or plan.kept
    longest = kept.longest if kept is not None else 0
    return longest if longest and plan.max_depth < 0 else plan.max_depth


def blocks_of(draw: Draw, most: int, progress: Progress | None) -> Iterator[tuple[int, int, Progress | None]]:
    """Split a pixel's samples: yield (first, count, progress of these), ``most`` of them at a time."""
    for done in range(0, draw.count, most):
        count = min(most, draw.count - done)
        yield draw.first + done, count, part(progress, done / draw.count, count / draw.count)


def part(progress: Progress | None, start: float, share: float) -> Progress | None:
    """Return what reports the finished fraction of a part, which begins at ``start``, as that of the whole."""
    return None if progress is None else lambda done: progress(start + share * done)


def launch_pass(
    scene: Scene,
    kernel: wp.Kernel,
    raster: tuple[int, int],
    samples: PixelSamples,
    camera: Camera,
    outputs: Callable[[int], list],
    *,
    shards: int,
    kind: str,
    progress: Progress | None = None,
    listed: wp.array | None = None,
    fields: dict[str, wp.array] | None = None,
    reads: Sequence = (),
    share: workers.Share = workers.WHOLE,
    chunks: list[workers.Chunks] | None = None,
    first_film_rows: dict[int, int] | None = None,
) -> None:
    """Run a kernel over a raster (width, height): in one launch on CUDA, in shards on worker threads on the CPU.

    ``kind``: what its samples are. ``outputs``: of a shard. ``listed``: numbers of the raster's pixels, instead of all
    of them. ``fields``: of ``structs.Scene``, those of this pass. ``reads``: what the kernel takes in front of its job.
    ``share``: which of the shards are run. ``chunks``: as of ``launch_shards``. ``first_film_rows``: of a shard's film,
    where it holds a band of rows.
    """
    data = scene.data(compensated=kind != "light")
    for name, values in (fields or {}).items():
        setattr(data, name, values)
    order = listed
    if order is None:
        order = wp.array(workers.pixel_order(*raster), dtype=wp.int32, device=scene.device)
    count = order.shape[0]
    shards = shards if scene.device.is_cpu else 1
    # A record for every lane: the launches of one lane follow each other, those of several run side by side.
    template = samples.job(order)
    jobs: dict[int, PixelJob] = {}

    with counting(scene, kind, count * samples.samples, shards, (raster[0], samples.margin)) as of_shard:

        def arguments(first: int, n: int, shard: int) -> tuple[list, list]:
            job = jobs.get(shard)
            if job is None:
                job = jobs[shard] = shared_copy(template)
                if first_film_rows is not None:
                    job.first_film_row = first_film_rows[shard]
            job.first_pixel, job.pixel_count = first, n
            return [of_shard(data, shard), camera, *reads, job], outputs(shard)

        launch_shards(
            kernel,
            count,
            arguments,
            shards=shards,
            device=scene.device,
            progress=progress,
            share=share,
            chunks=chunks,
        )
