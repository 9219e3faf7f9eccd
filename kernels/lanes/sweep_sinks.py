"""The sinks for the adjoints that ``sweep_lanes.py`` finds at the vertices of several paths, lane by lane."""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.emitter.area import light_uv
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import make_side
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.lanes.kept_lanes import RecordedVertex
from warp_psdr.kernels.lanes.lanes import ROWS, Rows
from warp_psdr.kernels.lanes.path_lanes import LanePaths
from warp_psdr.kernels.reading import shape_at
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Corners, VertexAdjoint, make_vertex_sink, point_on
from warp_psdr.kernels.texture.texture import make_texture_sink
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig


@wp.struct
class SweptPath:
    """A path that is swept, or not."""

    delta: wp.vec3  # adjoint of its pixel over the samples
    vertices: wp.int32  # their number, 0: it is not swept
    origin: wp.vec3  # of the camera's ray
    lost: wp.float32  # number of values that were not finite


@wp.struct
class VertexConnections:
    """The connections of the vertex at hand."""

    scatters: wp.int32  # 1: it has one with a vertex behind it, or with a light
    lit: wp.int32  # 1: next-event estimation found a light, 2: an area light
    near_before: wp.int32  # 1: the connection with the vertex before may run along a contact
    near_light: wp.int32  # 1: that with the light may
    chi: wp.float32  # weights of the two, ``contact.py``
    chi_light: wp.float32


@wp.struct
class VertexPullback:
    """Adjoints of the vertex at hand."""

    reflectance: wp.vec3
    n: wp.vec3  # normal of the frame, and then the sum of vertex normals that it is of
    wi: wp.vec3
    x: wp.vec3
    radiance: wp.vec3  # of the light
    a_wo: wp.vec3  # direction towards it
    value: wp.float32  # A . D_n
    continues: wp.int32  # 1: there is a vertex behind it, on a surface


@wp.struct
class FirstVertexAdjoint:
    """Adjoints of the first vertex that only its ray has a use for."""

    uv: wp.vec2
    u: wp.float32
    v: wp.float32
    a_d: wp.vec3  # direction of a ray that left the scene


def make_chosen(paths: LanePaths):
    """Return ``chosen(scene, scale, adjoint, j, always, rows) -> SweptPath``: whether the j-th path is swept.

    ``always``: 1 if all are whose pixel has an adjoint; else those that meet a shape that matters.
    """

    @wp.func
    def chosen(
        scene: Scene, scale: wp.float32, adjoint: wp.array2d(dtype=wp.vec3), j: wp.int32, always: wp.int32, rows: ROWS
    ) -> SweptPath:
        path = SweptPath()
        lane_sample = paths.lane_samples.get(rows, j)
        delta = scale * adjoint[lane_sample.py, lane_sample.px]
        if vanishes(delta):
            return path
        traced = paths.gathered(rows, j)
        touched_requested = wp.int32(always)
        n = wp.int32(traced.vertices)
        while n > 0 and touched_requested == 0:
            n -= 1
            face = paths.vertex(rows, j, n).face
            if face >= 0:
                touched_requested = scene.requested_shapes[scene.triangles[face].shape]
        if touched_requested > 0:
            path.delta = delta
            path.vertices = traced.vertices
        elif not finite(traced.radiance):
            count_invalid(scene, lane_sample.sampler)
        return path

    return chosen


