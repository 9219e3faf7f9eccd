"""Meshes and rays for the ray queries, and the comparison of two sets of hits."""

import numpy as np

#: Uncertainty of where a float32 ray meets a triangle's plane, relative to the coordinates and the distance.
EDGE_TOLERANCE = 4.0e-6
#: Relative difference of distances that counts as a tie (float32, a few roundings).
TIE_TOLERANCE = 2.0e-5


def sphere(rows=40, columns=60, bumps=0.1):
    """Return a closed, displaced sphere whose vertices on the seam and at the poles are shared."""
    theta = np.linspace(0.0, np.pi, rows + 1)[1:-1, None]
    phi = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)[None, :]
    r = 1.0 + bumps * np.sin(7.0 * theta) * np.cos(5.0 * phi)
    ring = np.stack([r * np.sin(theta) * np.cos(phi), r * np.sin(theta) * np.sin(phi), r * np.cos(theta)], -1)
    vertices = np.concatenate([ring.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    faces, j = [], np.arange(columns)
    k = (j + 1) % columns
    for i in range(rows - 2):
        a, b = i * columns, (i + 1) * columns
        faces += [np.stack([a + j, b + j, a + k], -1), np.stack([a + k, b + j, b + k], -1)]
    last = (rows - 2) * columns
    faces += [np.stack([np.full_like(j, len(vertices) - 2), j, k], -1)]
    faces += [np.stack([last + j, np.full_like(j, len(vertices) - 1), last + k], -1)]
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def cube():
    """Return a cube of 12 triangles."""
    vertices = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)


def soup(count=2000, seed=3):
    """Return random triangles of many sizes: needles, duplicates and degenerate ones among them."""
    rng = np.random.default_rng(seed)
    center = rng.uniform(-1.0, 1.0, (count, 1, 3))
    size = 10.0 ** rng.uniform(-3.0, 0.0, (count, 1, 1))
    corners = center + size * rng.normal(size=(count, 3, 3))
    corners[::10, 2] = corners[::10, 1] + 1.0e-4 * rng.normal(size=(len(corners[::10]), 3))  # needles
    corners[1::10, 2] = corners[1::10, 1]  # degenerate: an edge
    corners[2::50, 1:] = corners[2::50, :1]  # degenerate: a point
    corners[3::10] = corners[4::10]  # duplicates
    corners[5::10, :, 0] = corners[5::10, :1, 0]  # axis-aligned
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def box36():
    """Return a mesh of the size of a Cornell box: three cubes, one seen from inside."""
    vertices, faces = cube()
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    parts = [vertices, 0.3 * vertices - [0.4, 0.7, 0.2], 0.25 * vertices @ turn]
    return np.concatenate(parts).astype(np.float32), np.concatenate([faces + 8 * i for i in range(3)]).astype(np.int32)


def far_sphere():
    """Return a sphere of radius 1 at distance 1000 from the origin, where float32 resolves 6e-5."""
    vertices, faces = sphere()
    return vertices + np.float32([1000.0, -300.0, 500.0]), faces


MESHES = {"box36": box36, "sphere": sphere, "soup": soup, "far_sphere": far_sphere, "cube": cube}


def unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1.0e-30)


def make_rays(kind, vertices, faces, count, seed=0):
    """Return origins and directions of one family of rays."""
    rng = np.random.default_rng(seed)
    low, high = vertices.min(0).astype(np.float64), vertices.max(0).astype(np.float64)
    size = (high - low).max()
    origins = rng.uniform(low - 0.3 * size, high + 0.3 * size, (count, 3))
    corners = vertices[faces[rng.integers(len(faces), size=count)]].astype(np.float64)
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    if kind == "random":
        return origins, unit(rng.normal(size=(count, 3)))
    if kind == "axis":  # parallel to an axis or to an axis plane: one or two direction components are 0
        directions = rng.normal(size=(count, 3)) * (rng.permuted(np.tile([1, 0, 0], (count, 1)), axis=1) > 0)
        plane = rng.random(count) < 0.5
        directions[plane] = rng.normal(size=(plane.sum(), 3))
        directions[plane, rng.integers(3, size=plane.sum())] = 0.0
        through = rng.random(count) < 0.5  # through the origins' planes of vertices: exactly on box borders
        origins[through] = corners[through, 0] - directions[through] * rng.uniform(0.5, 2.0, (through.sum(), 1)) * size
        return origins, unit(directions)
    if kind == "vertex":
        return origins, unit(corners[:, 0] - origins)
    if kind == "edge":
        point = corners[:, 0] + rng.random((count, 1)) * (corners[:, 1] - corners[:, 0])
        return origins, unit(point - origins)
    if kind == "grazing":  # in or almost in the plane of a triangle
        point = (weights[:, :, None] * corners).sum(1)
        normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        along = unit(corners[:, 1] - corners[:, 0] + 0.3 * (corners[:, 2] - corners[:, 0]))
        tilt = np.where(rng.random((count, 1)) < 0.3, 0.0, 10.0 ** rng.uniform(-7.0, -2.0, (count, 1)))
        directions = unit(along + tilt * normal)
        return point - size * directions, directions
    if kind == "distant":
        point = (weights[:, :, None] * corners).sum(1)
        origins = point + size * 10.0 ** rng.uniform(1.0, 3.0, (count, 1)) * unit(rng.normal(size=(count, 3)))
        return origins, unit(point - origins)
    raise ValueError(kind)


