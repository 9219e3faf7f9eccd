"""Chains: what a ray meets on its way through smooth mirrors and glass, up to the first surface that scatters smoothly.

A *block* of a path starts at the film (q in pixels) or at a smooth vertex y (q a direction, in solid angle) and is a
function of q. Its chain c_1, ..., c_m holds delta lobes only; which lobe glass takes at c_i is the i-th bit of a
pattern that is drawn before, with the same probability for all q, so that one pattern is one integrand

    F(q) = f_s(y, q) . prod_i beta_i / P_i . L(c_m -> end)         (no f_s on the film; emission of the c_i added),

L by the path tracer. The *identity* of a chain is a hash of what is hit (``tables.group``), on which side of its
shading normal, in which cells of textures with steps, on which side of its surface the lobe leaves, and which point,
spot and directional lights reach its end: F is continuous where the identity does not change. Two of them agree by
accident with probability 2^-32.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import make_following
from warp_psdr.kernels.boundary.shadow_walk import make_shadow_walk
from warp_psdr.kernels.boundary.specular.chain_patches import make_patch
from warp_psdr.kernels.bsdf.dispatch import has_null_lobes
from warp_psdr.kernels.constants import (
    EMITTER_PROJECTOR,
    FAR,
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NULL,
    LOBE_SMOOTH,
)
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.emitter.projector import lies_in_frame
from warp_psdr.kernels.interaction import leave_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.null_surface import make_null_surface, null_model_of
from warp_psdr.kernels.medium.passage import MOST_INTERFACES
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.texture.steps import StepTextures, cell_name
from warp_psdr.kernels.transmittance import most_crossings
from warp_psdr.kernels.vertex import PathConfig, path_from
from warp_psdr.kernels.visibility import visibility_of

#: Probability of a pattern's bit: light passes glass instead of being reflected, or a surface that has smooth lobes too
#: reflects as a mirror, or lets light pass, instead of ending the chain.
GO_ON = 0.75
#: Most vertices of a chain. What lies behind more mirrors and glass in a row is left to the path tracer, and has no
#: boundary term there. A pattern has a bit for each vertex but the last.
MAX_CHAIN = 16
#: Most vertices of a path that are kept in front of it: those that it is pulled back along. A vertex that a smooth lobe
#: has found and that a smooth lobe leaves starts anew.
MAX_WINDOW = 16
#: What a ray meets: nothing; a lobe of weight zero; a smooth surface, or the last vertex; a mirror or glass.
MEETS_NOTHING, MEETS_DEAD, MEETS_SMOOTH, MEETS_DELTA = 0, 1, 2, 3
#: Multiplier of the identity's hash (2^32 over the golden ratio).
HASH_FACTOR = wp.constant(wp.uint32(0x9E3779B1))


@wp.struct
class Block:
    """Where a chain starts. On the film q = q0 + s ell (cos, sin), else q = cos(s ell) w0 + sin(s ell) w1."""

    film: wp.int32  # 1: starts at the camera
    q0: wp.vec2  # pixels of the crop window
    e: wp.vec2
    lens: wp.vec2  # ``CameraSample.lens``
    x: wp.vec3  # y
    n: wp.vec3  # geometric normal at y
    step: wp.float32  # by which rays leave the surface there
    w0: wp.vec3
    w1: wp.vec3
    ell: wp.float32  # length of the line: pixels or radians
    depth: wp.int32  # path vertices in front
    pattern: wp.uint32
    first: wp.int32  # 1: discontinuities of the first segment belong to this estimator
    medium: wp.int32  # in which the camera or a volume vertex is, or a surface is reached
    shape: wp.int32  # of that surface; -1: y is a volume vertex
    arrives: wp.vec3  # direction in which y is reached


@wp.struct
class Start:
    """The first ray of a chain."""

    x: wp.vec3  # where it counts from: the camera or y
    o: wp.vec3  # where it is traced from
    d: wp.vec3
    t_max: wp.float32


@wp.struct
class Link:
    """What a ray of a chain meets."""

    kind: wp.int32
    face: wp.int32
    u: wp.float32
    v: wp.float32
    x: wp.vec3
    ng: wp.vec3
    n: wp.vec3  # shading normal
    facing: wp.int32  # 1: the ray arrives on the front of the shading normal
    leaving: wp.int32  # 1: the lobe leaves on the front of the surface
    lobe: wp.int32  # in which the chain goes on; LOBE_SMOOTH: it ends, and only what the smooth lobes send counts
    eta: wp.float32  # index behind the interface over the one in front, as the ray arrives
    weight: wp.vec3
    emitted: wp.vec3
    o: wp.vec3  # the ray that leaves
    d: wp.vec3


@wp.func
def film_point(camera: Camera, q: wp.vec2) -> wp.vec2:
    """Film coordinates in [0, 1]^2 of a point in pixels of the crop window."""
    return wp.vec2(
        (q[0] + wp.float32(camera.crop_x)) / wp.float32(camera.width),
        (q[1] + wp.float32(camera.crop_y)) / wp.float32(camera.height),
    )


@wp.func
def film_at(block: Block, s: wp.float32) -> wp.vec2:
    return block.q0 + (s * block.ell) * block.e


@functools.cache
def make_start(camera_kind: int):
    """Return ``start_at(scene, camera, block, s) -> Start``."""
    camera_ray, _camera_origin = make_camera_ray(camera_kind)

    @wp.func
    def start_at(scene: Scene, camera: Camera, block: Block, s: wp.float32) -> Start:
        r = Start()
        if block.film == 1:
            sample = CameraSample()
            sample.film = film_point(camera, film_at(block, s))
            sample.lens = block.lens
            ray = camera_ray(scene, camera, sample)
            r.x = ray.o
            r.d = ray.d
            r.o = ray.o + ray.t_min * ray.d
            r.t_max = ray.t_max - ray.t_min
        else:
            angle = s * block.ell
            r.x = block.x
            r.d = wp.cos(angle) * block.w0 + wp.sin(angle) * block.w1
            r.o = step_beside(block.x, block.n, r.d, block.step)
            r.t_max = FAR
        return r

    return start_at


@wp.func
def hash_combine(h: wp.uint32, value: wp.int32) -> wp.uint32:
    a = (h ^ wp.uint32(value)) * HASH_FACTOR
    return a ^ (a >> wp.uint32(15))


@wp.func
def step_from(scene: Scene, face: wp.int32, step: wp.float32) -> wp.float32:
    """How far off a surface the rays of a chain start; ``step``: those of paths, which count without triangles."""
    return wp.where(is_primitive_at(scene, face), step, scene.ray_epsilon)


@functools.cache
def make_intersect_link(config: PathConfig):
    """Return ``intersect_link(scene, o, d, t_max, depth, on, max_depth) -> Link``: what a ray meets at ``depth``."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf, emitted = interaction.bsdf, interaction.emitted
    # What a delta lobe is chosen from: nothing else, a lobe that transmits, or smooth lobes. No model has three of them
    # (``warp_psdr/plan/boundary.py``).
    mixed = bsdf.eval is not None
    among_media = config.media is not None
    interfaces = among_media and null_model_of(config.surfaces.bsdfs) >= 0
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    transmissive = bsdf.relative_eta is not None
    nulls = has_null_lobes(config.surfaces.bsdfs)

    @wp.func
    def intersect_link(
        scene: Scene,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        depth: wp.int32,
        on: wp.bool,
        max_depth: wp.int32,
    ) -> Link:
        r = Link()
        hit = visibility.seen(scene, o, d, t_max, depth)
        if wp.static(interfaces):
            crossings = wp.int32(0)
            while is_interface(scene, hit.face) and crossings <= MOST_INTERFACES:
                passed = past(scene, hit.face, hit.u, hit.v, d)
                # As ``path_media.py`` casts it, to the last bit: both have to meet the same triangle.
                hit = visibility.seen(scene, passed.x + (passed.o - passed.x), d, FAR, depth)
                crossings += 1
        r.face = hit.face
        r.weight = wp.vec3(1.0, 1.0, 1.0)
        if hit.face < 0:
            return r
        r.u = hit.u
        r.v = hit.v
        at = interaction.at(scene, hit.face, hit.u, hit.v, d)
        n = at.frame.side * at.frame.n
        r.x = at.x
        r.ng = at.ng
        r.n = n
        r.kind = MEETS_SMOOTH
        r.facing = wp.where(wp.dot(n, d) <= 0.0, 1, 0)
        r.leaving = 1
        r.eta = 1.0
        last = depth + 1 >= max_depth
        if wp.static(among_media and nulls):
            # What passes without being turned does not count.
            last = last and (max_depth == 0 or not bsdf.has_null(at.model))
        if not bsdf.has_delta(at.model) or last:
            return r
        probability = wp.float32(1.0)
        r.lobe = LOBE_DELTA_REFLECTION
        if wp.static(transmissive):
            if bsdf.transmits(at.model):
                r.eta = bsdf.relative_eta(at.model, at.material, at.wi)
                probability = wp.where(on, GO_ON, 1.0 - GO_ON)
                if on:
                    r.lobe = LOBE_DELTA_TRANSMISSION
        if wp.static(nulls):
            if bsdf.has_null(at.model):
                r.lobe = LOBE_NULL
                probability = wp.float32(1.0)
                if bsdf.mirrors(at.model):
                    probability = wp.where(on, GO_ON, 1.0 - GO_ON)
                    if not on:
                        r.lobe = LOBE_DELTA_REFLECTION
        if wp.static(mixed):
            if bsdf.has_smooth(at.model):
                if not on:
                    # The chain ends here: what its smooth lobes send, and what the surface emits.
                    r.lobe = LOBE_SMOOTH
                    r.weight /= 1.0 - GO_ON
                    return r
                probability = GO_ON
        if wp.static(emitted is not None):
            if not bsdf.has_smooth(at.model):
                r.emitted = emitted(scene, hit.face, hit.u, hit.v, d)
        scattered = interaction.scatter(at, r.lobe)
        r.weight = scattered.value / probability
        r.kind = wp.where(vanishes(scattered.value), MEETS_DEAD, MEETS_DELTA)
        if wp.static(among_media and nulls):
            if r.lobe != LOBE_NULL and depth + 1 >= max_depth:
                r.kind = MEETS_DEAD
        r.d = leave_frame(at.frame, scattered.wo)
        r.leaving = wp.where(wp.dot(at.ng, r.d) >= 0.0, 1, 0)
        r.o = step_beside(at.x, at.ng, r.d, step_from(scene, hit.face, at.step))
        return r

    return intersect_link


