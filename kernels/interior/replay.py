"""Interior term by record and sweep: path replay [VSJ21] without its division (survey eq. 12 first term, eq. 55).

The radiance along a path obeys ``L_n = E_n + D_n + beta_n L_{n+1}`` (``kernels/path.py``). With the adjoint ``delta``
of a pixel and the detached prefix ``A_n = delta beta_1 ... beta_{n-1} / spp``, the derivative of one sample is

    sum_n  A_n . ( dE_n + dD_n + dbeta_n L_{n+1} ),                                         (eq. 55 for each factor g_n)

so a *backward* sweep that carries ``L_{n+1}`` needs no division by a factor: where a reflectance or a radiance is
exactly zero its derivative is still right, while textbook replay (``kernels/interior/textbook.py``) loses it.

Parametrisation (what is attached):

* smooth lobe: the next vertex and every light point are material points. Value ``f_s G J / (p G)_det`` with the flat
  triangle's ``G J`` of ``geometric_factor``; ``p``, MIS weights and roulette detached;
* the environment: a fixed world direction;
* camera and delta lobes: the next vertex is where the attached ray meets its triangle, so its barycentrics, shading
  normal and texture coordinates move too. The sweep carries the adjoint of that ray back to the vertex, or to the
  camera, that sent it;
* point, spot and directional lights: their attached position or direction.

Paths of more than K vertices are traced once with the state at every K-th vertex kept, then replayed block by block
from the last to the first, each from its own state and the same random numbers: 2 traces at most, so time is linear
in depth; memory is K records and one state a block, whatever the depth and the number of samples.

Reverse and forward mode are the same kernel with another sink. Forward mode sweeps once for each colour channel,
since a pixel's derivative has three components.
"""

import functools
from dataclasses import dataclass

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.camera import load_mat44, make_camera_sink
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_CONSTANT, EMITTER_ENVMAP, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.emitter.area import light_uv, make_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.path import (
    PathConfig,
    PathState,
    PathVertex,
    any_tangent,
    make_camera_start,
    make_frame,
    make_material,
    make_path_step,
    to_local,
)
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sink import anchor
from warp_psdr.kernels.structs import Bsdf, Camera, Material, Scene
from warp_psdr.kernels.surface import (
    VertexAdjoint,
    connection_dot,
    direction_dot,
    geometric_factor,
    make_surface,
    make_vertex_sink,
)
from warp_psdr.kernels.texture import make_texture_sink


@dataclass(frozen=True)
class Wanted:
    """Which derivatives are compiled; everything else costs nothing."""

    #: Texture values per material slot c0, c1, c2, s0, s1.
    slots: tuple[bool, ...] = (False,) * 5
    #: Texture-coordinate transforms of bitmaps in material slots and of area lights.
    to_uv: bool = False
    #: Vertex positions, vertex normals or their sources.
    shapes: bool = False
    texcoords: bool = False
    #: Radiance textures of area lights.
    radiance: bool = False
    #: What of the other lights: "radiance", "pose".
    lights: tuple[str, ...] = ()
    camera: bool = False
    #: A delta lobe's direction depends on a requested material value (index of refraction).
    bends: bool = False

    @property
    def geometry(self) -> bool:
        """Whether path vertices move at all."""
        return self.shapes or self.texcoords or self.camera or self.bends


@wp.struct
class Carry:
    """What the sweep hands from a vertex to the one before it."""

    radiance: wp.vec3  # L_{n+1}
    face: wp.int32  # vertex n + 1; -1: it left the scene, -2: there is none
    u: wp.float32
    v: wp.float32
    o: wp.vec3
    d: wp.vec3
    adjoint: VertexAdjoint  # of vertex n + 1, complete but for beta_n
    a_x: wp.vec3  # adjoint of x_n, seen as the point before vertex n + 1
    a_d: wp.vec3  # adjoint of the direction of a ray that left the scene
    dot: wp.float32  # forward mode: what the sinks returned so far


@wp.func
def frame_in_dot(n: wp.vec3, tangent: wp.vec3, wi: wp.vec3, wo: wp.vec3, a_wi: wp.vec3, a_wo: wp.vec3) -> wp.float32:
    """Local factor of the shading frame: world directions to local ones."""
    s = wp.normalize(tangent - n * wp.dot(n, tangent))
    t = wp.cross(n, s)
    return wp.dot(a_wi, to_local(s, t, n, wi)) + wp.dot(a_wo, to_local(s, t, n, wo))