def make_sweep_sinks(
    surfaces: SurfaceConfig,
    lights: LightConfig,
    wanted: GradientRequest,
    paths: LanePaths,
    swept: Rows,
    links: Rows,
    pulls: Rows,
    first_adjoints: Rows,
    lit_corners: Rows,
    next_corners: Rows,
) -> tuple[wp.Function, wp.Function]:
    """Return ``accumulate_light`` and ``accumulate``, both ``(scene, target, count, n, rows)``.

    The first, which scenes without lights have no use for, does what D_n brings to the lights, and adds to the adjoint
    of x_n what comes back; the second what goes to the material, to the normals at the corners, and to the corners of
    the vertex n + 1.
    """
    kept_at = paths.record
    side_of = make_side(surfaces.two_sided)
    sink3 = make_sink_vec3("reverse")
    accumulate_vertex = make_vertex_sink(
        "reverse", surfaces.smooth, surfaces.flat, surfaces.uv, False, wanted.texcoords, False
    )
    material_record = make_bsdf(surfaces.bsdfs).record
    accumulate_material = make_material_sink(surfaces, wanted, "reverse")
    has_lights = bool(lights.area or lights.others)
    accumulate_source = make_light_sink(surfaces, lights, wanted, "reverse", links=False)[1] if has_lights else None
    sources = bool(lights.others) or wanted.radiance or wanted.to_uv or wanted.texcoords
    accumulate_emission = (
        make_texture_sink("reverse", lights.area, wanted.radiance, wanted.to_uv, True) if lights.area else None
    )
    others = make_lights(lights.others, "reverse", wanted.lights) if lights.others else None
    environment_vjp = others.environment_vjp if others else None

    @wp.func
    def accumulate_corners(scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, a: Corners) -> wp.float32:
        lost = sink3(target, scene.positions + 3 * tri.i0, a.p0)
        lost += sink3(target, scene.positions + 3 * tri.i1, a.p1)
        return lost + sink3(target, scene.positions + 3 * tri.i2, a.p2)

    @wp.func
    def accumulate_light(scene: Scene, target: wp.array(dtype=wp.float32), count: wp.int32, n: wp.int32, rows: ROWS):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            link = links.get(rows, j)
            if link.lit > 0:
                record = kept_at(rows, j, n)
                path = swept.get(rows, j)
                if wp.static(sources):
                    vertex = record.vertex
                    pull = pulls.get(rows, j)
                    x = point_on(record.tri, vertex.u, vertex.v)
                    a_x, lost = accumulate_source(
                        scene, target, vertex, x, pull.radiance, pull.value, pull.a_wo, link.chi_light
                    )
                    path.lost += lost
                    pull.x += a_x
                    pulls.put(rows, j, pull)
                if wp.static(wanted.shapes):
                    if link.lit == 2:
                        path.lost += accumulate_corners(scene, target, record.light, lit_corners.get(rows, j))
                swept.put(rows, j, path)

    @wp.func
    def accumulate_brought(
        scene: Scene, target: wp.array(dtype=wp.float32), record: RecordedVertex, delta: wp.vec3
    ) -> tuple[VertexAdjoint, wp.float32]:
        """E_n of an area light."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        adjoint = VertexAdjoint()
        lost = wp.float32(0.0)
        if wp.static(bool(lights.area)):
            vertex = record.vertex
            emitter = shape_at(scene, record.tri.shape).emitter
            if emitter >= 0 and vertex.e_weight > 0.0 and wp.dot(record.tri.normal, vertex.d) < 0.0:
                w = vertex.e_weight * wp.cw_mul(delta, vertex.throughput)
                uv = light_uv(scene, vertex.face, vertex.u, vertex.v)
                texture = scene.emitters[emitter].texture
                ta = accumulate_emission(scene, target, texture, vertex.face, vertex.u, vertex.v, uv, w)
                lost = ta.dot
                adjoint.uv = ta.uv
                adjoint.u = ta.u
                adjoint.v = ta.v
        return adjoint, lost

    @wp.func
    def accumulate(scene: Scene, target: wp.array(dtype=wp.float32), count: wp.int32, n: wp.int32, rows: ROWS):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            path = swept.get(rows, j)
            if n < path.vertices:
                record = kept_at(rows, j, n)
                vertex = record.vertex
                slide = FirstVertexAdjoint()
                if vertex.face < 0:
                    if wp.static(environment_vjp is not None):
                        if vertex.e_weight > 0.0:
                            a_n = wp.cw_mul(path.delta, vertex.throughput)
                            ea = environment_vjp(scene, target, vertex.d, vertex.e_weight * a_n)
                            path.lost += ea.dot
                            slide.a_d = ea.x
                else:
                    adjoint, lost = accumulate_brought(scene, target, record, path.delta)
                    path.lost += lost
                    if links.get(rows, j).scatters == 1:
                        pull = pulls.get(rows, j)
                        stood = record.stood
                        m = material_record()
                        m.reflectance = pull.reflectance
                        shape = shape_at(scene, record.tri.shape)
                        _side, b = side_of(scene, shape.bsdf, stood.side < 0.0)
                        adjoint, lost = accumulate_material(
                            scene, target, scene.bsdfs[b].slots, vertex.face, vertex.u, vertex.v, stood.uv, m, adjoint
                        )
                        path.lost += lost
                        if wp.static(wanted.shapes and surfaces.smooth):
                            if n > 0 and stood.length > 0.0:
                                w = 1.0 - vertex.u - vertex.v
                                path.lost += sink3(target, shape.normal_offset + 3 * record.tri.i0, w * pull.n)
                                path.lost += sink3(target, shape.normal_offset + 3 * record.tri.i1, vertex.u * pull.n)
                                path.lost += sink3(target, shape.normal_offset + 3 * record.tri.i2, vertex.v * pull.n)
                        if wp.static(wanted.shapes):
                            if pull.continues == 1:
                                tri = kept_at(rows, j, n + 1).tri
                                path.lost += accumulate_corners(scene, target, tri, next_corners.get(rows, j))
                    slide.uv = adjoint.uv
                    slide.u = adjoint.u
                    slide.v = adjoint.v
                    if wp.static(wanted.texcoords):
                        if n > 0:
                            accumulated = accumulate_vertex(
                                scene, target, vertex.face, vertex.u, vertex.v, adjoint, False, vertex.o, vertex.d
                            )
                            path.lost += accumulated.dot
                if n == 0:
                    first_adjoints.put(rows, j, slide)
                swept.put(rows, j, path)

    return accumulate_light, accumulate
