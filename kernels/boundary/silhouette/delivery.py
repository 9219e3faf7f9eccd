"""The receiver of a silhouette segment's contribution: the film, a parameter's gradient, or the guide.

Points on shapes of all kinds end here, each with the sink of its own kind.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Camera, Scene


def make_delivery(
    role: str,
    point_type: type,
    transport: wp.Function | None,
    pull_point: wp.Function | None,
    pull_source: wp.Function | None,
    write_ends: wp.Function | None,
) -> wp.Function:
    """Return ``deliver(scene, camera, sampler, number, job, point, along, s, target, image_out)``.

    ``along``: the tangent of the silhouette at the point, which role "samples" records.

    Args:
        role: "reverse", "forward", "samples"; of a guide "target", what sample ``number`` carries, or "ends".
        point_type: struct of the point on the silhouette.
        transport: light from behind the segment to the film; not of "ends".
        pull_point: ``(scene, target, point, adjoint of its position) -> dot``; as the next one not of a guide.
        pull_source: ``(scene, target, s, weight, dot) -> dot``: the same of where the segment starts and ends.
        write_ends: of "ends" alone.
    """

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: point_type, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = pull_point(scene, target, point, w * s.boundary_normal)
        return pull_source(scene, target, s, w, total)

    @wp.func
    def deliver(
        scene: Scene,
        camera: Camera,
        sampler: Sampler,
        number: wp.int32,
        job: SampleJob,
        point: point_type,
        along: wp.vec3,
        s: Segment,
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static(role == "ends"):
            write_ends(scene, target, number, s, s.scale)
        else:
            rest = wp.float32(0.0)
            if wp.static(role == "forward"):
                rest = accumulate(scene, target, point, s, 1.0)
            weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
            if wp.static(role == "target"):
                target[number] = weight
            elif wp.static(role != "forward"):
                if weight != 0.0:
                    dropped = accumulate(scene, target, point, s, weight)
                    if wp.static(role == "samples"):
                        dropped += record_pull(target, number, point.x, along, weight * s.boundary_normal)
                    if dropped != 0.0:
                        count_invalid(scene, sampler)

    return deliver
