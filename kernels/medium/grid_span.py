"""The part of a moving ray's stretch that lies in a grid's box, and the derivative of its optical depth.

The box of a grid ends its medium as an interface does: points of the medium keep their fraction of the stretch between
two crossings, each attached to an interface or to a plane of the box. With p = y + t d, and both ends attached,

    d int sigma dt = int grad sigma . (dy + t dd) dt + sigma(far) dfar - sigma(near) dnear,

with the integral at the stratified points of ``grid_adjoint.py``. The distance t of a crossing of the box has the
adjoint of its position along the box's axis, in voxels, where the planes are at rest.

Derivation: ``docs/theory/media.md#grids-beside-what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.medium.grid_adjoint import POINTS
from warp_psdr.kernels.medium.interface import EDGE_ON
from warp_psdr.kernels.medium.volume import grid_point, grid_size, grid_value, grid_vector
from warp_psdr.kernels.reading import load_float, load_vec3, texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Medium, Scene, Texture
from warp_psdr.kernels.surface import RayAdjoint
from warp_psdr.kernels.texture.volume import trilinear_slope

#: How near to a plane of the box an interface stands in for it, relative to the ray's way through the box.
TIE = 1.0e-4
#: Least length of a span that is divided by, relative to its distance.
SHORT_SPAN = 1.0e-6


@wp.struct
class Span:
    """The part of a stretch of a ray that lies in a grid's box; distances are from the ray's origin."""

    o: wp.vec3  # the ray, in voxels
    d: wp.vec3
    near: wp.float32
    far: wp.float32  # not above near: it misses the box
    near_axis: wp.int32  # of the plane of the box that it starts at; -1: the stretch itself starts there
    far_axis: wp.int32


@wp.struct
class SpanAdjoint:
    """Adjoint of a stretch: of the ray that it lies on, and of the distances at which it begins and ends."""

    o: wp.vec3
    d: wp.vec3
    near: wp.float32
    far: wp.float32
    dot: wp.float32


@wp.func
def span_of(scene: Scene, g: Texture, y: wp.vec3, d: wp.vec3, near: wp.float32, far: wp.float32) -> Span:
    """The part in the box of what lies between two distances from y along the unit vector d."""
    r = Span()
    r.o = grid_point(scene, g, y)
    r.d = grid_vector(scene, g, d)
    r.near = near
    r.far = far
    r.near_axis = -1
    r.far_axis = -1
    size = grid_size(g)
    enters = wp.float32(-FAR)
    leaves = wp.float32(FAR)
    enters_axis = wp.int32(0)
    leaves_axis = wp.int32(0)
    for axis in range(3):
        if r.d[axis] == 0.0:
            if r.o[axis] < 0.0 or r.o[axis] > size[axis]:
                leaves = wp.float32(-FAR)
        else:
            a = -r.o[axis] / r.d[axis]
            b = (size[axis] - r.o[axis]) / r.d[axis]
            if wp.min(a, b) > enters:
                enters = wp.min(a, b)
                enters_axis = axis
            if wp.max(a, b) < leaves:
                leaves = wp.max(a, b)
                leaves_axis = axis
    tie = TIE * wp.max(leaves - enters, 0.0)
    if enters > near + tie:
        r.near = enters
        r.near_axis = enters_axis
    if leaves < far - tie:
        r.far = leaves
        r.far_axis = leaves_axis
    return r


@wp.func
def span_length(span: Span) -> wp.float32:
    return wp.max(span.far - span.near, SHORT_SPAN * wp.max(span.near, 1.0e-20))


@functools.cache
def make_grid_span(role: str, pose: bool):
    """Return ``(accumulate_point, accumulate_depth, accumulate_ends)``.

    ``accumulate_point(scene, target, g, x, a) -> (vec3, float32)``: ``a`` is the adjoint, in voxels, of where a point x
    is in a grid; the first result is that of x.
    ``accumulate_depth(scene, target, m, span, y, d, far, stream, w) -> SpanAdjoint``: ``w`` is the adjoint of
    int sigma dt from the span's beginning to ``far``, both attached.
    ``accumulate_ends(scene, target, g, span, y, d, adjoint) -> SpanAdjoint``: those ends of the adjoint that are planes
    of the box are passed on, and 0 in the result.
    ``pose``: grids move, and W, by which they are read, takes a (x, 1)^T.
    """
    sink, sink3 = make_sink(role), make_sink_vec3(role)

    @wp.func
    def accumulate_point(
        scene: Scene, target: wp.array(dtype=wp.float32), g: Texture, x: wp.vec3, a: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        t = g.to_uv
        w = wp.cw_mul(grid_size(g), a)
        a_x = w[0] * load_vec3(scene.values, t) + w[1] * load_vec3(scene.values, t + 4)
        a_x += w[2] * load_vec3(scene.values, t + 8)
        dot = wp.float32(0.0)
        if wp.static(pose):
            for row in range(3):
                dot += sink3(target, t + 4 * row, w[row] * x) + sink(target, t + 4 * row + 3, w[row])
        return a_x, dot

    @wp.func
    def accumulate_depth(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        span: Span,
        y: wp.vec3,
        d: wp.vec3,
        far: wp.float32,
        stream: Sampler,
        w: wp.vec3,
    ) -> SpanAdjoint:
        r = SpanAdjoint()
        if not span.near < far:
            return r
        g = texture_record(scene, m.sigma_t)
        w_value = load_float(scene.values, m.scale) * w
        step = (far - span.near) * (1.0 / float(POINTS))
        points = wp.int32(POINTS)
        for i in range(points):
            t = span.near + (wp.float32(i) + independent_1d(stream, i)) * step
            slope = trilinear_slope(scene, g, span.o + t * span.d, step * w_value)
            a_x, dot = accumulate_point(scene, target, g, y + t * d, slope)
            r.o += a_x
            r.d += t * a_x
            r.dot += dot
        r.near = -wp.dot(w_value, grid_value(scene.values, g, span.o + span.near * span.d))
        r.far = wp.dot(w_value, grid_value(scene.values, g, span.o + far * span.d))
        return r

    @wp.func
    def accumulate_plane(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        g: Texture,
        span: Span,
        y: wp.vec3,
        d: wp.vec3,
        t: wp.float32,
        axis: wp.int32,
        w: wp.float32,
    ) -> RayAdjoint:
        """``w`` is the adjoint of the distance t at which the ray crosses a plane of the box across an axis."""
        r = RayAdjoint()
        if wp.abs(span.d[axis]) > EDGE_ON * wp.length(span.d):
            place = wp.vec3(0.0, 0.0, 0.0)
            place[axis] = -w / span.d[axis]
            a_x, dot = accumulate_point(scene, target, g, y + t * d, place)
            r.o = a_x
            r.d = t * a_x
            r.dot = dot
        return r

    @wp.func
    def accumulate_ends(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        g: Texture,
        span: Span,
        y: wp.vec3,
        d: wp.vec3,
        adjoint: SpanAdjoint,
    ) -> SpanAdjoint:
        r = adjoint
        t = span.near
        axis = span.near_axis
        w = adjoint.near
        ends = wp.int32(2)
        for _end in range(ends):
            if axis >= 0 and w != 0.0:
                a = accumulate_plane(scene, target, g, span, y, d, t, axis, w)
                r.o += a.o
                r.d += a.d
                r.dot += a.dot
            t = span.far
            axis = span.far_axis
            w = adjoint.far
        if span.near_axis >= 0:
            r.near = 0.0
        if span.far_axis >= 0:
            r.far = 0.0
        return r

    return accumulate_point, accumulate_depth, accumulate_ends
