"""Seeds of boundary segments: ordinary path segments, projected to the nearest silhouette [ZRJ23, section 4].

A ray from a path vertex x_1 ends on a mesh. A walk over the mesh, always to the neighbour with the smallest |n .
omega|, ends at a silhouette. If it ends elsewhere, a jump to the linearised zero starts a second walk. Seeds only say
where samples are worth their cost, so no estimate depends on their accuracy.

Derivation: ``docs/theory/guiding.md#projected-path-segments``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.light_square import make_light_square, outside_of
from warp_psdr.kernels.boundary.guiding.media_segments import make_media_candidate
from warp_psdr.kernels.boundary.guiding.path_segments import (
    BLOCKED,
    BLOCKED_LIGHT,
    SLOT_SEED,
    Candidate,
    make_candidate,
    seed_sampler,
)
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, interior_side
from warp_psdr.kernels.boundary.path_space.direction import wedge_at, wedge_square
from warp_psdr.kernels.constants import FAR, NO_MEDIUM
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.rng import make_sampler
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import LightConfig, PathConfig
from warp_psdr.kernels.visibility import make_visibility, visibility_of

#: Most triangles that one walk crosses [ZRJ23].
WALK_STEPS = 30
#: Walks after the first one, each from where a jump landed.
JUMPS = 3
#: A jump that misses the shape is shortened by half, at most so often.
JUMP_TRIES = 8


@wp.struct
class Neighbours:
    """What lies across the side of a triangle between its corners i and i + 1."""

    faces: wp.array2d(dtype=wp.int32)  # (faces, 3) the triangle; -1: an open edge, or one of more than two triangles
    edges: wp.array2d(dtype=wp.int32)  # (faces, 3) the number of the edge in ``Edges``; -1: flat, never a silhouette


@wp.struct
class Silhouette:
    """A point on an edge that is a silhouette as seen from some point; ``edge`` -1: none found."""

    edge: wp.int32
    s: wp.float32
    w: wp.vec3  # unit, from the point to the edge
    jumped: wp.int32


@wp.func
def nearest_fraction(p0: wp.vec3, p1: wp.vec3, o: wp.vec3, d: wp.vec3) -> wp.float32:
    """Fraction of the way from p0 to p1 where the segment is nearest to the line o + t d (d unit)."""
    r = p0 - o
    e_across = (p1 - p0) - wp.dot(p1 - p0, d) * d
    r_across = r - wp.dot(r, d) * d
    squared = wp.dot(e_across, e_across)
    if squared <= 0.0:
        return 0.5
    return wp.clamp(-wp.dot(r_across, e_across) / squared, 0.0, 1.0)


@wp.func
def centroid(scene: Scene, face: wp.int32) -> wp.vec3:
    tri = scene.triangles[face]
    return (tri.p0 + tri.p1 + tri.p2) / 3.0


@wp.func
def face_cosine(scene: Scene, face: wp.int32, o: wp.vec3) -> wp.float32:
    """Return n . omega at the centroid of a triangle seen from o."""
    return wp.dot(scene.triangles[face].normal, wp.normalize(centroid(scene, face) - o))


@wp.func
def silhouette_at(
    scene: Scene, edges: Edges, neighbours: Neighbours, face: wp.int32, o: wp.vec3, d: wp.vec3
) -> Silhouette:
    """Return the point on a silhouette edge of the triangle that is nearest to the ray (o, d)."""
    r = Silhouette()
    r.edge = -1
    best = wp.float32(-2.0)
    for side in range(3):
        edge = neighbours.edges[face, side]
        if edge >= 0:
            point = EdgePoint()
            point.edge = edge
            point.p0 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 0])
            point.p1 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 1])
            s = nearest_fraction(point.p0, point.p1, o, d)
            w = wp.normalize((1.0 - s) * point.p0 + s * point.p1 - o)
            if wp.dot(w, d) > best and interior_side(scene, edges, point, wp.cross(point.p1 - point.p0, w), w) != 0.0:
                best = wp.dot(w, d)
                r.edge = edge
                r.s = s
                r.w = w
    return r


@functools.cache
def make_edge_projection(backend: str, width: int):
    """Return ``to_silhouette(scene, edges, neighbours, face, o, d) -> Silhouette``: walk, jump, walk."""
    visibility = make_visibility(backend, width)

    @wp.func
    def walk(
        scene: Scene, edges: Edges, neighbours: Neighbours, start: wp.int32, o: wp.vec3, d: wp.vec3
    ) -> tuple[Silhouette, wp.int32]:
        face = wp.int32(start)
        found = silhouette_at(scene, edges, neighbours, face, o, d)
        steps = wp.int32(0)
        while found.edge < 0 and steps < WALK_STEPS:
            least = wp.abs(face_cosine(scene, face, o))
            after = wp.int32(-1)
            for side in range(3):
                other = neighbours.faces[face, side]
                if other >= 0:
                    value = wp.abs(face_cosine(scene, other, o))
                    if value < least:
                        least = value
                        after = other
            if after < 0:
                return found, face
            face = after
            found = silhouette_at(scene, edges, neighbours, face, o, d)
            steps += 1
        return found, face

    @wp.func
    def to_silhouette(
        scene: Scene, edges: Edges, neighbours: Neighbours, start: wp.int32, o: wp.vec3, d: wp.vec3
    ) -> Silhouette:
        face = wp.int32(start)
        found, last = walk(scene, edges, neighbours, face, o, d)
        jumps = wp.int32(0)
        while found.edge < 0 and last != face and jumps < JUMPS:
            at = centroid(scene, last)
            here = face_cosine(scene, last, o)
            step = (here / (face_cosine(scene, face, o) - here)) * (at - centroid(scene, face))
            shape = scene.triangles[last].shape
            face = last
            tries = wp.int32(0)
            while tries < JUMP_TRIES and last == face:
                hit = visibility.closest(scene, o, wp.normalize(at + step - o), FAR)
                if hit.face >= 0:
                    if scene.triangles[hit.face].shape == shape:
                        face = hit.face
                step *= 0.5
                tries += 1
            if face != last:
                found, last = walk(scene, edges, neighbours, face, o, d)
                found.jumped = 1
            jumps += 1
        return found

    return to_silhouette


@wp.func
def edge_coordinate(edges: Edges, edge: wp.int32, s: wp.float32) -> wp.float64:
    """Where in [0, 1) of the edges' cumulative probabilities the point s of an edge lies."""
    along = (s - edges.low[edge]) / (edges.high[edge] - edges.low[edge])
    # For less noise alone: an end that is met stays on its edge. Seeds only say where to look.
    return outside_of(edges.cdf, edge, wp.min(wp.float64(along), wp.float64(0.999999)))


