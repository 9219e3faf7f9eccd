"""The edges and neighbours of a triangle that a ray meets."""

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.texture.steps import StepTextures

#: A hit counts as on the rim of its triangle within this fraction of the height above it, or this many ray epsilons.
#: Neighbouring rays are that far apart on what they see edge-on; of what lies farther inside, no edge is crossed. Of a
#: lamp seen in the limb of a glass ball a fraction of 0.002 lost 0.1 % of the crossings, which made a bias as large.
RIM_FRACTION = 0.1
RIM_EPSILONS = 50.0
#: Components of a direction below it count as zero.
AXIAL = 1.0e-20


@wp.struct
class Tables:
    """What is known of the faces. An edge is smooth where neither radiance nor normal jumps across it."""

    group: wp.array(dtype=wp.int32)  # coplanar neighbours are one
    interpolated: wp.array(dtype=wp.int32)  # 1: interpolated normals differ from the face's
    face_edges: wp.array(dtype=wp.int32)  # (3 n) edge opposite of each corner; -1: none
    smooth_edge: wp.array(dtype=wp.int32)
    steps: StepTextures
    mirrors: wp.array(dtype=wp.vec3)  # (2 n) lower and upper corners of boxes that hold all mirrors and glass


@wp.func
def may_meet_mirrors(tables: Tables, o: wp.vec3, d: wp.vec3) -> wp.bool:
    """Whether a ray meets one of the boxes that hold all mirrors and glass."""
    # Of a direction along an axis, the planes across the others are as far as float32 reaches, not at NaN.
    inverse = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        inverse[k] = wp.where(d[k] < 0.0, -1.0, 1.0) / wp.max(wp.abs(d[k]), AXIAL)
    for i in range(tables.mirrors.shape[0] // 2):
        a = wp.cw_mul(tables.mirrors[2 * i] - o, inverse)
        b = wp.cw_mul(tables.mirrors[2 * i + 1] - o, inverse)
        begin = wp.max(wp.min(a, b))
        end = wp.min(wp.max(a, b))
        if end >= wp.max(begin, 0.0):
            return True
    return False


@wp.struct
class TriangleBorder:
    """The edge of a triangle that is nearest to a point of it; of a shape without triangles ``edge`` is -1."""

    edge: wp.int32
    distance: wp.float32  # world units
    near: wp.float32  # distance over what counts as on the rim


@wp.func
def border_of(scene: Scene, tables: Tables, face: wp.int32, u: wp.float32, v: wp.float32) -> TriangleBorder:
    r = TriangleBorder()
    r.edge = -1
    r.distance = FAR
    r.near = FAR
    if is_primitive_at(scene, face):
        return r
    tri = scene.triangles[face]
    area = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
    best = wp.float32(FAR)
    for k in range(3):
        b = wp.where(k == 0, 1.0 - u - v, wp.where(k == 1, u, v))
        side = wp.where(k == 0, tri.p2 - tri.p1, wp.where(k == 1, tri.p0 - tri.p2, tri.p1 - tri.p0))
        height = area / wp.length(side)
        distance = wp.abs(b) * height
        if distance < best:
            best = distance
            r.edge = tables.face_edges[3 * face + k]
            r.distance = distance
            r.near = distance / wp.max(RIM_FRACTION * height, RIM_EPSILONS * scene.ray_epsilon)
    return r


@wp.func
def point_on_edge(scene: Scene, edges: Edges, edge: wp.int32, x: wp.vec3) -> EdgePoint:
    r = EdgePoint()
    r.edge = edge
    r.pdf = 1.0
    r.p0 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 0])
    r.p1 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 1])
    along = r.p1 - r.p0
    r.s = wp.clamp(wp.dot(x - r.p0, along) / wp.dot(along, along), 0.0, 1.0)
    r.x = (1.0 - r.s) * r.p0 + r.s * r.p1
    return r


@wp.func
def of_edge(edges: Edges, edge: wp.int32, face: wp.int32) -> wp.bool:
    found = wp.bool(False)
    for i in range(edges.first[edge], edges.first[edge + 1]):
        if edges.faces[i] == face:
            found = True
    return found


@wp.func
def smooth_between(edges: Edges, tables: Tables, a: wp.int32, b: wp.int32) -> wp.int32:
    """Return the smooth edge between two faces, -1: there is none."""
    found = wp.int32(-1)
    for k in range(3):
        edge = tables.face_edges[3 * a + k]
        if edge >= 0:
            if tables.smooth_edge[edge] == 1 and of_edge(edges, edge, b):
                found = edge
    return found


@wp.func
def joined(scene: Scene, edges: Edges, tables: Tables, a: Link, b: Link) -> wp.bool:
    """Whether two neighbouring rays meet one surface."""
    if tables.group[a.face] == tables.group[b.face]:
        return True
    if smooth_between(edges, tables, a.face, b.face) < 0:
        return False
    tri = scene.triangles[a.face]
    return wp.length(a.x - b.x) <= 0.01 * wp.length(tri.p1 - tri.p0) + RIM_EPSILONS * scene.ray_epsilon