@wp.func
def frame_out_dot(n: wp.vec3, tangent: wp.vec3, wi: wp.vec3, wo: wp.vec3, a_wi: wp.vec3, a_d: wp.vec3) -> wp.float32:
    """Local factor of the shading frame of a delta lobe: wi enters it, the local direction wo leaves as world d."""
    s = wp.normalize(tangent - n * wp.dot(n, tangent))
    t = wp.cross(n, s)
    return wp.dot(a_wi, to_local(s, t, n, wi)) + wp.dot(a_d, wo[0] * s + wo[1] * t + wo[2] * n)


@wp.func
def add_material(a: Material, b: Material) -> Material:
    m = Material()
    m.c0 = a.c0 + b.c0
    m.c1 = a.c1 + b.c1
    m.c2 = a.c2 + b.c2
    m.s0 = a.s0 + b.s0
    m.s1 = a.s1 + b.s1
    return m


@functools.cache
def make_material_sink(config: PathConfig, wanted: Wanted, role: str):
    """Return ``push_material(scene, target, b, face, u, v, uv, m, adjoint) -> (VertexAdjoint, float)``."""
    slide = wanted.geometry
    use = tuple(bool(kinds) and (w or slide or wanted.to_uv) for kinds, w in zip(config.slots, wanted.slots, strict=True))
    push = tuple(
        make_texture_sink(role, kinds, w, wanted.to_uv, slide) if needed else None
        for kinds, w, needed in zip(config.slots, wanted.slots, use, strict=True)
    )
    p0, p1, p2, p3, p4 = push

    @wp.func
    def push_material(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        b: Bsdf,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        m: Material,
        adjoint: VertexAdjoint,
    ) -> tuple[VertexAdjoint, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/sink.py
        a = adjoint
        total = wp.float32(0.0)
        if wp.static(use[0]):
            if b.c0 >= 0:
                t0 = p0(scene, target, b.c0, face, u, v, uv, m.c0)
                total += t0.dot
                a.uv += t0.uv
                a.u += t0.u
                a.v += t0.v
        if wp.static(use[1]):
            if b.c1 >= 0:
                t1 = p1(scene, target, b.c1, face, u, v, uv, m.c1)
                total += t1.dot
                a.uv += t1.uv
                a.u += t1.u
                a.v += t1.v
        if wp.static(use[2]):
            if b.c2 >= 0:
                t2 = p2(scene, target, b.c2, face, u, v, uv, m.c2)
                total += t2.dot
                a.uv += t2.uv
                a.u += t2.u
                a.v += t2.v
        if wp.static(use[3]):
            if b.s0 >= 0:
                t3 = p3(scene, target, b.s0, face, u, v, uv, wp.vec3(m.s0, 0.0, 0.0))
                total += t3.dot
                a.uv += t3.uv
                a.u += t3.u
                a.v += t3.v
        if wp.static(use[4]):
            if b.s1 >= 0:
                t4 = p4(scene, target, b.s1, face, u, v, uv, wp.vec3(m.s1, 0.0, 0.0))
                total += t4.dot
                a.uv += t4.uv
                a.u += t4.u
                a.v += t4.v
        return a, total

    return push_material


@functools.cache
def make_light_sink(config: PathConfig, wanted: Wanted, role: str):
    """Return ``push_light(scene, target, vertex, x, f, w_f, a_wo, w) -> (adjoint of x, float)`` for the NEE factor.

    ``radiance_of(scene, vertex, x)`` beside it gives the attached radiance of the sampled light.
    """
    emitted = make_area(config.area)[0] if config.area else None
    lights = make_lights(config.lights, role, wanted.lights) if config.lights else None
    sample = lights.sample if lights else None
    sample_vjp = lights.sample_vjp if lights else None
    environment_vjp = lights.environment_vjp if lights else None
    environment_eval = lights.environment_eval if lights else None
    has_area = bool(config.area)
    has_lights = bool(config.lights)
    has_environment = environment_eval is not None
    has_delta_lights = sample_vjp is not None
    push_radiance = make_texture_sink(role, config.area, True, wanted.to_uv, False) if has_area else None
    push_vertex = make_vertex_sink(
        role, config.smooth, config.flat, config.uv, config.tangent, wanted.texcoords, False
    )

    @wp.func
    def radiance_of(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.vec3:
        e = scene.emitters[vertex.light]
        if wp.static(has_area):
            if e.kind == EMITTER_AREA:
                return emitted(scene, e, vertex.light_face, vertex.light_u, vertex.light_v, vertex.light_wi)
        if wp.static(has_environment):
            if e.kind == EMITTER_CONSTANT or e.kind == EMITTER_ENVMAP:
                return environment_eval(scene, vertex.light_wi)
        if wp.static(has_delta_lights):
            return sample(scene, e, x, wp.vec2(0.0, 0.0)).radiance
        return wp.vec3(0.0, 0.0, 0.0)

    @wp.func
    def push_light(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        vertex: PathVertex,
        x: wp.vec3,
        w_radiance: wp.vec3,
        value: wp.float32,
        a_wo: wp.vec3,
    ) -> tuple[wp.vec3, wp.float32]:
        """Adjoint of x; ``w_radiance``: adjoint of the radiance, ``value``: A . D_n, ``a_wo``: of the direction."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/sink.py
        total = wp.float32(0.0)
        a_x = wp.vec3(0.0, 0.0, 0.0)
        e = scene.emitters[vertex.light]
        if wp.static(has_area):
            if e.kind == EMITTER_AREA:
                face = vertex.light_face
                uv = light_uv(scene, face, vertex.light_u, vertex.light_v)
                adjoint = VertexAdjoint()
                if wp.static(wanted.radiance or wanted.to_uv or wanted.texcoords):
                    ta = push_radiance(scene, target, e.texture, face, vertex.light_u, vertex.light_v, uv, w_radiance)
                    total += ta.dot
                    adjoint.uv = ta.uv
                if wp.static(wanted.geometry):
                    tri = scene.triangles[face]
                    y = (1.0 - vertex.light_u - vertex.light_v) * tri.p0 + vertex.light_u * tri.p1 + vertex.light_v * tri.p2
                    g = geometric_factor(x, y, tri.p0, tri.p1, tri.p2)
                    if g > 0.0:
                        b_x, b_y, b_p0, b_p1, b_p2, _w, _g = wp.grad(connection_dot)(
                            x, y, tri.p0, tri.p1, tri.p2, a_wo, value / g
                        )
                        a_x = b_x
                        if wp.static(wanted.shapes or wanted.texcoords):
                            adjoint.x = b_y
                            adjoint.p0 = b_p0
                            adjoint.p1 = b_p1
                            adjoint.p2 = b_p2
                            pushed = push_vertex(
                                scene, target, face, vertex.light_u, vertex.light_v, adjoint, False, x, a_wo
                            )
                            total += pushed.dot
                return a_x, total
        if wp.static(has_environment):
            if e.kind == EMITTER_CONSTANT or e.kind == EMITTER_ENVMAP:
                if wp.static(len(wanted.lights) > 0):
                    ea = environment_vjp(scene, target, vertex.light_wi, w_radiance)
                    total += ea.dot
                return a_x, total
        if wp.static(has_delta_lights):
            if wp.static(len(wanted.lights) > 0 or wanted.geometry):
                la = sample_vjp(scene, target, e, x, vertex.light_wi, w_radiance, a_wo)
                total += la.dot
                a_x = la.x
        return a_x, total

    return radiance_of, push_light


@functools.cache
def make_sweep(config: PathConfig, wanted: Wanted, role: str):
    """Return ``(sweep, finish, finish_vertex)``.

    ``sweep(scene, target, vertex, delta, carry) -> Carry``: the step from vertex n + 1 to vertex n.
    ``finish(scene, target, camera, film, carry) -> float``: the last one, from vertex 1 to the camera; in forward mode
    it returns the derivative of the sample.
    ``finish_vertex(scene, target, carry, by_ray) -> Carry``: scatter the adjoint of one vertex.
    """
    surface_at = make_surface(config.smooth, config.flat, config.uv, config.tangent)
    frame_at = make_frame(config.two_sided, config.tangent)
    material_at = make_material(config.slots)
    bsdf = make_bsdf(config.bsdfs)
    scatter_vjp = bsdf.scatter_vjp
    has_delta = scatter_vjp is not None
    push_material = make_material_sink(config, wanted, role)
    has_lights = bool(config.area or config.lights)
    radiance_of, push_light = make_light_sink(config, wanted, role) if has_lights else (None, None)
    push_vertex = make_vertex_sink(
        role, config.smooth, config.flat, config.uv, config.tangent, wanted.texcoords, True
    )
    push_camera = make_camera_sink(role) if wanted.camera else None
    emission = bool(config.area) and (wanted.radiance or wanted.to_uv or wanted.geometry)
    push_emission = (
        make_texture_sink(role, config.area, wanted.radiance, wanted.to_uv, wanted.geometry) if emission else None
    )
    lights = make_lights(config.lights, role, wanted.lights) if config.lights else None
    environment_vjp = lights.environment_vjp if lights else None
    environment = environment_vjp is not None and (bool(wanted.lights) or wanted.geometry)
    geometry = wanted.geometry
    materials = any(wanted.slots) or wanted.to_uv or geometry
    light_terms = materials or wanted.radiance or bool(wanted.lights)
    area_radiance = bool(config.area) and (wanted.radiance or wanted.to_uv or wanted.texcoords)
    push_lights = has_lights and (geometry or area_radiance or bool(wanted.lights))

    @wp.func
    def finish_vertex(
        scene: Scene, target: wp.array(dtype=wp.float32), carry: Carry, by_ray: wp.bool
    ) -> Carry:
        """Scatter the adjoint of vertex n + 1; ``a_x`` and ``a_d`` of the result are those of its ray, if attached."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/sink.py
        c = carry
        if carry.face >= 0:
            pushed = push_vertex(
                scene, target, carry.face, carry.u, carry.v, carry.adjoint, by_ray, carry.o, carry.d
            )
            c.dot += pushed.dot
            c.a_x = carry.a_x + pushed.o
            c.a_d = pushed.d
        return c

    @wp.func
    def sweep(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: PathVertex, delta: wp.vec3, carry_in: Carry
    ) -> Carry:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/sink.py
        carry = carry_in
        result = Carry()
        a_n = wp.cw_mul(delta, vertex.throughput)
        result.face = vertex.face
        result.u = vertex.u
        result.v = vertex.v
        result.o = vertex.o
        result.d = vertex.d
        result.radiance = vertex.direct + wp.cw_mul(vertex.beta, carry.radiance)

        if vertex.face < 0:
            if wp.static(environment):
                if vertex.e_weight > 0.0:
                    ea = environment_vjp(scene, target, vertex.d, vertex.e_weight * a_n)
                    result.dot = carry.dot + ea.dot
                    result.a_d = ea.x
            return result

        total = carry.dot
        adjoint = VertexAdjoint()
        surface = surface_at(scene, vertex.face, vertex.u, vertex.v)
        shape = scene.shapes[surface.shape]

        # E_n: emission met by the incoming ray.
        if wp.static(emission):
            if shape.emitter >= 0 and vertex.e_weight > 0.0 and wp.dot(surface.ng, vertex.d) < 0.0:
                e = scene.emitters[shape.emitter]
                ta = push_emission(
                    scene, target, e.texture, vertex.face, vertex.u, vertex.v, surface.uv, vertex.e_weight * a_n
                )
                total += ta.dot
                adjoint.uv = ta.uv
                adjoint.u = ta.u
                adjoint.v = ta.v

        if vertex.lobe == LOBE_NONE and vertex.light < 0:
            result.dot = total
            result.adjoint = adjoint
            return result

        if wp.static(light_terms):
            wi_world = -vertex.d
            frame = frame_at(scene, shape.bsdf, surface.n, surface.tangent, wi_world)
            b = scene.bsdfs[frame.bsdf]
            material = material_at(scene, b, vertex.face, vertex.u, vertex.v, surface.uv)
            wi = to_local(frame.s, frame.t, frame.n, wi_world)
            a_material = Material()
            a_wi_world = wp.vec3(0.0, 0.0, 0.0)
            a_frame_n = wp.vec3(0.0, 0.0, 0.0)
            a_tangent = wp.vec3(0.0, 0.0, 0.0)
            tangent = frame.s
            if wp.static(config.tangent):
                tangent = surface.tangent

            # D_n: next-event estimate.
            if wp.static(has_lights):
                if vertex.light >= 0:
                    wo = to_local(frame.s, frame.t, frame.n, vertex.light_wi)
                    radiance = radiance_of(scene, vertex, surface.x)
                    w_f = vertex.light_weight * wp.cw_mul(a_n, radiance)
                    a_wo_world = wp.vec3(0.0, 0.0, 0.0)
                    if wp.static(materials):
                        fa = bsdf.eval_vjp(b.model, material, wi, wo, w_f)
                        a_material = fa.material
                        if wp.static(geometry):
                            g_n, g_t, g_wi, g_wo, _a, _b = wp.grad(frame_in_dot)(
                                frame.n, tangent, wi_world, vertex.light_wi, fa.wi, fa.wo
                            )
                            a_frame_n += g_n
                            a_tangent += g_t
                            a_wi_world += g_wi
                            a_wo_world = g_wo
                    if wp.static(push_lights):
                        f = bsdf.eval(b.model, material, wi, wo)
                        a_x, dot = push_light(
                            scene, target, vertex, surface.x,
                            vertex.light_weight * wp.cw_mul(a_n, f), wp.dot(w_f, f), a_wo_world,
                        )  # fmt: skip
                        adjoint.x += a_x
                        total += dot

            # beta_n L_{n+1}.
            if wp.static(materials):
                if vertex.lobe == LOBE_SMOOTH:
                    wo = to_local(frame.s, frame.t, frame.n, vertex.wo)
                    w_f = vertex.inv_pdf * wp.cw_mul(a_n, carry.radiance)
                    fa = bsdf.eval_vjp(b.model, material, wi, wo, w_f)
                    a_material = add_material(a_material, fa.material)
                    if wp.static(geometry):
                        g_n, g_t, g_wi, g_wo, _a, _b = wp.grad(frame_in_dot)(
                            frame.n, tangent, wi_world, vertex.wo, fa.wi, fa.wo
                        )
                        a_frame_n += g_n
                        a_tangent += g_t
                        a_wi_world += g_wi
                        if carry.face >= 0:
                            tri = scene.triangles[carry.face]
                            y = (1.0 - carry.u - carry.v) * tri.p0 + carry.u * tri.p1 + carry.v * tri.p2
                            g = geometric_factor(surface.x, y, tri.p0, tri.p1, tri.p2)
                            if g > 0.0:
                                a_g = wp.dot(wp.cw_mul(a_n, vertex.beta), carry.radiance) / g
                                b_x, b_y, b_p0, b_p1, b_p2, _wo, _g = wp.grad(connection_dot)(
                                    surface.x, y, tri.p0, tri.p1, tri.p2, g_wo, a_g
                                )
                                adjoint.x += b_x
                                carry.adjoint.x = carry.adjoint.x + b_y
                                carry.adjoint.p0 = carry.adjoint.p0 + b_p0
                                carry.adjoint.p1 = carry.adjoint.p1 + b_p1
                                carry.adjoint.p2 = carry.adjoint.p2 + b_p2
                        carry.dot = wp.float32(0.0)
                        done = finish_vertex(scene, target, carry, False)
                        adjoint.x += done.a_x
                        total += done.dot
                if wp.static(has_delta):
                    if vertex.lobe > LOBE_SMOOTH:
                        w = vertex.inv_pdf * wp.cw_mul(a_n, carry.radiance)
                        wo = to_local(frame.s, frame.t, frame.n, vertex.wo)
                        a_d = wp.vec3(0.0, 0.0, 0.0)
                        if wp.static(geometry):
                            carry.dot = wp.float32(0.0)
                            done = finish_vertex(scene, target, carry, True)
                            total += done.dot
                            adjoint.x += done.a_x
                            a_d = done.a_d
                        fa = scatter_vjp(
                            b.model, material, wi, vertex.lobe, w, to_local(frame.s, frame.t, frame.n, a_d)
                        )
                        a_material = add_material(a_material, fa.material)
                        if wp.static(geometry):
                            g_n, g_t, g_wi, _wo, _a, _b = wp.grad(frame_out_dot)(
                                frame.n, tangent, wi_world, wo, fa.wi, a_d
                            )
                            a_frame_n += g_n
                            a_tangent += g_t
                            a_wi_world += g_wi

                adjoint, dot = push_material(
                    scene, target, b, vertex.face, vertex.u, vertex.v, surface.uv, a_material, adjoint
                )
                total += dot
            if wp.static(geometry):
                adjoint.n = frame.side * a_frame_n
                if wp.static(config.tangent):
                    adjoint.tangent = a_tangent
                # wi = normalize(x_{n-1} - x_n).
                b_x, b_prev, _a = wp.grad(direction_dot)(surface.x, vertex.o, a_wi_world)
                adjoint.x += b_x
                result.a_x = b_prev
        result.adjoint = adjoint
        result.dot = total
        return result

    @wp.func
    def finish(
        scene: Scene, target: wp.array(dtype=wp.float32), camera: Camera, film: wp.vec2, carry: Carry
    ) -> wp.float32:
        if wp.static(not geometry):
            return carry.dot
        else:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/sink.py
            done = finish_vertex(scene, target, carry, True)
            total = done.dot
            if wp.static(wanted.camera):
                total += push_camera(scene, target, camera, film, done.a_x, done.a_d)
            return total

    return sweep, finish, finish_vertex


@functools.cache
def make_replay_kernel(config: PathConfig, wanted: Wanted, role: str, block: int, blocks: int):
    """Return the kernel of ``interior.Replay``.

    Args:
        config: what the scene needs.
        wanted: what is differentiated.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient) or "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image).
        block: K, the number of vertices kept at a time.
        blocks: the most blocks that a path can have; 1 compiles the replay out.
    """
    path_step = make_path_step(config, True)
    start = make_camera_start(config)
    sweep, finish, _finish_vertex = make_sweep(config, wanted, role)
    channels = 3 if role == "forward" else 1

    @wp.kernel(module="unique", enable_backward=False)
    def replay(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        pixels: wp.array(dtype=wp.int32),
        first_pixel: wp.int32,
        first_sample: wp.int32,
        samples: wp.int32,
        scale: wp.float32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        adjoint: wp.array2d(dtype=wp.vec3),
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixels[first_pixel + wp.tid()]
        px = pixel % camera.crop_width
        py = pixel // camera.crop_width
        record = wp.zeros(shape=(wp.static(block),), dtype=PathVertex)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=PathState)
        delta = wp.vec3(scale, scale, scale)
        if wp.static(role == "reverse"):
            delta = scale * adjoint[py, px]
            if delta[0] == 0.0 and delta[1] == 0.0 and delta[2] == 0.0:
                return
        derivative = wp.vec3(0.0, 0.0, 0.0)
        origin = load_mat44(scene.values, camera.to_world)
        for i in range(samples):
            sampler = Sampler()
            sampler.pixel = wp.uint32(pixel)
            sampler.index = wp.uint32(first_sample + i)
            sampler.seed = seed
            state, film = start(scene, camera, px, py, sampler)
            count = wp.int32(0)
            while state.alive == 1:
                if wp.static(blocks > 1):
                    if count % wp.static(block) == 0:
                        states[count // wp.static(block)] = state
                vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
                if count == 0:
                    vertex.o = wp.vec3(origin[0, 3], origin[1, 3], origin[2, 3])
                record[count % wp.static(block)] = vertex
                count += 1
            loaded = (count - 1) // wp.static(block)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(role == "forward"):
                    weight = wp.vec3(0.0, 0.0, 0.0)
                    weight[channel] = delta[channel]
                carry = Carry()
                carry.face = -2
                n = count - 1
                while n >= 0:
                    if wp.static(blocks > 1):
                        if n // wp.static(block) != loaded:
                            loaded = n // wp.static(block)
                            again = states[loaded]
                            for j in range(wp.static(block)):
                                if again.alive == 1:
                                    vertex, again = path_step(scene, sampler, again, max_depth, rr_depth)
                                    if loaded == 0 and j == 0:
                                        vertex.o = wp.vec3(origin[0, 3], origin[1, 3], origin[2, 3])
                                    record[j] = vertex
                    carry = sweep(scene, target, record[n % wp.static(block)], weight, carry)
                    n -= 1
                total = finish(scene, target, camera, film, carry)
                if wp.static(role == "forward"):
                    derivative[channel] = derivative[channel] + total
        if wp.static(role == "forward"):
            image_out[py, px] = image_out[py, px] + derivative

    return replay
