"""Transport of a boundary segment to the sensor in media: the walk from x_1, its sights, and the adjoints of all.

The estimators of discontinuities between two path vertices in media share this file, as those without media share
``transport.py``. They differ in how they find a segment, in what moves the discontinuity, and in the light that jumps.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import pass_together
from warp_psdr.kernels.boundary.detector import Incident, radiance_behind, serves_length
from warp_psdr.kernels.boundary.path_space.media_ride import make_media_ride
from warp_psdr.kernels.boundary.path_space.media_walk import MediaWalk, Sight, make_media_walk
from warp_psdr.kernels.boundary.transport import SLOT_LENS, Segment
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import SIGHT
from warp_psdr.kernels.rng import Sampler, branch_of, make_sampler
from warp_psdr.kernels.sensor.camera import make_lens
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig

#: Vertices of a walk that reverse mode keeps; those behind are drawn a second time.
KEPT = wp.constant(4)


@functools.cache
def make_media_transport(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    grids_move: bool,
    source: wp.Function | None,
    *,
    deep: bool = True,
    least: int = 1,
    ends: int = 3,
):
    """Return ``transport(scene, camera, sampler, s, first, medium, eye, scale, sent, rest, job, target, image)``.

    It walks from x_1, ``first``, and at each vertex that the camera sees adds to the image (forward) or collects the
    adjoint (reverse). ``sent`` is what counts behind every number of vertices, ``medium`` that where the source's ray
    starts, ``rest`` the velocity of all but what the camera sees for a unit weight, which forward mode reads. The
    results are the weight of those velocities, which reverse mode has to push, and a number that is not 0 if an adjoint
    was dropped.

    Args:
        config: what the scene needs.
        role: "reverse", "forward" or "target" (``path_space/secondary.py``).
        camera_moves: a parameter of the camera is differentiated.
        grids_move: grids of media have derivatives.
        source: ``(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident`` of what arrives at x_1 beyond
            ``sent``; None: nothing does.
        deep: paths may have more than two vertices behind the camera.
        least: number of path vertices behind x_1 without which nothing jumps.
        ends: number of path vertices from x_1 on, itself included, without which ``source`` is zero; 0: it never is.
    """
    first_vertex, sight_of, extend = make_media_walk(config)
    evaluates = role == "target"
    by_camera, by_surface = (None, None) if evaluates else make_media_ride(config, role, camera_moves, grids_move)
    splat, gather = make_splat()
    lens_point = make_lens(config.camera)
    sample_2d = make_sampler(config.sampler).sample_2d
    forward = role == "forward"
    twice = role == "reverse"
    traces = source is not None

    @wp.func
    def transport(
        scene: Scene,
        camera: Camera,
        sampler: Sampler,
        s: Segment,
        first: MediaWalk,
        medium: wp.int32,
        eye: wp.vec3,
        scale: wp.float32,
        sent: wp.vec3,
        rest: wp.float32,
        job: SampleJob,
        target: wp.array(dtype=wp.float32),
        image: wp.array2d(dtype=wp.vec3),
    ) -> tuple[wp.float32, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        lens = lens_point(sample_2d(sampler, SLOT_LENS))
        incident = Incident()
        total = wp.float32(0.0)  # the sum of the w_k
        later = wp.float32(0.0)  # of those behind the k-th vertex
        dropped = wp.float32(0.0)
        speed = rest  # of all but what the camera sees
        # In reverse mode twice: once for the sum of the w_k, once to scatter. The first vertices are kept.
        sweep = wp.int32(wp.static(1 if forward or evaluates else 0))
        if wp.static(twice):
            walks = wp.zeros(shape=(KEPT,), dtype=MediaWalk)
            sights = wp.zeros(shape=(KEPT,), dtype=Sight)
            values = wp.zeros(shape=(KEPT,), dtype=wp.float32)
        while sweep < 2:
            walk = first
            g = (s.tau - 1.0) * s.boundary_normal
            k = wp.int32(1)
            while walk.alive == 1:
                seen = Sight()
                w = wp.float32(0.0)
                counts = wp.bool(True)
                if wp.static(twice):
                    if sweep == 1 and k <= KEPT:
                        seen = sights[k - 1]
                        w = values[k - 1]
                        counts = wp.bool(False)
                        if w != 0.0:
                            dropped += by_camera(scene, camera, target, walk, seen, w * g)
                if counts:
                    seen = sight_of(scene, camera, sampler, SIGHT + k, walk, lens)
                    counts = not vanishes(seen.weight)
                if counts and k == 1 and s.light >= 0:
                    counts = not pass_together(seen.at.origin - walk.x, s.w, s.t1, s.step)
                asked = wp.vec3(0.0, 0.0, 0.0)
                if wp.static(not forward and not evaluates):
                    if counts:
                        asked = gather(camera, seen.at.pixel, job.image_adjoint)
                        counts = wp.max(wp.abs(asked)) > 0.0
                if counts:
                    radiance = sent
                    if wp.static(traces):
                        if s.light < 0 and (
                            wp.static(ends == 0) or job.max_depth < 0 or k - 1 + wp.static(ends) <= job.max_depth
                        ):
                            if incident.first > k or not serves_length(incident, k):
                                branch = branch_of(sampler, k)
                                incident = source(scene, branch, s, medium, k, job.max_depth, job.rr_depth)
                            radiance += radiance_behind(incident, k)
                    value = scale * wp.cw_mul(seen.weight, radiance)
                    if wp.static(evaluates):
                        total += value[0] + value[1] + value[2]
                    elif wp.static(forward):
                        v = speed + by_camera(scene, camera, target, walk, seen, g)
                        splat(scene, sampler, camera, seen.at.pixel, v * value, image)
                    else:
                        w = wp.dot(asked, value)
                        if sweep == 0:
                            total += w
                        elif w != 0.0:
                            dropped += by_camera(scene, camera, target, walk, seen, w * g)
                if wp.static(twice):
                    if sweep == 0 and k <= KEPT:
                        sights[k - 1] = seen
                        values[k - 1] = w
                later -= w
                if wp.static(deep):
                    after = MediaWalk()
                    kept = wp.bool(False)
                    if wp.static(twice):
                        if sweep == 1 and k < KEPT:
                            kept = wp.bool(True)
                            after = walks[k]
                    if not kept and (job.max_depth < 0 or k + 1 + wp.static(least) <= job.max_depth):
                        after = extend(scene, sampler, walk, eye, k, k >= job.rr_depth)
                    if wp.static(twice):
                        if sweep == 0 and k < KEPT:
                            walks[k] = after
                    if wp.static(not evaluates):
                        if after.alive == 1 and sweep == 1 and not vanishes(g):
                            weight = wp.float32(1.0)
                            if wp.static(not forward):
                                weight = later
                            if weight != 0.0:
                                a_y, dot = by_surface(scene, target, walk, after, weight * g)
                                g = a_y / weight
                                if wp.static(forward):
                                    speed += dot
                                else:
                                    dropped += dot
                    walk = after
                else:
                    walk.alive = 0
                k += 1
            later = total
            sweep += 1
            if total == 0.0:
                sweep = 2
        return total, dropped

    return first_vertex, transport