@functools.cache
def make_chain_depth(among_media: bool):
    """Return ``(chain_depth, behind)``, which count the path vertices in front of a vertex of a chain.

    ``chain_depth(block, i, max_depth) -> int32``: most vertices of a path at the i-th vertex of a chain of the block,
    whose last one ends it; in media 0 if the i-th one does.
    ``behind(depth, lobe) -> int32``: ``depth`` of the next one.
    """

    @wp.func
    def chain_depth(block: Block, i: wp.int32, max_depth: wp.int32) -> wp.int32:
        if wp.static(among_media):
            return wp.where(i + 1 >= MAX_CHAIN, 0, max_depth)
        return wp.min(max_depth, block.depth + MAX_CHAIN)

    @wp.func
    def behind(depth: wp.int32, lobe: wp.int32) -> wp.int32:
        if wp.static(among_media):
            return depth + wp.where(lobe == LOBE_NULL, 0, 1)
        return depth + 1

    return chain_depth, behind


@wp.func
def goes_on(block: Block, i: wp.int32) -> wp.bool:
    return ((block.pattern >> wp.uint32(i)) & wp.uint32(1)) == wp.uint32(1)


@functools.cache
def make_lit(config: PathConfig):
    """Return ``lit(scene, link, light) -> bool``: whether a point, spot or directional light reaches a surface.

    None: the scene has none.
    """
    sample = make_delta_sample(config.lights.others)
    if sample is None:
        return None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    projects = EMITTER_PROJECTOR in config.lights.others

    @wp.func
    def lit(scene: Scene, x: wp.vec3, ng: wp.vec3, light: wp.int32) -> wp.bool:
        if wp.static(projects):
            if not lies_in_frame(scene, light, x):
                return False
        ls = sample(scene, scene.emitters[light], x, wp.vec2(0.5, 0.5))
        return not visibility.occluded(scene, step_beside(x, ng, ls.wi, scene.ray_epsilon), ls.wi, ls.distance)

    return lit


