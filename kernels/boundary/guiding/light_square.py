"""Points of light sources as points of the unit square, and back: the coordinates of the technique "light".

u_1 chooses the emitter by its selection probability. At an area light, the remainder of u_1 chooses a triangle by its
area, and the next remainder and u_2 are coordinates on the stripe of that triangle for which the edge is a silhouette
(``stripe.py``). Exact shapes and environments have the coordinates of their own sampling (``primitive/shining.py``),
whatever the edge. Point, spot and directional lights have no further freedom. u_1 is double precision throughout:
behind 10^4 triangles a float would have ten bits left. The inverse map weighs a direction that another technique drew.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.stripe import stripe_at, stripe_point, stripe_square
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges
from warp_psdr.kernels.boundary.path_space.direction import Direction
from warp_psdr.kernels.constants import EMITTER_CONSTANT, EMITTER_ENVMAP, FAR
from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.emitter.env_cells import cell_density, cell_height, load_matrix, locate
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.sampling import sphere_to_square
from warp_psdr.kernels.structs import Emitter, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import LightConfig


@wp.func
def within(cdf: wp.array(dtype=wp.float32), i: wp.int32, u: wp.float64) -> wp.float64:
    """Position of u in the interval i of cumulative probabilities, in [0, 1]."""
    low = wp.float64(cdf[i])
    return (u - low) / (wp.float64(cdf[i + 1]) - low)


@wp.func
def outside_of(cdf: wp.array(dtype=wp.float32), i: wp.int32, t: wp.float64) -> wp.float64:
    """The inverse of ``within``."""
    low = wp.float64(cdf[i])
    return low + t * (wp.float64(cdf[i + 1]) - low)


@wp.func
def ramp_share(t: wp.float32, a: wp.float32, b: wp.float32) -> wp.float32:
    """Cumulative probability at t of the density that runs from a to b: the inverse of ``linear_offset``."""
    return t * (2.0 * a + t * (b - a)) / (a + b)


@wp.func
def envmap_to_square(scene: Scene, emitter: Emitter, w: wp.vec3) -> wp.vec2:
    """The inverse of the environment map's own sampling."""
    texture = scene.textures[emitter.texture]
    rows = texture.height - 1
    v = wp.normalize(wp.inverse(load_matrix(scene.values, emitter.to_world)) * w)
    cell = locate(texture, v)
    t = cell_height(cell, v, rows)
    b = cell_density(scene, texture, cell)
    x = ramp_share(cell.fx, (1.0 - t) * b.b00 + t * b.b01, (1.0 - t) * b.b10 + t * b.b11)
    y = ramp_share(t, b.b00 + b.b10, b.b01 + b.b11)
    column = cell.row * (texture.width + 1) + cell.column
    return wp.vec2(
        wp.float32(outside_of(scene.env_conditional, column, wp.float64(x))),
        wp.float32(outside_of(scene.env_marginal, cell.row, wp.float64(y))),
    )


