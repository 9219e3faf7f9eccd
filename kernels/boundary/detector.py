"""The two sub-paths at the ends of a boundary segment: radiance from the source, importance towards the sensor.

The source's side is the ordinary path tracer; the sensor's side is a walk from x_1 towards the camera that scatters
importance and is connected to the camera at every vertex.

Derivation: ``docs/theory/boundary.md#sub-paths-of-a-segment``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.scattering import ROULETTE_MAX
from warp_psdr.kernels.sensor.projection import FilmPoint, make_projection
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import LightConfig, PathConfig, PathState, SurfaceConfig, path_from
from warp_psdr.kernels.visibility import visibility_of

#: Cosines below it count as zero where one is divided by: such a vertex is seen or lit exactly edge-on.
MIN_COSINE = 1.0e-6

#: Lengths of the sensor's sub-path that one path from the source's side serves; longer ones take another.
ROW_COUNT = 8
#: A number of vertices that no path has.
NEVER = 1 << 30
ROWS = wp.types.matrix(shape=(ROW_COUNT, 3), dtype=wp.float32)


@wp.struct
class Walk:
    """A vertex of the walk towards the sensor."""

    alive: wp.int32
    face: wp.int32
    u: wp.float32
    v: wp.float32
    x: wp.vec3
    to: wp.vec3  # direction towards the vertex before
    weight: wp.vec3


@wp.struct
class Incident:
    """Radiance that arrives at the end of a sensor's sub-path, whatever its length.

    One path from the source's side serves all lengths: behind more vertices it ends earlier. ``total`` is its radiance
    behind up to ``first + cut - 1`` vertices; from there on row i is that behind ``first + i``.
    """

    first: wp.int32  # vertices of the shortest sub-path; 0: nothing has been traced
    cut: wp.int32  # NEVER: at no length, whatever path had been drawn
    total: wp.vec3
    rows: ROWS


@wp.func
def constant(radiance: wp.vec3, k: wp.int32) -> Incident:
    """The same radiance behind k vertices and behind more."""
    r = Incident()
    r.first = k
    r.cut = NEVER
    r.total = radiance
    return r


@wp.func
def radiance_behind(incident: Incident, k: wp.int32) -> wp.vec3:
    """Radiance behind k vertices."""
    i = k - incident.first
    if i < incident.cut:
        return incident.total
    return wp.vec3(incident.rows[i, 0], incident.rows[i, 1], incident.rows[i, 2])


@wp.func
def scaled(incident: Incident, known: wp.vec3, factor: wp.float32) -> Incident:
    """``known`` plus ``factor`` times what there is beyond it."""
    r = incident
    r.total = known + factor * (incident.total - known)
    for i in range(ROW_COUNT):
        for c in range(3):
            r.rows[i, c] = known[c] + factor * (incident.rows[i, c] - known[c])
    return r


@wp.func
def difference(a: Incident, b: Incident) -> Incident:
    """What arrives by one path less what arrives by another, both behind the same numbers of vertices."""
    r = Incident()
    r.first = a.first
    r.cut = wp.min(a.cut, b.cut)
    r.total = a.total - b.total
    for i in range(ROW_COUNT):
        apart = radiance_behind(a, a.first + i) - radiance_behind(b, b.first + i)
        for c in range(3):
            r.rows[i, c] = apart[c]
    return r


@wp.func
def serves_length(incident: Incident, k: wp.int32) -> wp.bool:
    """Whether ``radiance_behind`` is known for k vertices, and may be used.

    How many lengths a path serves must not depend on how it ended: if dark ones served more, what is left for new paths
    would not make up for it. So all serve ``ROW_COUNT``, or all that there are.
    """
    return incident.first > 0 and (incident.cut == NEVER or k - incident.first < ROW_COUNT)


@wp.struct
class Connection:
    """A vertex of the walk as the camera sees it."""

    weight: wp.vec3  # 0: not seen
    at: FilmPoint


@wp.struct
class IncidentRadiance:
    """What arrives against a ray, and the surface that sends it."""

    radiance: wp.vec3
    face: wp.int32  # -1: none
    x: wp.vec3


@functools.cache
def make_following(config: PathConfig):
    """Return ``following(scene, sampler, start, max_depth, rr_depth, smooth) -> IncidentRadiance``: of a path.

    ``smooth``: of the first surface that it meets only what its smooth lobes send.
    """
    path_step = make_path_step(config, False)
    point_at = make_point_at(config.surfaces.primitives)

    @wp.func
    def following(
        scene: Scene, sampler: Sampler, start: PathState, max_depth: wp.int32, rr_depth: wp.int32, smooth: wp.bool
    ) -> IncidentRadiance:
        r = IncidentRadiance()
        vertex, state = path_step(scene, sampler, start, max_depth, rr_depth)
        r.radiance = wp.cw_mul(vertex.throughput, vertex.direct)
        r.face = vertex.face
        if vertex.face >= 0:
            tri = scene.triangles[vertex.face]
            r.x = point_at(scene, tri, vertex.u, vertex.v)
        if smooth and vertex.lobe > LOBE_SMOOTH:
            return r
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            r.radiance += wp.cw_mul(vertex.throughput, vertex.direct)
        return r

    return following


@functools.cache
def make_incident_radiance(config: PathConfig):
    """Return ``incident_radiance(scene, sampler, o, d, t_max, depth, max_depth, rr_depth) -> IncidentRadiance``.

    ``depth`` counts the path vertices in front of what the ray meets.
    """
    following = make_following(config)

    @wp.func
    def incident_radiance(
        scene: Scene,
        sampler: Sampler,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        depth: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> IncidentRadiance:
        return following(scene, sampler, path_from(o, d, t_max, depth), max_depth, rr_depth, False)

    return incident_radiance


@functools.cache
def make_incident(config: PathConfig):
    """Return ``incident(scene, sampler, o, d, t_max, depth, max_depth, rr_depth) -> Incident``, from ``depth`` on.

    The path is that of ``make_incident_radiance``. With at most N = max_depth vertices, vertex j of it contributes its
    emission E_j behind i vertices if i + j < N, and D_j, what it scatters of light that next-event estimation finds, if
    i + j + 1 < N.
    """
    path_step = make_path_step(config, False)
    emitted = make_interaction(config.surfaces, config.lights).emitted

    @wp.func
    def incident(
        scene: Scene,
        sampler: Sampler,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        depth: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        r = Incident()
        r.first = depth
        r.cut = NEVER
        rows = ROWS()
        state = path_from(o, d, t_max, depth)
        while state.alive == 1:
            # Behind first + cut vertices the path ends here.
            if max_depth >= 0:
                r.cut = max_depth - 1 - state.depth
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            value = wp.cw_mul(vertex.throughput, vertex.direct)
            if max_depth >= 0 and r.cut < ROW_COUNT:
                last = r.total
                if vertex.face < 0:
                    last += value
                else:
                    if wp.static(emitted is not None):
                        own = emitted(scene, vertex.face, vertex.u, vertex.v, vertex.d)
                        last += vertex.e_weight * wp.cw_mul(vertex.throughput, own)
                for c in range(3):
                    rows[r.cut, c] = last[c]
            r.total += value
        r.rows = rows
        return r

    return incident


@wp.struct
class Turn:
    """How a walk of importance leaves a surface."""

    valid: wp.int32
    w: wp.vec3
    o: wp.vec3  # where the ray starts
    weight: wp.vec3  # f over the density of w, with the cosines of shading normals
    ng: wp.vec3
    shape: wp.int32


@functools.cache
def make_sensor_turn(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``turn(scene, face, u, v, x, to, u4) -> Turn``: a direction drawn at x; light comes from ``to``."""
    interaction = make_interaction(surfaces, lights)

    @wp.func
    def turn(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, x: wp.vec3, to: wp.vec3, u4: wp.vec4) -> Turn:
        r = Turn()
        here = interaction.at(scene, face, u, v, -to)
        bs = interaction.sample(here, u4[0], wp.vec2(u4[2], u4[3]))
        cosine = wp.abs(wp.dot(here.ng, to))
        if bs.pdf <= 0.0 or bs.lobe != LOBE_SMOOTH or cosine < MIN_COSINE:
            return r
        r.w = leave_frame(here.frame, bs.wo)
        # Importance leaves along the new direction.
        arrives = here.wi
        here.wi = bs.wo
        r.weight = (wp.abs(wp.dot(here.ng, r.w)) / (cosine * bs.pdf)) * interaction.eval(here, arrives)
        r.o = step_beside(x, here.ng, r.w, here.step)
        r.ng = here.ng
        r.shape = here.shape
        r.valid = 1
        return r

    return turn