@functools.cache
def make_reach(config: PathConfig):
    """Return ``reach(scene, group, x, ng, light, most) -> uint32``: a name of what a light passes on its way to x.

    0: it is blocked, or crosses more than ``most`` surfaces. None: no such light passes anything.
    """
    sample = make_delta_sample(config.lights.others)
    if sample is None or not config.points_pass:
        return None
    start, onward = make_shadow_walk(config)

    @wp.func
    def reach(
        scene: Scene, group: wp.array(dtype=wp.int32), x: wp.vec3, ng: wp.vec3, light: wp.int32, most: wp.int32
    ) -> wp.uint32:
        h = wp.uint32(1)
        ls = sample(scene, scene.emitters[light], x, wp.vec2(0.5, 0.5))
        walk = start(scene, x, ng, ls)
        count = wp.int32(0)
        while walk.hit.face >= 0:
            count += 1
            if not walk.passes or count > most:
                return wp.uint32(0)
            h = hash_combine(h, group[walk.hit.face])
            walk = onward(scene, walk, ls.wi)
        return h

    return reach


@functools.cache
def make_identity(config: PathConfig):
    """Return ``identity(scene, camera, group, interpolated, steps, block, s, max_depth, links) -> uint32``.

    ``group`` numbers the faces such that coplanar neighbours are one; ``interpolated`` marks faces with interpolated
    normals; ``steps`` are the textures with steps.
    Where the first segment belongs to others, what ends there is not told apart. ``links``: how many of the first
    vertices count, without what lights them; 0: all, with it.
    """
    start_at = make_start(config.camera)
    intersect_link = make_intersect_link(config)
    lit, reach = make_lit(config), make_reach(config)
    chain_depth, behind = make_chain_depth(config.media is not None)
    patch = make_patch(config.surfaces.primitives)

    @wp.func
    def identity(
        scene: Scene,
        camera: Camera,
        group: wp.array(dtype=wp.int32),
        interpolated: wp.array(dtype=wp.int32),
        steps: StepTextures,
        block: Block,
        s: wp.float32,
        max_depth: wp.int32,
        links: wp.int32,
    ) -> wp.uint32:
        ray = start_at(scene, camera, block, s)
        o = ray.o
        d = ray.d
        t_max = ray.t_max
        h = wp.uint32(1)
        i = wp.int32(0)
        depth = block.depth
        more = wp.bool(True)
        while more:
            most = chain_depth(block, i, max_depth)
            link = intersect_link(scene, o, d, t_max, depth, goes_on(block, i), most)
            ends = link.kind < MEETS_DELTA
            mine = i > 0 or block.first == 1 or link.kind == MEETS_DELTA or link.kind == MEETS_DEAD
            if mine:
                h = hash_combine(h, link.kind)
                if link.face >= 0:
                    h = hash_combine(h, group[link.face])
                    if wp.static(patch is not None):
                        if is_primitive_at(scene, link.face):
                            h = hash_combine(h, patch(scene, link.face, link.u, link.v, link.facing))
            if link.face >= 0:
                if wp.static(config.surfaces.steps):
                    if (block.first == 1 or i > 0) and not is_primitive_at(scene, link.face):
                        h = hash_combine(h, cell_name(scene, steps, link.face, link.u, link.v))
                if interpolated[link.face] == 1 and (block.first == 1 or i > 0):
                    h = hash_combine(h, link.facing)
                if interpolated[link.face] == 1 and link.kind == MEETS_DELTA:
                    h = hash_combine(h, link.leaving)
                if wp.static(reach is not None):
                    if links == 0 and mine and link.kind == MEETS_SMOOTH and depth + 1 < max_depth:
                        for k in range(scene.emitters.shape[0]):
                            if is_delta_light(scene.emitters[k].kind):
                                name = reach(scene, group, link.x, link.ng, k, most_crossings(depth, max_depth))
                                h = hash_combine(h, wp.int32(name))
                elif wp.static(lit is not None):
                    if links == 0 and mine and link.kind == MEETS_SMOOTH and depth + 1 < max_depth:
                        for k in range(scene.emitters.shape[0]):
                            if is_delta_light(scene.emitters[k].kind):
                                if lit(scene, link.x, link.ng, k):
                                    h = hash_combine(h, k)
                                else:
                                    h = hash_combine(h, -1)
            i += 1
            depth = behind(depth, link.lobe)
            if ends or i == links:
                more = False
            else:
                o = link.o
                d = link.d
                t_max = FAR
        return h

    return identity