@wp.func
def found_point(scene: Scene, edges: Edges, found: Silhouette) -> EdgePoint:
    point = EdgePoint()
    point.edge = found.edge
    point.s = found.s
    point.p0 = load_vec3(scene.values, scene.positions + 3 * edges.ends[found.edge, 0])
    point.p1 = load_vec3(scene.values, scene.positions + 3 * edges.ends[found.edge, 1])
    point.x = (1.0 - found.s) * point.p0 + found.s * point.p1
    return point


@wp.func
def wedge_seed(scene: Scene, edges: Edges, found: Silhouette) -> wp.vec3d:
    """Coordinates of a silhouette point in the cube of the wedge technique; outside of it if it is in no wedge."""
    point = found_point(scene, edges, found)
    square = wedge_square(wedge_at(scene, edges, point), found.w)
    return wp.vec3d(edge_coordinate(edges, found.edge, found.s), wp.float64(square[0]), wp.float64(square[1]))


@functools.cache
def make_light_seed(lights: LightConfig):
    """Return ``light_seed(scene, edges, found, candidate, u) -> vec3d``: coordinates in the cube of the lights."""
    _aim, light_coordinates = make_light_square(lights)

    @wp.func
    def light_seed(scene: Scene, edges: Edges, found: Silhouette, from_x: Candidate, u: wp.float32) -> wp.vec3d:
        along = edge_coordinate(edges, found.edge, found.s)
        if from_x.coordinate >= wp.float64(0.0):
            # All coordinates of such a light mean the same.
            return wp.vec3d(along, from_x.coordinate, wp.float64(u))
        point = found_point(scene, edges, found)
        w = wp.normalize(from_x.light - point.x)
        at = light_coordinates(scene, edges, point, from_x.light_face, from_x.light_u, from_x.light_v, w)
        return wp.vec3d(along, at[0], at[1])

    return light_seed


@functools.cache
def make_seeds_kernel(config: PathConfig, kind: int):
    """Return the kernel: one thread a camera path and its seed.

    Args:
        config: what the scene needs.
        kind: BLOCKED_LIGHT or SCATTERED, the rays that are projected. The former makes seeds of both techniques, the
            latter of the wedge alone.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    among_media = config.media is not None
    candidate = (make_media_candidate if among_media else make_candidate)(config, kind)
    line = make_line(config)[0] if among_media else None
    to_silhouette = make_edge_projection(config.rays.backend, config.rays.width)
    to_light = kind == BLOCKED_LIGHT
    light_seed = make_light_seed(config.lights) if to_light else None
    sample_1d = make_sampler(config.sampler).sample_1d
    has_primitives = bool(config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def seeds(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        neighbours: Neighbours,
        # In:
        radius: wp.float32,
        first: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        # Out:
        weight_out: wp.array(dtype=wp.float32),
        wedge_out: wp.array(dtype=wp.vec3d),
        light_out: wp.array(dtype=wp.vec3d),
    ):
        number = first + wp.tid()
        outside = wp.vec3d(wp.float64(-1.0), wp.float64(-1.0), wp.float64(-1.0))
        weight_out[number] = 0.0
        wedge_out[number] = outside
        light_out[number] = outside
        kept, total = candidate(scene, camera, radius, number, seed, max_depth, rr_depth)
        weight_out[number] = total
        if total <= 0.0:
            return
        if wp.static(not has_primitives) or not is_primitive_at(scene, kept.face):
            seen = to_silhouette(scene, edges, neighbours, kept.face, kept.o, kept.d)
            if seen.edge >= 0:
                wedge_out[number] = wedge_seed(scene, edges, seen)
        if wp.static(to_light):
            sampler, _pixel = seed_sampler(camera, number, seed)
            back = wp.normalize(kept.o - kept.light)
            apart = wp.length(kept.o - kept.light)
            near = kept.light + (1.0 - BLOCKED) * apart * back
            if wp.static(among_media):
                face = line(scene, sampler, -1, near, back, apart, NO_MEDIUM, 1).face
            else:
                face = visibility.closest(scene, near, back, apart).face
            if face >= 0:
                if wp.static(not has_primitives) or not is_primitive_at(scene, face):
                    lit = to_silhouette(scene, edges, neighbours, face, kept.light, back)
                    if lit.edge >= 0:
                        light_out[number] = light_seed(scene, edges, lit, kept, sample_1d(sampler, SLOT_SEED - 1))

    return seeds