@functools.cache
def make_light_square(lights: LightConfig):
    """Return ``(aim, coordinates)``.

    ``aim(scene, edges, point, u1, u2) -> Direction``: from an edge point to the light point of the coordinates.
    ``coordinates(scene, edges, point, face, u, v, w) -> vec3d``: of the point (face, u, v) of an area light, or for
    face < 0 of the direction w towards the environment; negative: no light is there. The third entry is the share of
    the light's triangle from which the point was drawn.
    """
    has_area = bool(lights.area)
    exact = make_shining(lights.shining)
    other = make_lights(lights.others, None, ()).sample if lights.others else None
    has_other = other is not None
    constant = EMITTER_CONSTANT in lights.others
    envmap = EMITTER_ENVMAP in lights.others

    @wp.func
    def aim(scene: Scene, edges: Edges, point: EdgePoint, u1: wp.float64, u2: wp.float64) -> Direction:
        r = Direction()
        r.light = -1
        r.face = -1
        r.share = 1.0
        index = find_interval_64(scene.emitter_cdf, 0, scene.emitters.shape[0], u1)
        emitter = scene.emitters[index]
        rest = within(scene.emitter_cdf, index, u1)
        if wp.static(has_area):
            if emitter.kind == 0:
                k = find_interval_64(scene.face_cdf, emitter.cdf_offset, emitter.face_count, rest)
                rest = within(scene.face_cdf, emitter.cdf_offset + k, rest)
                r.face = emitter.first_face + k
                tri = scene.triangles[r.face]
                if wp.static(exact is not None):
                    if is_primitive(tri):
                        q = exact.draw(tri, point.x, wp.vec2(wp.float32(rest), wp.float32(u2)))
                        r.u = q[0]
                        r.v = q[1]
                        r.w = exact.position(tri, r.u, r.v) - point.x
                        r.distance = wp.length(r.w)
                        r.w = r.w / r.distance
                        # Of no distance it is not a number, and not below 0; here as below.
                        if wp.dot(exact.cross(tri, r.u, r.v), r.w) < 0.0:
                            r.valid = 1
                            r.aimed = 1
                        return r
                stripe = stripe_at(scene, edges, point, r.face)
                r.share = stripe.share
                b = stripe_point(stripe, rest, u2)
                r.u = b[0]
                r.v = b[1]
                y = point_on(tri, b[0], b[1]) - point.x
                r.distance = wp.length(y)
                if stripe.share > 0.0:
                    r.w = y / r.distance
                    if wp.dot(tri.normal, r.w) < 0.0:
                        r.valid = 1
                        r.aimed = 1
        if wp.static(has_other):
            if emitter.kind != 0:
                ls = other(scene, emitter, point.x, wp.vec2(wp.float32(rest), wp.float32(u2)))
                if ls.pdf > 0.0:
                    r.valid = 1
                    r.w = ls.wi
                    r.distance = ls.distance
                    if ls.delta == 1:
                        r.light = index
                        r.irradiance = ls.radiance / (ls.pdf * emitter.probability)
                    else:
                        r.aimed = 1
                        r.distance = FAR
        return r

    @wp.func
    def coordinates(
        scene: Scene, edges: Edges, point: EdgePoint, face: wp.int32, u: wp.float32, v: wp.float32, w: wp.vec3
    ) -> wp.vec3d:
        none = wp.float64(-1.0)
        r = wp.vec3d(none, none, wp.float64(1.0))
        if face >= 0:
            if wp.static(has_area):
                tri = scene.triangles[face]
                index = scene.shapes[tri.shape].emitter
                if wp.static(exact is not None):
                    if is_primitive(tri):
                        if index >= 0 and wp.dot(exact.cross(tri, u, v), w) < 0.0:
                            q = exact.square(tri, point.x, u, v)
                            first = outside_of(scene.face_cdf, scene.emitters[index].cdf_offset, wp.float64(q[0]))
                            r[0] = outside_of(scene.emitter_cdf, index, first)
                            r[1] = wp.float64(q[1])
                        return r
                if index >= 0 and wp.dot(tri.normal, w) < 0.0:
                    emitter = scene.emitters[index]
                    stripe = stripe_at(scene, edges, point, face)
                    if stripe.share > 0.0:
                        at = stripe_square(stripe, u, v)
                        k = emitter.cdf_offset + face - emitter.first_face
                        rest = outside_of(scene.face_cdf, k, wp.float64(at[0]))
                        u1 = outside_of(scene.emitter_cdf, index, rest)
                        r = wp.vec3d(u1, wp.float64(at[1]), wp.float64(stripe.share))
        else:
            if wp.static(constant or envmap):
                environment = scene.environment
                if environment >= 0:
                    record = scene.emitters[environment]
                    if wp.static(envmap):
                        on_sphere = envmap_to_square(scene, record, w)
                    else:
                        on_sphere = sphere_to_square(w)
                    first = outside_of(scene.emitter_cdf, environment, wp.float64(on_sphere[0]))
                    r = wp.vec3d(first, wp.float64(on_sphere[1]), wp.float64(1.0))
        return r

    return aim, coordinates