KINDS = ("random", "axis", "vertex", "edge", "grazing", "distant")


def marginal(vertices, faces, origins, directions, face, gap):
    """Return True, computed in double precision, where float32 cannot tell that a hit is wrong.

    A float32 ray is uncertain by ``EDGE_TOLERANCE`` of the coordinates' size. Along the ray that is more where the
    triangle is seen edge-on, and may explain the ``gap`` between two distances; measured in barycentrics it is more for
    small triangles, too, and the hit may lie on the border. Beyond a tenth of the triangle nothing can be told.
    """
    corner = vertices[faces[face]].astype(np.float64)
    o, d = origins.astype(np.float32).astype(np.float64), directions.astype(np.float32).astype(np.float64)
    e1, e2, p = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], o - corner[:, 0]
    normal, moment = np.cross(e1, e2), np.cross(p, d)
    det = (d * normal).sum(1)
    with np.errstate(all="ignore"):
        u, v = -(moment * e2).sum(1) / det, (moment * e1).sum(1) / det
        reach = np.abs(corner - o[:, None]).max((1, 2)) + np.abs(corner).max((1, 2))
        cosine = np.abs(det) / np.maximum(np.linalg.norm(normal, axis=1) * np.linalg.norm(d, axis=1), 1.0e-300)
        depth = EDGE_TOLERANCE * reach / cosine
        longest = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=2).max(1)
        height = np.linalg.norm(normal, axis=1) / np.maximum(longest, 1.0e-300)
        slack = EDGE_TOLERANCE * reach / np.maximum(height * cosine, 1.0e-300)
    border = np.minimum(np.minimum(np.abs(u), np.abs(v)), np.abs(1.0 - u - v))
    return ~(border > slack) | ~(slack < 0.1) | (gap <= depth)


def assert_same_hits(vertices, faces, origins, directions, hits, reference):
    """Check that two sets of closest hits agree up to ties and up to rays within rounding of a border."""
    assert np.isfinite(hits["t"]).all() and np.isfinite(hits["u"]).all() and np.isfinite(hits["v"]).all()
    found, expected = hits["face"] >= 0, reference["face"] >= 0
    scale = np.abs(origins).max(1) + np.abs(vertices).max() + np.minimum(reference["t"], 1.0e6)
    tie = found & expected & (np.abs(hits["t"] - reference["t"]) <= TIE_TOLERANCE * scale)
    different = ~(tie | (~found & ~expected))
    if not different.any():
        return
    i = np.nonzero(different)[0]
    closer = np.where(found[i] & (~expected[i] | (hits["t"][i] < reference["t"][i])), 0, 1)
    face = np.where(closer == 0, hits["face"][i], reference["face"][i])
    gap = np.where(found[i] & expected[i], np.abs(hits["t"][i] - reference["t"][i]), np.inf)
    wrong = ~marginal(vertices, faces, origins[i], directions[i], face, gap)
    assert not wrong.any(), (
        f"{wrong.sum()} of {len(hits)} rays differ, e.g. ray {i[wrong][0]}: o={origins[i[wrong][0]]}, "
        f"d={directions[i[wrong][0]]}: {hits[i[wrong][0]]} instead of {reference[i[wrong][0]]}"
    )