@functools.cache
def make_walk(config: PathConfig):
    """Return ``(connect, extend)``.

    ``connect(scene, camera, walk, lens) -> Connection``, with ``lens`` from ``camera.make_lens``;
    ``extend(scene, walk, u4, roulette) -> Walk``: the next vertex.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    project = make_projection(config.camera)[0]
    point_at = make_point_at(config.surfaces.primitives)
    turn = make_sensor_turn(config.surfaces, config.lights)

    @wp.func
    def connect(scene: Scene, camera: Camera, walk: Walk, lens: wp.vec2) -> Connection:
        r = Connection()
        r.at = project(scene, camera, walk.x, lens)
        if r.at.valid == 0:
            return r
        if wp.static(config.rays.hidden):
            if scene.shapes[scene.triangles[walk.face].shape].emitter >= 0:
                return r
        towards = r.at.origin - walk.x
        w = wp.normalize(towards)
        here = interaction.at(scene, walk.face, walk.u, walk.v, -w)
        f = interaction.eval(here, enter_frame(here.frame, walk.to))
        cosine = wp.abs(wp.dot(here.ng, walk.to))
        if vanishes(f) or cosine < MIN_COSINE:
            return r
        o = step_beside(walk.x, here.ng, w, here.step)
        ray = r.at.origin - o
        length = wp.length(ray)
        if visibility.hidden_from_camera(scene, o, ray / length, length - r.at.near):
            return r
        factor = wp.abs(wp.dot(here.ng, w)) * r.at.per_area / cosine
        r.weight = factor * wp.cw_mul(walk.weight, f)
        return r

    @wp.func
    def extend(scene: Scene, walk: Walk, u4: wp.vec4, t_max: wp.float32, roulette: wp.bool) -> Walk:
        r = Walk()
        left = turn(scene, walk.face, walk.u, walk.v, walk.x, walk.to, u4)
        if left.valid == 0:
            return r
        weight = wp.cw_mul(walk.weight, left.weight)
        if vanishes(weight):
            return r
        if roulette:
            survival = wp.min(wp.max(weight), ROULETTE_MAX)
            if u4[1] >= survival:
                return r
            weight /= survival
        hit = visibility.closest(scene, left.o, left.w, t_max)
        if hit.face < 0:
            return r
        tri = scene.triangles[hit.face]
        r.alive = 1
        r.face = hit.face
        r.u = hit.u
        r.v = hit.v
        r.x = point_at(scene, tri, hit.u, hit.v)
        r.to = -left.w
        r.weight = weight
        return r

    return connect, extend
