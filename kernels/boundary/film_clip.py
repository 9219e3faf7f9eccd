"""What a film can see of edges, and between which faces, in double precision on the host's processor.

``warp_psdr/topology/camera_view.py`` has the conventions.
"""

import warp as wp

from warp_psdr.kernels.modules import LISTS

#: Least homogeneous coordinate by which is divided.
LEAST_W = 1.0e-30


@wp.struct
class View:
    """Where the eye of a camera is: towards it from x is ``eye`` - ``finite`` x."""

    eye: wp.vec3d
    finite: wp.float64
    radius: wp.float64  # of the lens, whose plane has the axes across and down
    across: wp.vec3d
    down: wp.vec3d


@wp.struct
class Window:
    """What projects to the pixels of a crop window, and the window."""

    position: wp.vec3d
    to_camera: wp.mat33d
    finite: wp.float64
    near: wp.float64
    far: wp.float64
    center: wp.vec2d  # pixels of the crop window
    scale: wp.vec2d
    size: wp.vec2d
    border: wp.float64  # width beside the window that the filter reaches, pixels
    radius: wp.float64  # of the lens
    focus: wp.float64


@wp.func
def towards(view: View, x: wp.vec3d) -> wp.vec3d:
    return view.eye - view.finite * x


@wp.func
def spread(view: View, v: wp.vec3d) -> wp.float64:
    """The largest change of v . eye over the lens."""
    return view.radius * wp.length(wp.vec2d(wp.dot(v, view.across), wp.dot(v, view.down)))


@wp.struct
class Stretch:
    """The stretch of an edge that planes leave."""

    low: wp.float64
    high: wp.float64


@wp.func
def cut(s: Stretch, f: wp.float64, g: wp.float64) -> Stretch:
    """Leave what is not below a plane, over which the ends are f and g high."""
    zero = wp.float64(0.0)
    r = Stretch()
    r.low = s.low
    r.high = s.high
    if f < zero and g >= zero:
        r.low = wp.max(s.low, -f / (g - f))
    elif f >= zero and g < zero:
        r.high = wp.min(s.high, -f / (g - f))
    elif f < zero and g < zero:
        r.high = wp.float64(-1.0)
    return r


@wp.func
def image(a: wp.vec3d, b: wp.vec3d, s: wp.float64) -> wp.vec3d:
    """Image of a place between homogeneous points (x, y, w): x and y, pixels, and 1 / w."""
    t = wp.float64(1.0) - s
    w = t * a[2] + s * b[2]
    if not wp.abs(w) > wp.float64(LEAST_W):
        w = wp.float64(LEAST_W)
    return wp.vec3d(t * a[0] + s * b[0], t * a[1] + s * b[1], t + s) / w


@wp.kernel(module=LISTS, enable_backward=False)
def clip_edges(
    # In:
    window: Window,
    ends: wp.array2d(dtype=wp.vec3d),
    first: wp.int32,
    # Out:
    low_out: wp.array(dtype=wp.float64),
    high_out: wp.array(dtype=wp.float64),
    length_out: wp.array(dtype=wp.float64),
):
    """Clip edges (E, 2), as ``CameraView.clip`` says."""
    i = first + wp.tid()
    p = window.to_camera * (ends[i, 0] - window.position)
    q = window.to_camera * (ends[i, 1] - window.position)
    one = wp.float64(1.0)
    w_p = window.finite * p[2] + (one - window.finite)
    w_q = window.finite * q[2] + (one - window.finite)
    a = wp.vec3d(window.center[0] * w_p - window.scale[0] * p[0], window.center[1] * w_p - window.scale[1] * p[1], w_p)
    b = wp.vec3d(window.center[0] * w_q - window.scale[0] * q[0], window.center[1] * w_q - window.scale[1] * q[1], w_q)
    s = Stretch()
    s.low = wp.float64(0.0)
    s.high = one
    s = cut(s, p[2] - window.near, q[2] - window.near)
    s = cut(s, window.far - p[2], window.far - q[2])
    for k in range(2):
        beside_p = window.border * w_p + window.radius * window.scale[k] * wp.abs(p[2] / window.focus - one)
        beside_q = window.border * w_q + window.radius * window.scale[k] * wp.abs(q[2] / window.focus - one)
        s = cut(s, a[k] + beside_p, b[k] + beside_q)
        s = cut(s, window.size[k] * w_p + beside_p - a[k], window.size[k] * w_q + beside_q - b[k])
    length = wp.float64(0.0)
    if s.high > s.low:
        # The last component is 1 / z: what a lens point shifts the image by, but for the common shift a l / f.
        step = image(a, b, s.high) - image(a, b, s.low)
        lens = window.radius * step[2]
        scales = window.scale[0] * window.scale[0] + window.scale[1] * window.scale[1]
        # E |l_x|^2 = E |l_y|^2 = 1/4 on the unit disk.
        length = wp.sqrt(step[0] * step[0] + step[1] * step[1] + wp.float64(0.25) * (lens * lens) * scales)
    if not wp.isfinite(length):
        length = wp.float64(0.0)
    low_out[i] = s.low
    high_out[i] = s.high
    length_out[i] = length


@wp.kernel(module=LISTS, enable_backward=False)
def faces_apart(
    # In:
    view: View,
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    numbers: wp.array(dtype=wp.int32),
    width: wp.array(dtype=wp.float64),
    ends: wp.array2d(dtype=wp.vec3d),
    length: wp.array(dtype=wp.float64),
    faces: wp.array(dtype=wp.int32),
    first_face: wp.array(dtype=wp.int32),
    coplanar: wp.float64,
    first: wp.int32,
    # Out:
    apart_out: wp.array(dtype=wp.bool),
):
    """Write whether an edge, ``numbers``, has a face on either side, as the camera sees them, at least so wide."""
    i = first + wp.tid()
    edge = numbers[i]
    begin = ends[edge, 0]
    along = ends[edge, 1] - begin
    plane = wp.cross(along, -towards(view, begin))
    start = first_face[edge]
    second = start
    if first_face[edge + 1] - start == 2:
        second = start + 1
    scale = wp.length(plane) * (length[edge] * coplanar + width[i])
    wide = bool(True)
    product = wp.float64(1.0)
    for k in range(2):
        face = triangles[faces[wp.where(k == 0, start, second)]]
        into = wp.vec3d(points[face[0]]) - begin + (wp.vec3d(points[face[1]]) - begin)
        into = into + (wp.vec3d(points[face[2]]) - begin)
        side = wp.dot(into, plane)
        # into . (along x eye) = eye . (into x along)
        wide = wide and wp.abs(side) > scale + spread(view, wp.cross(into, along))
        product = product * side
    apart_out[i] = wide and product < wp.float64(0.0)
