"""What paths are made of: the configuration that their kernels are compiled for, their states and their vertices."""

import functools
from dataclasses import dataclass

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import CAMERA_PERSPECTIVE
from warp_psdr.kernels.math import aligned_tangent, any_tangent
from warp_psdr.kernels.reading import bsdf_at
from warp_psdr.kernels.structs import Bsdf, Camera, Material, Scene
from warp_psdr.kernels.texture.texture import make_texture


@dataclass(frozen=True)
class PathConfig:
    """What a scene needs compiled; frozen and hashable, one kernel per value."""

    bsdfs: tuple[int, ...]
    #: Texture kinds in use per material slot c0, c1, c2, s0, s1; empty: the slot is unused.
    slots: tuple[tuple[int, ...], ...]
    two_sided: bool
    smooth: bool
    flat: bool
    uv: bool
    tangent: bool
    #: Texture kinds of area lights; empty: there are none.
    area: tuple[int, ...]
    #: Other light sources.
    lights: tuple[int, ...]
    #: True: there is no other than emitter 0.
    one_light: bool
    #: False: ``max_depth`` is 1 and only directly visible light is computed.
    scatter: bool
    hide_emitters: bool
    sampler: str
    filter: int
    ray_backend: str
    ray_width: int
    #: Kind of the camera.
    camera: int = CAMERA_PERSPECTIVE
    #: True: what a sample meets is written down (``notes.py``).
    noted: bool = False
    #: True: there are area lights, which the camera does not see (``sight.py``).
    hidden: bool = False


@wp.struct
class PathState:
    """What one vertex hands to the next."""

    alive: wp.int32
    depth: wp.int32
    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32
    throughput: wp.vec3
    pdf: wp.float32  # solid angle, of d; 0: no next-event estimate could have found what d hits
    eta: wp.float32  # product of relative refractive indices
    left: wp.int32  # face that d left by a smooth lobe, from one; 0: none
    met: wp.int32  # more than 0: the path has met a shape that matters
    seen: RayHit  # what the camera's ray meets, where ``camera_rays.py`` has traced it


@wp.func
def path_from(o: wp.vec3, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> PathState:
    """A path that starts with a ray, behind ``depth`` vertices."""
    state = PathState()
    state.alive = 1
    state.depth = depth
    state.o = o
    state.d = d
    state.t_max = t_max
    state.throughput = wp.vec3(1.0, 1.0, 1.0)
    state.eta = 1.0
    return state


@wp.struct
class PathVertex:
    """A path vertex and what was sampled there; enough to recompute every factor without tracing a ray."""

    face: wp.int32  # -1: the ray left the scene
    u: wp.float32
    v: wp.float32
    before: wp.int32  # face that the ray which found it left by a smooth lobe, -1: none
    o: wp.vec3  # where that ray started
    d: wp.vec3  # and its direction
    throughput: wp.vec3  # product of the beta before this vertex
    direct: wp.vec3  # E_n + D_n
    beta: wp.vec3
    e_weight: wp.float32  # MIS weight of the emission hit
    light: wp.int32  # emitter found by next-event estimation, -1: none, or occluded
    light_face: wp.int32
    light_u: wp.float32
    light_v: wp.float32
    light_wi: wp.vec3
    light_weight: wp.float32  # MIS weight / pdf
    lobe: wp.int32
    wo: wp.vec3
    inv_pdf: wp.float32  # 1 / (pdf q)


@wp.struct
class Frame:
    """Shading frame on the side of the incoming ray, and the scattering record of that side."""

    n: wp.vec3
    s: wp.vec3
    t: wp.vec3
    side: wp.float32  # +1, or -1 on the back of a two-sided material
    bsdf: wp.int32


@wp.func
def film_position(camera: Camera, px: wp.int32, py: wp.int32, offset: wp.vec2) -> wp.vec2:
    """Film coordinates in [0, 1]^2 of a point near the centre of a pixel of the crop window."""
    return wp.vec2(
        (wp.float32(px + camera.crop_x) + 0.5 + offset[0]) / wp.float32(camera.width),
        (wp.float32(py + camera.crop_y) + 0.5 + offset[1]) / wp.float32(camera.height),
    )


@functools.cache
def make_side(two_sided: bool):
    """Return ``side_of(scene, bsdf, behind) -> (side, scattering record of that side)``."""

    @wp.func
    def side_of(scene: Scene, bsdf: wp.int32, behind: wp.bool) -> tuple[wp.float32, wp.int32]:
        side = wp.float32(1.0)
        record = wp.int32(bsdf)
        if wp.static(two_sided):
            front = bsdf_at(scene, bsdf)
            back = behind and front.two_sided == 1
            side = wp.where(back, -1.0, 1.0)
            record = wp.where(back, front.back, bsdf)
        return side, record

    return side_of


@functools.cache
def make_framing(tangent: bool):
    """Return ``frame_on(side, n, tangent) -> Frame``, but for its scattering record."""

    @wp.func
    def frame_on(side: wp.float32, n: wp.vec3, dpdu: wp.vec3) -> Frame:
        f = Frame()
        f.side = side
        f.n = side * n
        if wp.static(tangent):
            f.s = aligned_tangent(f.n, dpdu)
        else:
            f.s = any_tangent(f.n)
        f.t = wp.cross(f.n, f.s)
        return f

    return frame_on


@functools.cache
def make_frame(two_sided: bool, tangent: bool):
    """Return ``frame_at(scene, bsdf, n, tangent, wi) -> Frame``."""
    side_of = make_side(two_sided)
    frame_on = make_framing(tangent)

    @wp.func
    def frame_at(scene: Scene, bsdf: wp.int32, n: wp.vec3, dpdu: wp.vec3, wi: wp.vec3) -> Frame:
        side, record = side_of(scene, bsdf, wp.dot(n, wi) < 0.0)
        f = frame_on(side, n, dpdu)
        f.bsdf = record
        return f

    return frame_at


@functools.cache
def make_material(slots: tuple[tuple[int, ...], ...]):
    """Return ``material_at(scene, bsdf, face, u, v, uv) -> Material``; unused slots stay 0 and cost nothing."""
    c0, c1, c2, s0, s1 = (make_texture(kinds) if kinds else None for kinds in slots)
    has = tuple(bool(kinds) for kinds in slots)

    @wp.func
    def material_at(scene: Scene, b: Bsdf, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2) -> Material:
        m = Material()
        if wp.static(has[0]):
            m.c0 = c0(scene, b.c0, face, u, v, uv)
        if wp.static(has[1]):
            if b.c1 >= 0:
                m.c1 = c1(scene, b.c1, face, u, v, uv)
        if wp.static(has[2]):
            if b.c2 >= 0:
                m.c2 = c2(scene, b.c2, face, u, v, uv)
        if wp.static(has[3]):
            if b.s0 >= 0:
                m.s0 = s0(scene, b.s0, face, u, v, uv)[0]
        if wp.static(has[4]):
            if b.s1 >= 0:
                m.s1 = s1(scene, b.s1, face, u, v, uv)[0]
        return m

    return material_at
