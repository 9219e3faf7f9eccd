"""The backward sweep of ``sweep.py`` over the vertices of all lanes, in step (``lanes.py``).

Derivation and parametrisation are those of ``replay.py``. All paths are swept from their n-th vertex to the one before
together, from the last vertex down; the kept vertices of one depth lie side by side. A loop over all lanes, which
becomes SIMD, does the arithmetic of a connection or of a vertex. Results are added to the gradient lane by lane
(``sweep_sinks.py``), for two paths may meet the same triangle. The first vertex of a path has barycentrics that are
attached to the camera's ray, and ends in ``sweep.finish``, path by path. The file serves diffuse scenes in which
vertices move. If none moves, a vertex is a few products, and one path after the other is faster.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import Frame, enter_frame, make_framing
from warp_psdr.kernels.interior.factors.contact import make_contact_weights, may_touch, wedge_between
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import connection_vjp, make_frame_vjp
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.lanes.kept_lanes import RecordedVertex
from warp_psdr.kernels.lanes.lanes import ROWS, stack_rows
from warp_psdr.kernels.lanes.path_lanes import LanePaths
from warp_psdr.kernels.lanes.sweep_sinks import (
    FirstVertexAdjoint,
    SweptPath,
    VertexConnections,
    VertexPullback,
    make_chosen,
    make_sweep_sinks,
)
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.sensor.camera import make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import Corners, corners_vjp, face_normal_vjp, normalize_vjp, point_on
from warp_psdr.kernels.vertex import PathConfig

#: The only scattering functions of what is traced side by side.
DIFFUSE = make_bsdf(("diffuse",))


@wp.struct
class Scattering:
    """Where a vertex scatters, and A_n."""

    frame: Frame
    material: DIFFUSE.record
    wi: wp.vec3  # local
    a_n: wp.vec3


@wp.struct
class SweepCarry:
    """What the sweep hands from a vertex to the one before it; ``Carry``, for paths of smooth lobes."""

    radiance: wp.vec3
    face: wp.int32
    o: wp.vec3
    x: wp.vec3  # adjoints of the point, of its normal (the first vertex only), and of the edges' cross product
    n: wp.vec3
    c: wp.vec3
    a_x: wp.vec3
    chi: wp.float32


def make_lane_sweep(config: PathConfig, wanted: GradientRequest, paths: LanePaths) -> tuple[int, wp.Function]:
    """Return the number of rows that it takes, and the function that sweeps the paths that ``paths`` has traced.

    ``sweep_all(scene, camera, target, scale, adjoint, count, always, rows)``: the first ``count`` of them, by
    ``scale * adjoint``; ``always`` as in ``make_chosen``.

    Args:
        config: what the scene needs.
        wanted: what is differentiated, geometry among it.
        paths: how its paths are traced; of their vertices all is kept.
    """
    width, kept_at = paths.width, paths.record
    swept, links, pulls, first_adjoints, carries, lit_corners, next_corners = stack_rows(
        width, paths.end, SweptPath, VertexConnections, VertexPullback, FirstVertexAdjoint, SweepCarry, Corners, Corners
    )
    frame_on = make_framing(False)
    frame_vjp = make_frame_vjp(False)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    _sweep, finish_path, _finish_vertex = make_sweep(config, wanted, "reverse")
    weight_before, weight_of_light = make_contact_weights(config.rays.backend, width)
    chosen = make_chosen(paths)
    accumulate_light, accumulate = make_sweep_sinks(
        config.surfaces, config.lights, wanted, paths, swept, links, pulls, first_adjoints, lit_corners, next_corners
    )
    has_lights = bool(config.lights.area or config.lights.others)
    area = bool(config.lights.area)

    @wp.func
    def begin(
        scene: Scene,
        camera: Camera,
        scale: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        count: wp.int32,
        always: wp.int32,
        rows: ROWS,
    ) -> wp.int32:
        """Choose the paths; the most vertices that one of them has."""
        most = wp.int32(0)
        none = SweepCarry()
        none.face = -2
        j = wp.int32(0)
        while j < width:
            path = SweptPath()
            if j < count:
                path = chosen(scene, scale, adjoint, j, always, rows)
                if path.vertices > 0:
                    path.origin = camera_origin(scene, camera, paths.camera(rows, j))
                    most = wp.max(most, path.vertices)
            swept.put(rows, j, path)
            carries.put(rows, j, none)
            j += 1
        return most

    @wp.func
    def scattering_at(record: RecordedVertex, delta: wp.vec3) -> Scattering:
        at = Scattering()
        at.frame = frame_on(1.0, record.stood.n, wp.vec3(0.0, 0.0, 0.0))
        at.material.reflectance = record.stood.reflectance
        at.wi = enter_frame(at.frame, -record.vertex.d)
        at.a_n = wp.cw_mul(delta, record.vertex.throughput)
        return at

    @wp.func
    def weigh_each(scene: Scene, count: wp.int32, n: wp.int32, rows: ROWS):
        for j in range(count):
            link = links.get(rows, j)
            if link.near_before + link.near_light > 0:
                record = kept_at(rows, j, n)
                vertex = record.vertex
                if link.near_before == 1:
                    link.chi = weight_before(scene, vertex)
                if link.near_light == 1:
                    link.chi_light = weight_of_light(scene, vertex, point_on(record.tri, vertex.u, vertex.v))
                links.put(rows, j, link)

    @wp.func
    def connect(scene: Scene, n: wp.int32, rows: ROWS):
        """The connections of the vertices, and whether they may run along contacts."""
        j = wp.int32(0)
        while j < width:
            record = kept_at(rows, j, n)
            before = kept_at(rows, j, n - 1)
            path = swept.get(rows, j)
            vertex = record.vertex
            tri = record.tri
            link = VertexConnections()
            on = n < path.vertices and vertex.face >= 0
            left = wp.where(on, vertex.previous_face, -1)
            x = point_on(tri, vertex.u, vertex.v)
            rho = scene.contact_ratio * load_float(scene.radii, wp.where(on, vertex.face, 0))
            rho_before = scene.contact_ratio * load_float(scene.radii, wp.max(left, 0))
            wedge = wedge_between(before.tri.normal, before.tri.p0, tri.normal, vertex.o, x)
            touches = may_touch(wedge, rho_before, rho)
            lit = on and vertex.light >= 0
            continues = on and vertex.lobe == LOBE_SMOOTH
            link.near_before = wp.where(touches and left >= 0, 1, 0)
            link.lit = wp.where(lit, 1, 0)
            link.scatters = wp.where(lit or continues, 1, 0)
            if wp.static(area):
                light = record.light
                at = wp.where(lit, vertex.light_face, -1)
                y = point_on(light, vertex.light_u, vertex.light_v)
                rho_light = scene.contact_ratio * load_float(scene.radii, wp.max(at, 0))
                touches = may_touch(wedge_between(tri.normal, tri.p0, light.normal, x, y), rho, rho_light)
                link.near_light = wp.where(touches and at >= 0, 1, 0)
                link.lit += wp.where(at >= 0, 1, 0)
            link.chi = 1.0
            link.chi_light = 1.0
            links.put(rows, j, link)
            j += 1

    @wp.func
    def weigh(scene: Scene, count: wp.int32, n: wp.int32, rows: ROWS):
        """Weights of connections along contacts; few are."""
        nearby = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            link = links.get(rows, j)
            nearby = wp.max(nearby, link.near_before + link.near_light)
            j += 1
        if nearby > 0:
            weigh_each(scene, count, n, rows)

    @wp.func
    def pull_light(n: wp.int32, rows: ROWS):
        """D_n: the adjoints of the scattering value, then those of the connection."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            pull = VertexPullback()
            if wp.static(has_lights):
                record = kept_at(rows, j, n)
                vertex = record.vertex
                at = scattering_at(record, swept.get(rows, j).delta)
                link = links.get(rows, j)
                lit = link.lit > 0
                wo = enter_frame(at.frame, vertex.light_wi)
                w_f = vertex.light_weight * wp.cw_mul(at.a_n, record.stood.radiance)
                f = DIFFUSE.eval(0, at.material, at.wi, wo)
                fa = DIFFUSE.eval_vjp(0, at.material, at.wi, wo, w_f)
                a_wi = link.chi * fa.wi
                turned = frame_vjp(at.frame, zero, -vertex.d, vertex.light_wi, a_wi, link.chi_light * fa.wo)
                pull.reflectance = where3(lit, fa.material.reflectance, zero)
                pull.n = where3(lit, turned.n, zero)
                pull.wi = where3(lit, turned.wi, zero)
                pull.a_wo = turned.wo
                pull.radiance = vertex.light_weight * wp.cw_mul(at.a_n, f)
                pull.value = wp.dot(w_f, f)
            pulls.put(rows, j, pull)
            j += 1
        if wp.static(area):
            j = wp.int32(0)
            while j < width:
                record = kept_at(rows, j, n)
                vertex = record.vertex
                light = record.light
                pull = pulls.get(rows, j)
                link = links.get(rows, j)
                x = point_on(record.tri, vertex.u, vertex.v)
                y = point_on(light, vertex.light_u, vertex.light_v)
                cross = wp.cross(light.p1 - light.p0, light.p2 - light.p0)
                pulled = connection_vjp(x, y, cross, vertex.light_wi, pull.a_wo, pull.value, link.chi_light)
                pull.x = where3(link.lit == 2, pulled.x, zero)
                pulls.put(rows, j, pull)
                lit_corners.put(rows, j, corners_vjp(light, vertex.light_u, vertex.light_v, -pulled.x, pulled.c))
                j += 1

    @wp.func
    def pull_onward(n: wp.int32, rows: ROWS):
        """beta_n L_{n+1}, and the vertex n + 1, which is complete with it."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            record = kept_at(rows, j, n)
            behind = kept_at(rows, j, n + 1)
            vertex = record.vertex
            at = scattering_at(record, swept.get(rows, j).delta)
            link = links.get(rows, j)
            pull = pulls.get(rows, j)
            following = carries.get(rows, j)
            on = link.scatters == 1 and vertex.lobe == LOBE_SMOOTH
            wo = enter_frame(at.frame, vertex.wo)
            w_f = vertex.inv_pdf * wp.cw_mul(at.a_n, following.radiance)
            fa = DIFFUSE.eval_vjp(0, at.material, at.wi, wo, w_f)
            a_wi = link.chi * fa.wi
            turned = frame_vjp(at.frame, zero, -vertex.d, vertex.wo, a_wi, following.chi * fa.wo)
            pull.reflectance += where3(on, fa.material.reflectance, zero)
            pull.n += where3(on, turned.n, zero)
            pull.wi += where3(on, turned.wi, zero)
            connected = on and following.face >= 0
            tri = behind.tri
            u = behind.vertex.u
            v = behind.vertex.v
            cross = wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)
            value = wp.dot(wp.cw_mul(at.a_n, vertex.beta), following.radiance)
            pulled = connection_vjp(following.o, point_on(tri, u, v), cross, vertex.wo, turned.wo, value, following.chi)
            pull.x += where3(connected, pulled.x, zero) + where3(on, following.a_x, zero)
            pull.continues = wp.where(connected, 1, 0)
            pulls.put(rows, j, pull)
            next_corners.put(rows, j, corners_vjp(tri, u, v, following.x - pulled.x, following.c + pulled.c))
            j += 1

    @wp.func
    def hand_on(n: wp.int32, rows: ROWS):
        """The vertex at hand becomes the one behind; but for the first, its normal's adjoint goes to what it is of."""
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            record = kept_at(rows, j, n)
            vertex = record.vertex
            tri = record.tri
            stood = record.stood
            path = swept.get(rows, j)
            link = links.get(rows, j)
            pull = pulls.get(rows, j)
            following = carries.get(rows, j)
            there = n < path.vertices
            scatters = link.scatters == 1
            o = where3(n == 0, path.origin, vertex.o)
            x = point_on(tri, vertex.u, vertex.v)
            # wi = normalize(x_{n-1} - x_n).
            a_x = where3(scatters, normalize_vjp(-vertex.d, wp.length(o - x), pull.wi), zero)
            a_n = where3(scatters, stood.side * pull.n, zero)
            # ``flip_normals`` turns both kinds of normals.
            sign = wp.where(wp.dot(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0), tri.normal) < 0.0, -1.0, 1.0)
            pull.n = where3(scatters, normalize_vjp(stood.n, stood.length, sign * a_n), zero)
            pulls.put(rows, j, pull)
            flat = scatters and stood.length < 0.0
            result = SweepCarry()
            result.radiance = where3(there, vertex.direct + wp.cw_mul(vertex.beta, following.radiance), zero)
            result.face = wp.where(there, vertex.face, -2)
            result.o = o
            result.x = pull.x - a_x
            result.n = a_n
            result.c = where3(flat and n > 0, face_normal_vjp(tri, sign, a_n), zero)
            result.a_x = a_x
            result.chi = link.chi
            carries.put(rows, j, result)
            j += 1

    @wp.func
    def sweep(scene: Scene, target: wp.array(dtype=wp.float32), count: wp.int32, n: wp.int32, rows: ROWS):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        connect(scene, n, rows)
        weigh(scene, count, n, rows)
        pull_light(n, rows)
        if wp.static(has_lights):
            accumulate_light(scene, target, count, n, rows)
        pull_onward(n, rows)
        hand_on(n, rows)
        accumulate(scene, target, count, n, rows)

    @wp.func
    def finish(scene: Scene, camera: Camera, target: wp.array(dtype=wp.float32), count: wp.int32, rows: ROWS):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            path = swept.get(rows, j)
            if path.vertices > 0:
                last = carries.get(rows, j)
                slide = first_adjoints.get(rows, j)
                vertex = paths.vertex(rows, j, 0)
                carry = Carry()
                carry.face = last.face
                carry.u = vertex.u
                carry.v = vertex.v
                carry.o = last.o
                carry.d = vertex.d
                carry.adjoint.x = last.x
                carry.adjoint.n = last.n
                carry.adjoint.uv = slide.uv
                carry.adjoint.u = slide.u
                carry.adjoint.v = slide.v
                carry.a_x = last.a_x
                carry.a_d = slide.a_d
                lost = finish_path(scene, target, camera, paths.camera(rows, j), carry)
                if lost + path.lost != 0.0 or not finite(last.radiance):
                    count_invalid(scene, paths.lane_samples.get(rows, j).sampler)

    @wp.func
    def sweep_all(
        scene: Scene,
        camera: Camera,
        target: wp.array(dtype=wp.float32),
        scale: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        count: wp.int32,
        always: wp.int32,
        rows: ROWS,
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        n = begin(scene, camera, scale, adjoint, count, always, rows)
        while n > 0:
            n -= 1
            sweep(scene, target, count, n, rows)
        finish(scene, camera, target, count, rows)

    return next_corners.end, sweep_all
