"""Interior term in forward mode, of paths that are traced side by side: the factors are those of ``forward.py``.

A derivative needs a vertex and the next one of its path, so two vertices of a path are kept at a time, whatever its
length. Each step of the paths is followed by the derivative at their previous vertices, path by path. Derivatives by
numbers of materials alone need no next vertex. Where ``sweeps_materials`` allows it, they are computed for all lanes in
step (``lanes/material_forward.py``).

Derivation: ``docs/theory/interior.md#forward-mode``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import column_of, make_pixel_bundle, row_of
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.tangents import Moving
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.lanes.lanes import ROOM, ROWS, stack_rows
from warp_psdr.kernels.lanes.material_forward import make_material_forward
from warp_psdr.kernels.lanes.material_sweep import sweeps_materials
from warp_psdr.kernels.lanes.path_lanes import LanePaths, make_lane_paths
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_origin
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex

#: Vertices of a path that are kept at a time.
KEPT = 2


@wp.struct
class ForwardCarry:
    """What travels with a path: how its vertex moves, A_n', and the derivative so far."""

    moving: Moving
    throughput_dot: wp.vec3
    sum_dot: wp.vec3


def make_lane_forward_kernel(
    config: PathConfig, wanted: GradientRequest, advance: wp.Function, first_moving: wp.Function
):
    """Return the kernel of ``make_forward_kernel`` for paths side by side; its functions are ``forward.py``'s.

    None: the rows have no room for what travels with the paths.
    """
    paths, derivatives = None, None
    if sweeps_materials(config, wanted):
        paths = make_lane_paths(config, True, True, kept=KEPT, lit=True)
        derivatives = make_material_forward(config.surfaces, config.lights, wanted, paths)
    if derivatives is None or derivatives[0] > ROOM:
        paths = make_lane_paths(config, True, True, kept=KEPT)
        derivatives = make_forward_of_each(make_camera_origin(config.camera), paths, advance, first_moving)
    end, begin, differentiate, carries = derivatives
    if end > ROOM:
        return None
    pixel_bundle = make_pixel_bundle(paths.width)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def forward_lanes(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        bundle = pixel_bundle(job, camera, wp.tid())
        if bundle.pixels == 0:
            return
        rows = scene.rows
        always = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
        if wp.static(config.through):
            always += 1  # shadow rays meet shapes as well
        total = wp.vec3d()  # in double precision, as the image
        done = wp.int32(0)
        while done < job.samples:
            bundle.first_sample = job.first_sample + done
            bundle.samples = wp.min(job.samples - done, wp.static(paths.width))
            done += bundle.samples
            paths.start(scene, camera, paths.view(scene, camera), job.pixels, bundle, 0, always, rows)
            begin(rows)
            count = bundle.pixels * bundle.samples
            n = wp.int32(0)
            alive = wp.int32(1)
            more = wp.bool(True)
            while more:
                more = alive > 0
                if more:
                    alive = paths.step(scene, n, job.max_depth, job.rr_depth, rows)
                differentiate(scene, camera, target, count, n, rows)
                n += 1
            for i in range(bundle.pixels):
                sampler = sampler_at(job.pixels[bundle.first + i], 0, bundle.seed)
                for k in range(bundle.samples):
                    sum_dot = carries.get(rows, i * bundle.samples + k).sum_dot
                    if finite(sum_dot):
                        total += wp.vec3d(sum_dot)
                    else:
                        sampler.index = wp.uint32(bundle.first_sample + k)
                        count_invalid(scene, sampler)
                if done == job.samples:
                    px = column_of(bundle, sampler)
                    py = row_of(bundle, sampler)
                    image_out[py, px] = image_out[py, px] + wp.vec3(wp.float64(job.scale) * total)
                    total = wp.vec3d()

    return forward_lanes


def make_forward_of_each(camera_origin: wp.Function, paths: LanePaths, advance: wp.Function, first_moving: wp.Function):
    """Return the number of rows that it takes, two functions, and the rows of what travels with the paths.

    ``begin(rows)`` before the first step, ``differentiate(scene, camera, target, count, n, rows)`` behind the n-th, and
    once more behind the last; ``target`` holds the tangents. The record in the rows has ``sum_dot``, the derivative.
    """
    width = paths.width
    (carries,) = stack_rows(width, paths.end, ForwardCarry)

    @wp.func
    def begin(rows: ROWS):
        for j in range(width):
            carries.put(rows, j, ForwardCarry())

    @wp.func
    def differentiate(
        scene: Scene, camera: Camera, target: wp.array(dtype=wp.float32), count: wp.int32, n: wp.int32, rows: ROWS
    ):
        """The vertices before the n-th; of their paths some have no n-th."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            vertices = paths.gathered(rows, j).vertices
            if n > 0 and vertices >= n:
                carry = carries.get(rows, j)
                vertex = paths.vertex(rows, j, n - 1)
                if n == 1:
                    sample = paths.camera(rows, j)
                    vertex.o = camera_origin(scene, camera, sample)
                    carry.moving = first_moving(scene, camera, target, sample, vertex)
                following = PathVertex()
                following.face = -1
                if vertices > n:
                    following = paths.vertex(rows, j, n)
                derivative, throughput_dot, moving = advance(
                    scene, target, vertex, following, carry.moving, carry.throughput_dot
                )
                carry.sum_dot += derivative
                carry.throughput_dot = throughput_dot
                carry.moving = moving
                carries.put(rows, j, carry)

    return carries.end, begin, differentiate, carries