@functools.cache
def make_follow_chain(config: PathConfig):
    """Return ``follow_chain(scene, camera, block, s, sampler, max_depth, rr_depth) -> vec3``: F(q) without f_s.

    In media it is that of ``media_chain.py``.
    """
    start_at = make_start(config.camera)
    intersect_link = make_intersect_link(config)
    following = make_following(config)
    chain_depth, _behind = make_chain_depth(config.media is not None)

    @wp.func
    def follow_chain(
        scene: Scene,
        camera: Camera,
        block: Block,
        s: wp.float32,
        sampler: Sampler,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        ray = start_at(scene, camera, block, s)
        o = ray.o
        d = ray.d
        t_max = ray.t_max
        most = chain_depth(block, 0, max_depth)
        total = wp.vec3(0.0, 0.0, 0.0)
        weight = wp.vec3(1.0, 1.0, 1.0)
        i = wp.int32(0)
        more = wp.bool(True)
        while more:
            link = intersect_link(scene, o, d, t_max, block.depth + i, goes_on(block, i), most)
            if link.kind == MEETS_DELTA:
                total += wp.cw_mul(weight, link.emitted)
                weight = wp.cw_mul(weight, link.weight)
                o = link.o
                d = link.d
                t_max = FAR
                i += 1
            else:
                more = False
                if link.kind == MEETS_DEAD:
                    total += wp.cw_mul(weight, link.emitted)
                else:
                    state = path_from(o, d, t_max, block.depth + i)
                    seen = following(scene, sampler, state, max_depth, rr_depth, link.lobe == LOBE_SMOOTH)
                    total += wp.cw_mul(wp.cw_mul(weight, link.weight), seen.radiance)
        return total

    return follow_chain
