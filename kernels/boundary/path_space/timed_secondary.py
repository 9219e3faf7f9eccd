"""Secondary boundary on a transient film: the segments of ``secondary.py``, with their light binned by path length.

Derivation: ``docs/theory/transient.md#boundary-term``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.guiding.techniques import Guide, make_techniques
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.path_space.direction import wedge_at
from warp_psdr.kernels.boundary.timed_transport import make_timed_transport
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.time_gate import TimeGates
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


def make_timed_secondary_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    slots: tuple[int, int],
    segment_at: wp.Function,
    accumulate_segment: wp.Function,
):
    """Return the kernel of ``make_secondary_kernel``, unguided, before a transient film.

    ``slots``: of the edge and of the direction; they and the functions are ``secondary.py``'s.
    """
    transport = make_timed_transport(config, role, camera_moves)
    sample_aim, density, _place = make_techniques(config.lights, False)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    slot_edge, slot_direction = slots

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def timed_secondary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
        # In:
        gates: TimeGates,
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, wp.static(slot_direction))
        jitter = sample_1d(sampler, wp.static(slot_edge))
        u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
        aim = sample_aim(scene, edges, guide, u, u4)
        point = aim.point
        if aim.direction.valid == 0:
            return
        s = segment_at(scene, edges, moving, point, aim.direction, job.max_depth == 2)
        if s.valid == 0:
            return
        pdf = density(scene, edges, guide, wedge_at(scene, edges, point), aim, s.face2, s.u2, s.v2, s.t2)
        # pdf_l is a density of the fraction s; dl = |p1 - p0| ds.
        scale = s.scale * wp.length(point.p1 - point.p0) / (point.pdf * pdf * wp.float32(job.samples))
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_segment(scene, target, edges, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, scale, rest, gates, job, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_segment(scene, target, edges, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return timed_secondary
