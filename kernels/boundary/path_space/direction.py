"""Directions of boundary segments at an edge point [ZMY*20, section 6.2].

One-sample MIS (balance heuristic) joins two techniques, in solid angle at x_b: the wedge between the face planes, and a
point of a light for which the edge is a silhouette.

Derivation: ``docs/theory/boundary.md#directions-at-an-edge-point``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges
from warp_psdr.kernels.constants import INV_FOUR_PI, PI
from warp_psdr.kernels.emitter.area import make_pdf_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig


@wp.struct
class Wedge:
    """Directions in which an edge is a silhouette, modulo pi about the tangent."""

    t: wp.vec3
    a: wp.vec3
    b: wp.vec3
    start: wp.float32  # of psi
    width: wp.float32


@wp.struct
class Direction:
    """A sampled direction. ``light``: the point, spot or directional light that it ends in, else -1."""

    w: wp.vec3
    valid: wp.int32
    light: wp.int32
    irradiance: wp.vec3  # of that light at x_b, over its selection probability
    aimed: wp.int32  # 1: at a light point, which has to be the first hit
    distance: wp.float32
    face: wp.int32  # of that point and its barycentrics; -1: the environment's
    u: wp.float32
    v: wp.float32
    share: wp.float32  # of the light's triangle from which the point was drawn


@wp.func
def wedge_at(scene: Scene, edges: Edges, point: EdgePoint) -> Wedge:
    r = Wedge()
    r.t = wp.normalize(point.p1 - point.p0)
    first = edges.first[point.edge]
    tri = scene.triangles[edges.faces[first]]
    into = (tri.p0 - point.p0) + (tri.p1 - point.p0) + (tri.p2 - point.p0)
    r.a = wp.normalize(into - wp.dot(into, r.t) * r.t)
    r.b = wp.cross(r.t, r.a)
    r.start = 0.0
    r.width = PI
    if edges.first[point.edge + 1] - first == 2:
        other = scene.triangles[edges.faces[first + 1]]
        into_b = (other.p0 - point.p0) + (other.p1 - point.p0) + (other.p2 - point.p0)
        angle = wp.atan2(wp.dot(into_b, r.b), wp.dot(into_b, r.a))
        r.start = wp.max(angle, 0.0)
        r.width = PI - wp.abs(angle)
    return r


@wp.func
def pdf_wedge(wedge: Wedge) -> wp.float32:
    return INV_FOUR_PI * PI / wp.max(wedge.width, 1.0e-12)


@wp.func
def wedge_direction(wedge: Wedge, u: wp.vec2) -> wp.vec3:
    """Direction at a point of the unit square, uniform in solid angle over the wedge and its opposite."""
    cosine = 2.0 * u[0] - 1.0
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    half = wp.where(u[1] < 0.5, 0.0, 1.0)
    psi = wedge.start + (2.0 * u[1] - half) * wedge.width + half * PI
    return cosine * wedge.t + sine * (wp.cos(psi) * wedge.a + wp.sin(psi) * wedge.b)


@wp.func
def wedge_square(wedge: Wedge, w: wp.vec3) -> wp.vec2:
    """Point of the unit square that ``wedge_direction`` maps to w; a coordinate outside of [0, 1): w is not in it."""
    psi = wp.atan2(wp.dot(w, wedge.b), wp.dot(w, wedge.a)) - wedge.start
    psi = wp.where(psi < 0.0, psi + 2.0 * PI, psi)
    half = wp.where(psi < PI, 0.0, 1.0)
    inside = psi - half * PI
    if inside > wedge.width or wedge.width <= 0.0:
        return wp.vec2(0.5 * (wp.dot(w, wedge.t) + 1.0), 2.0)
    return wp.vec2(0.5 * (wp.dot(w, wedge.t) + 1.0), 0.5 * (inside / wedge.width + half))


@functools.cache
def make_pdf_light(lights: LightConfig, uniform: bool = False):
    """Return ``pdf_light(scene, face, u, v, w, t) -> float``: the solid-angle density of light sampling.

    For a direction whose first hit is (face, u, v), or none (face -1), at distance t. ``uniform`` as in
    ``make_pdf_area``.
    """
    exact = make_shining(lights.shining)
    pdf_area = make_pdf_area(lights.shining, uniform)
    others = make_lights(lights.others, None, ()) if lights.others else None
    environment_pdf = others.environment_pdf if others else None
    has_environment = environment_pdf is not None

    @wp.func
    def pdf_light(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, w: wp.vec3, t: wp.float32) -> wp.float32:
        pdf = wp.float32(0.0)
        if face < 0:
            if wp.static(has_environment):
                pdf = environment_pdf(scene, w) * scene.emitters[scene.environment].probability
        else:
            if wp.static(bool(lights.area)):
                emitter = scene.shapes[scene.triangles[face].shape].emitter
                facing = wp.dot(scene.triangles[face].normal, w)
                if wp.static(exact is not None):
                    tri = scene.triangles[face]
                    if is_primitive(tri):
                        facing = wp.dot(exact.cross(tri, u, v), w)
                if emitter >= 0 and facing < 0.0:
                    record = scene.emitters[emitter]
                    pdf = pdf_area(scene, record, face, u, v, w, t) * record.probability
        return pdf

    return pdf_light
