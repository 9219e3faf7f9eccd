"""Secondary boundary of shapes without triangles: segments between two path vertices that touch a shape.

The local form (``local_form.py``) at a point x_b of a smooth surface has the measure kappa_n dA dtheta in place of
sin(phi) dl dsigma, with the tangent direction theta and the normal curvature kappa_n along the segment; at rims and
creases it is that of edges. The balance heuristic joins two techniques: an item with a direction of its own, and a
point of a light with the silhouette that it sees. Point, spot and directional lights give the direction. A family of
shapes gives points and densities (``touch.py``). Points of grids and curves slide along the rays that find them (form
S, ``docs/theory/implicit.md#form-s``), so light that they send past their own silhouettes counts as well
(``foreground.py``).

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``, ``#rims``, ``#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.guiding.cube import make_ends
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import TangentAim
from warp_psdr.kernels.boundary.silhouette.delivery import make_delivery
from warp_psdr.kernels.boundary.silhouette.drawn_touch import make_drawn_touch
from warp_psdr.kernels.boundary.silhouette.ends import make_beside_curve, make_sensor_end, make_source_end, with_density
from warp_psdr.kernels.boundary.silhouette.table import touch_of
from warp_psdr.kernels.boundary.silhouette.touch import DrawnItem
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_touching_segment(config: PathConfig, family: str):
    """Return ``segment(scene, sampler, moving, found, drawn, point, aim, direct) -> Segment``.

    ``aim.light`` is -1 where its direction is its own; ``direct`` as in ``path_space/secondary.py``. The scale is one
    over the density of what was drawn, in the measures above.
    """
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, passing_at = touch.items, touch.point, touch.passing
    own_density, aimed_density = touch.own_density, touch.aimed_density
    source_end = make_source_end(config)
    sensor_end = make_sensor_end(config.rays, config.surfaces.primitives)
    sees = make_sees(config.rays, config.surfaces.primitives, touch.hides)
    is_beside_curve = make_beside_curve(config.surfaces.primitives)

    @wp.func
    def touching_segment(
        scene: Scene,
        sampler: Sampler,
        moving: wp.array(dtype=wp.int32),
        found: items,
        drawn: DrawnItem,
        point: point_type,
        aim: TangentAim,
        direct: wp.bool,
    ) -> Segment:
        r = Segment()
        r.w = aim.w
        passing = passing_at(scene, point, r.w, step_off_primitive(scene, scene.triangles[drawn.face]), FAR)
        if passing.shows == 0 or passing.crease == 1:
            return r
        r.boundary_normal = passing.normal
        r.step = passing.beside
        r.x = point.x + r.step * passing.out
        r.source = r.x
        end = source_end(scene, sampler, -1, moving, r, point.face, point.x, aim, drawn.aims, direct)
        if end.valid == 0:
            return r
        density = wp.float32(0.0)
        if not end.delta:
            density = own_density(scene, found, point, drawn, r.w, passing.curvature)
        if end.towards > 0.0:
            density += aimed_density(scene, found, point, drawn, r.w, end)
        if not density > 0.0:
            return r
        r = with_density(sensor_end(scene, moving, end.segment, end.any_moves), end, aim, density)
        if r.valid == 1:
            beside = passing.curvature > 0.0 and is_beside_curve(scene, r, point.face, passing.curvature)
            if beside or not sees(scene, r.x, r.w, r.t1):
                r.valid = 0
        return r

    return touching_segment


@functools.cache
def make_secondary_silhouette_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    family: str,
    guided: bool = False,
    indirect: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``); ``family``: a touch's.

    There is a role more, "ends": ``target`` receives what the ends of segments are (``guiding/cube.py``).
    """
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, weigh = touch.items, touch.point, touch.weigh
    outline_at, held_at = touch.outline, touch.held
    evaluates = role in ("target", "ends")
    drawn_touch = make_drawn_touch(config, family, guided, evaluates)
    write_ends = make_ends(config.surfaces.primitives) if role == "ends" else None
    segment_at = make_touching_segment(config, family)
    accumulate_point = None if evaluates else touch.make_sink(role)
    accumulate_source = None if evaluates else make_source_sink(role, light_pose, config.surfaces.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source) if role != "ends" else None
    note_place = make_note(config.noted)
    deliver = make_delivery(role, point_type, transport, accumulate_point, accumulate_source, write_ends)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def secondary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: items,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        drawn, point, aim = drawn_touch(scene, found, guide, sampler, number, job.samples)
        if point.valid == 0:
            return
        s = segment_at(scene, sampler, moving, found, drawn, point, aim, job.max_depth == 2)
        if s.valid == 0:
            return
        held = held_at(scene, point)
        note_place(scene, NOTE_POINT, point.face, held[0], held[1], point.x, s.w, s.radiance)
        if wp.static(evaluates):
            s.scale = weigh(point, drawn, s.scale, 1.0, wp.length(s.boundary_normal))
        else:
            s.scale = weigh(point, drawn, s.scale, wp.float32(job.samples), 1.0)
        tangent = point.along
        if wp.static(role == "samples"):
            tangent = outline_at(scene, point, s.w)
        deliver(scene, camera, sampler, number, job, point, tangent, s, target, image_out)

    return secondary_silhouette
