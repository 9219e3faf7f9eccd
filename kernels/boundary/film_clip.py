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
def lens_spread(view: View, v: wp.vec3d) -> wp.float64:
    """The largest change of v . eye over the lens."""
    return view.radius * wp.length(wp.vec2d(wp.dot(v, view.across), wp.dot(v, view.down)))


@wp.func
def above_plane(s: wp.vec2d, f: wp.float64, g: wp.float64) -> wp.vec2d:
    """Leave of the stretch (low, high) of an edge what is not below a plane; its ends are f and g high over it."""
    zero = wp.float64(0.0)
    if f < zero and g < zero:
        return wp.vec2d(s[0], wp.float64(-1.0))
    if f < zero and g >= zero:
        return wp.vec2d(wp.max(s[0], -f / (g - f)), s[1])
    if f >= zero and g < zero:
        return wp.vec2d(s[0], wp.min(s[1], -f / (g - f)))
    return s


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
    numbers: wp.array(dtype=wp.int32),
    first: wp.int32,
    # Out:
    low_out: wp.array(dtype=wp.float64),
    high_out: wp.array(dtype=wp.float64),
    length_out: wp.array(dtype=wp.float64),
):
    """Clip edges, ``numbers``, as ``CameraView.clip`` says."""
    i = first + wp.tid()
    p = window.to_camera * (ends[numbers[i], 0] - window.position)
    q = window.to_camera * (ends[numbers[i], 1] - window.position)
    one = wp.float64(1.0)
    w_p = window.finite * p[2] + (one - window.finite)
    w_q = window.finite * q[2] + (one - window.finite)
    a = wp.vec3d(window.center[0] * w_p - window.scale[0] * p[0], window.center[1] * w_p - window.scale[1] * p[1], w_p)
    b = wp.vec3d(window.center[0] * w_q - window.scale[0] * q[0], window.center[1] * w_q - window.scale[1] * q[1], w_q)
    s = wp.vec2d(wp.float64(0.0), one)
    s = above_plane(s, p[2] - window.near, q[2] - window.near)
    s = above_plane(s, window.far - p[2], window.far - q[2])
    for k in range(2):
        beside_p = window.border * w_p + window.radius * window.scale[k] * wp.abs(p[2] / window.focus - one)
        beside_q = window.border * w_q + window.radius * window.scale[k] * wp.abs(q[2] / window.focus - one)
        s = above_plane(s, a[k] + beside_p, b[k] + beside_q)
        s = above_plane(s, window.size[k] * w_p + beside_p - a[k], window.size[k] * w_q + beside_q - b[k])
    length = wp.float64(0.0)
    if s[1] > s[0]:
        # The last component is 1 / z: what a lens point shifts the image by, but for the common shift a l / f.
        step = image(a, b, s[1]) - image(a, b, s[0])
        lens = window.radius * step[2]
        scales = window.scale[0] * window.scale[0] + window.scale[1] * window.scale[1]
        # E |l_x|^2 = E |l_y|^2 = 1/4 on the unit disk.
        length = wp.sqrt(step[0] * step[0] + step[1] * step[1] + wp.float64(0.25) * (lens * lens) * scales)
    if not wp.isfinite(length):
        length = wp.float64(0.0)
    low_out[i] = s[0]
    high_out[i] = s[1]
    length_out[i] = length


@wp.func
def beside(
    view: View, points: wp.array(dtype=wp.vec3), face: wp.vec3i, begin: wp.vec3d, along: wp.vec3d, plane: wp.vec3d
) -> wp.vec2d:
    """How far beside the plane through an edge and the eye a face lies, and how much that varies over the lens."""
    into = wp.vec3d(points[face[0]]) - begin + (wp.vec3d(points[face[1]]) - begin)
    into = into + (wp.vec3d(points[face[2]]) - begin)
    # into . (along x eye) = eye . (into x along)
    return wp.vec2d(wp.dot(into, plane), lens_spread(view, wp.cross(into, along)))


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
    one = beside(view, points, triangles[faces[start]], begin, along, plane)
    other = beside(view, points, triangles[faces[second]], begin, along, plane)
    wide = wp.abs(one[0]) > scale + one[1] and wp.abs(other[0]) > scale + other[1]
    apart_out[i] = wide and one[0] * other[0] < wp.float64(0.0)
