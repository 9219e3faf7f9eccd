"""A point of an edge as the camera sees it: its image on the film, its visibility, and the sink of its adjoint.

The estimators of jumps across edges on the film (``path_space/primary.py``, ``path_space/flat_creases.py``) share this
file. They differ in how they estimate the jump.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import make_screened
from warp_psdr.kernels.boundary.forwards import make_hidden
from warp_psdr.kernels.boundary.local_form import (
    STEP,
    EdgePoint,
    Edges,
    barycentrics_at,
    edge_behind,
    edge_point,
    edge_step,
    interior_side,
    make_edge_sink,
    narrowest_face,
)
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import FilmPoint, make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Distance at which the two rays pass the edge, in ray epsilons: some 8 float32 steps of the largest coordinate. It is
#: small because a second discontinuity as near (a terminator just inside of a silhouette) is taken for the first; the
#: rays start close to the edge, where float32 resolves it.
BESIDE = 0.1
#: The same beside narrow faces: 2 float32 steps of the largest coordinate.
BESIDE_LEAST = 0.025
#: The same beside a step of a texture, where nothing else jumps: texture coordinates have roundings of their own.
BESIDE_STEP = 1.0
#: Least distance in front of the edge at which the rays start, in ray epsilons. It is longer where a face is seen more
#: edge-on than BESIDE / AHEAD, 10^-4: the ray beside the edge must start in front of that face.
AHEAD = 2000.0
#: Share by which it is longer than needed, and by which a face is wider than the rays' distance if they meet it.
MARGIN = 2.0
#: Whose surface a ray meets beside an edge, 0: neither the edge's own shape nor one with an edge along it.
OWN, NEXT = wp.constant(1), wp.constant(2)


@wp.struct
class FilmEdge:
    """A sampled point of an edge on the film."""

    valid: wp.int32  # 0: not seen, or nothing asks for it
    point: EdgePoint
    at: FilmPoint
    distance: wp.float32  # from the origin of its pixel's ray
    d: wp.vec3  # direction of that ray
    m: wp.vec3  # unit normal of the plane through the edge and the ray
    side: wp.float32  # +1 or -1: all faces lie on that side of the plane; 0: they do not
    step: wp.float32  # ray epsilon at the edge
    g: wp.vec3  # gradient of N . pixel(x), along m
    weight: wp.vec3  # adjoint of the pixels; 1 in forward mode


@wp.func
def rays_beside(scene: Scene, edges: Edges, f: FilmEdge) -> tuple[wp.float32, wp.float32, wp.bool]:
    """How two rays look past an edge of a mesh: distance from it, length in front of it, whether its face is narrow.

    A narrow one is missed by rays at that distance. With interpolated normals a part of the face turns away from the
    camera. The terminator in between counts if it is seen at ``BESIDE`` (``shading_normals/terminator.py``), so that
    edges look as far.
    """
    if edges.ends[f.point.edge, 0] == STEP:
        beside = BESIDE_STEP * f.step
        slope = wp.abs(wp.dot(scene.triangles[edges.faces[edges.first[f.point.edge]]].normal, f.d))
        return beside, wp.max(AHEAD * f.step, MARGIN * beside / slope), False
    width, slant = narrowest_face(scene, edges, f.point, f.m, f.d)
    # Where scales are mixed, steps are some roundings already.
    least = wp.where(scene.least_step > 0.0, BESIDE, BESIDE_LEAST)
    flat = scene.shapes[scene.triangles[edges.faces[edges.first[f.point.edge]]].shape].smooth == 0
    apart = BESIDE * f.step
    if flat:
        apart = wp.clamp(width / MARGIN, least * f.step, apart)
    return apart, wp.max(AHEAD * f.step, MARGIN * apart / slant), flat and width < MARGIN * apart


@wp.func
def bends(scene: Scene, edges: Edges, edge: wp.int32) -> wp.bool:
    """Whether an edge lies inside of the interpolated normals of one shape.

    Beside such an edge the front of one face and the back of the other are seen only if a terminator lies in between,
    nearer than the rays look. The silhouette close behind it has that jump.
    """
    if edges.ends[edge, 0] < 0:
        return False
    shape = scene.triangles[edges.faces[edges.first[edge]]].shape
    found = scene.shapes[shape].smooth == 1
    for i in range(edges.first[edge], edges.first[edge + 1]):
        found = found and scene.triangles[edges.faces[i]].shape == shape
    return found


@functools.cache
def make_film_edge(config: PathConfig, role: str, camera_moves: bool):
    """Return ``(find, accumulate, accumulate_side)`` (arguments as in ``path_space/secondary.py``).

    ``find(scene, camera, edges, number, samples, sampler, adjoint) -> FilmEdge`` takes the sampler's slots 0 and 1;
    ``accumulate(scene, camera, edges, sampler, samples, film_edge, jump, target, image)`` takes L_- - L_+, the
    radiance on the side that m points away from less that on the other;
    ``accumulate_side(scene, camera, edges, sampler, samples, film_edge, face, x, radiance, target, image)`` takes the
    radiance of the point x of one side, which is material; it is negative on the side that m points to.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    hidden = make_hidden(config.rays, config.surfaces.primitives)
    screened = make_screened(config.rays, config.surfaces.primitives)
    line = make_line(config)[0] if config.media is not None else None
    accumulate_edge = make_edge_sink(role, config.surfaces.steps)
    material = make_vertex_sink(role, False, False, False, False, False, False) if config.material_first else None
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)

    @wp.func
    def find(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        number: wp.int32,
        samples: wp.int32,
        sampler: Sampler,
        adjoint: wp.array2d(dtype=wp.vec3),
    ) -> FilmEdge:
        r = FilmEdge()
        point = edge_point(scene, edges, number, samples, sample_1d(sampler, 0))
        at = project(scene, camera, point.x, lens_point(sample_2d(sampler, 1)))
        r.point = point
        r.at = at
        if at.valid == 0:
            return r
        r.distance = wp.length(point.x - at.origin)
        r.d = (point.x - at.origin) / r.distance
        m = wp.cross(wp.normalize(point.p1 - point.p0), r.d)
        sine = wp.length(m)
        # For speed: an edge seen end-on has no image to move, and rays that are not finite meet nothing on either side.
        if sine <= 0.0:
            return r
        r.m = m / sine
        r.side = interior_side(scene, edges, point, r.m, r.d)
        r.step = edge_step(scene, edges, point.edge)
        # Is the edge visible? Seen from just outside of a silhouette, or straight on.
        start = point.x - (r.step * r.side) * r.m - edge_behind(scene, r.step) * r.d
        if wp.static(config.media is not None):
            back = at.origin - start
            length = wp.length(back)
            ray = -back / length
            seen = line(scene, sampler, -1, at.origin + at.near * ray, ray, length - at.near, camera.medium, 0)
            if length > at.near and (seen.face >= 0 or seen.lost):
                return r
        else:
            if hidden(scene, start, at.origin, at.near):
                return r
        if wp.static(config.camera == CAMERA_ORTHOGRAPHIC and config.media is None):
            if r.side != 0.0:
                inside = point.x + (r.step * r.side) * r.m
                way = r.distance - at.near
                if screened(
                    scene,
                    visibility.camera_accel(scene),
                    edges,
                    point,
                    inside,
                    r.d,
                    way,
                    -1,
                    edge_behind(scene, r.step),
                ):
                    return r
        step = film_velocity(scene, camera, at, point.p1 - point.p0)
        r.g = film_gradient(scene, camera, at, wp.vec2(step[1], -step[0]))
        if wp.dot(r.g, r.m) < 0.0:
            r.g = -r.g
        r.weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            r.weight = gather(camera, at.pixel, adjoint)
            if vanishes(r.weight):
                return r
        note_place(scene, NOTE_EDGE, point.edge, point.s, 0.0, point.x, r.d, r.weight)
        r.valid = 1
        return r

    @wp.func
    def accumulate(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        sampler: Sampler,
        samples: wp.int32,
        f: FilmEdge,
        jump: wp.vec3,
        target: wp.array(dtype=wp.float32),
        image: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        scale = 1.0 / (f.point.pdf * wp.float32(samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(f.weight, jump)
        g = scale * f.g
        speed = accumulate_edge(scene, target, edges, f.point, g)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, f.at.sample, -g, -f.distance * g)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, f.at.pixel, speed * jump, image)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    @wp.func
    def accumulate_side(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        sampler: Sampler,
        samples: wp.int32,
        f: FilmEdge,
        face: wp.int32,
        x: wp.vec3,
        radiance: wp.vec3,
        target: wp.array(dtype=wp.float32),
        image: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        scale = 1.0 / (f.point.pdf * wp.float32(samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(f.weight, radiance)
        g = scale * f.g
        speed = accumulate_edge(scene, target, edges, f.point, g)
        tau = wp.float32(0.0)  # of light from infinity
        if face >= 0:
            tau = f.distance / wp.dot(x - f.at.origin, f.d)
            uv = barycentrics_at(scene.triangles[face], x)
            adjoint = VertexAdjoint()
            adjoint.x = -tau * g
            done = material(scene, target, face, uv[0], uv[1], adjoint, False, x, f.d)
            speed += done.dot
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, f.at.sample, (tau - 1.0) * g, wp.vec3(0.0, 0.0, 0.0))
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, f.at.pixel, speed * radiance, image)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return find, accumulate, accumulate_side
