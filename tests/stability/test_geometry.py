"""Meshes that are cut, split, doubled or nearly touching in ways that leave the surface as it is, or as good as.

The moving box of ``sweeps.room`` is compared with the same box as twelve triangles: what differs is the mesh.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology import edges, t_junctions

from .record import Case, parameters
from .sweeps import VELOCITY, apart, box, derivatives, passes, rectangle, reference, room, slope_error

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

BOX = box((0.2, 0.1, 1.0), 0.5)
FLOOR = rectangle((0.0, 0.0, 0.0), 3.0, np.eye(4))


def with_mesh(name: str, vertices: np.ndarray, faces: np.ndarray, **more) -> dict:
    scene = room()
    scene[name] = scene[name] | {"vertices": vertices, "faces": np.asarray(faces)} | more
    return scene


def cut_everywhere(mesh, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut every edge at a share of it, from its end of lower number, and every triangle into four: needles at 1e-3."""
    vertices, faces = list(mesh[0]), []
    middle: dict[tuple[int, int], int] = {}

    def at(i: int, j: int) -> int:
        key = (min(i, j), max(i, j))
        if key not in middle:
            vertices.append((1.0 - share) * vertices[key[0]] + share * vertices[key[1]])
            middle[key] = len(vertices) - 1
        return middle[key]

    for a, b, c in mesh[1]:
        x, y, z = at(a, b), at(b, c), at(c, a)
        faces += [[a, x, z], [x, b, y], [z, y, c], [x, y, z]]
    return np.array(vertices), np.array(faces)


def cut_alone(mesh, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut the first side of every triangle, whose neighbour keeps it whole: a T-junction at each."""
    vertices, faces = list(mesh[0]), []
    for a, b, c in mesh[1]:
        vertices.append((1.0 - share) * vertices[a] + share * vertices[b])
        faces += [[a, len(vertices) - 1, c], [len(vertices) - 1, b, c]]
    return np.array(vertices), np.array(faces)


def needles(name: str, mesh, exponents) -> list[dict]:
    return [with_mesh(name, *cut_everywhere(mesh, 10.0**-k)) for k in exponents]


def junctions(shares) -> list[dict]:
    return [with_mesh("box", *cut_alone(BOX, share)) for share in shares]


def doubled(name: str, mesh) -> dict:
    return with_mesh(name, mesh[0], np.concatenate([mesh[1], mesh[1]]))


ODD = [
    doubled("box", BOX),
    doubled("floor", FLOOR),
    with_mesh("box", BOX[0], np.concatenate([BOX[1], BOX[1][:1]])),
    with_mesh("box", BOX[0], np.concatenate([BOX[1], [[0, 0, 1], [1, 1, 1], [0, 1, 0]]])),
    with_mesh("box", BOX[0], np.concatenate([BOX[1], [[0, 3, 7]]])),  # three faces at two edges
    with_mesh("box", BOX[0][BOX[1].reshape(-1)], np.arange(36).reshape(12, 3)),  # nothing is shared
]


def same(scenes) -> float:
    """Return the largest relative difference of image and interior derivative, for the same random numbers."""
    base, _ = reference()
    results = [passes(psdr.load_dict(scene), VELOCITY, boundary=False) for scene in scenes]
    return max(max(apart(r.image, base.image), apart(r.interior, base.interior)) for r in results)


def slope(scenes) -> float:
    """Return the largest error of the regression slope of the whole derivative."""
    _, expected = reference()
    return max(slope_error(derivatives(scene), expected) for scene in scenes)


def resting(gap: float, ratio: float | None = None) -> np.ndarray:
    """Return sums of interior derivatives, one a batch, of an upright box a gap above the floor."""
    scene = psdr.load_dict(with_mesh("box", *box((0.2, 0.1, 0.5 + gap), 0.5, 0.0)))
    if ratio is not None:
        scene.contact_ratio = ratio
    params = psdr.traverse(scene)
    tangents = {"box.vertex_positions": np.broadcast_to(VELOCITY, (8, 3)).astype(np.float32)}
    options = {"integrator": psdr.PathIntegrator(max_depth=3, boundary=None), "spp": 64}
    images = (psdr.render_forward(scene, params, tangents, seed=seed, **options).numpy() for seed in range(64))
    return np.array([image.sum(dtype=np.float64) for image in images])


def contact(apart_by) -> float:
    """Return the largest standard deviation of gaps, below 0: overlaps, over that of a gap of 0.1."""
    return max(float(resting(gap).std(ddof=1)) for gap in apart_by) / float(resting(0.1).std(ddof=1))


def accumulated_in() -> float:
    """Return the noise of derivatives of a tilted box 1e-2 .. 1e-6 inside of the floor, over that of one 0.1 inside."""
    vertices, faces = box((0.2, 0.1, 0.0), 0.5)
    vertices[:, 2] -= vertices[:, 2].min()

    def noise(depth: float) -> float:
        images = derivatives(with_mesh("box", vertices - [0.0, 0.0, depth], faces))
        return float(images.std(axis=0).mean()) if np.isfinite(images).all() else np.inf

    return max(noise(depth) for depth in (1e-2, 1e-4, 1e-6)) / noise(0.1)


def lids(thicknesses) -> float:
    """Return the largest error of the slope of derivatives of hovering slabs on those of a sheet at their top."""
    vertices, faces = box((0.0, 0.0, 0.0), 1.0, 0.0)
    found = 0.0
    for thickness in thicknesses:
        slab = vertices * [1.0, 1.0, 0.5 * thickness] + [0.2, 0.1, 0.5]
        sheet = derivatives(with_mesh("box", *rectangle((0.2, 0.1, 0.5 + 0.5 * thickness), 1.0, np.eye(4))), 16, 100)
        found = max(found, slope_error(derivatives(with_mesh("box", slab, faces)), sheet.mean(axis=0)))
    return found


def vast_mesh() -> float:
    """Return the memory, in GB, in which 10^6 triangles are loaded, rendered and differentiated; nan: no derivative."""
    program = """
import resource, numpy as np, warp_psdr as psdr
n = 708
x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
z = 0.05 * np.sin(9 * x) * np.cos(7 * y)
i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
scene = psdr.load_dict({"type": "scene",
    "camera": {"type": "perspective", "film": film,
               "to_world": psdr.Transform.look_at((0, -3, 2), (0, 0, 0), (0, 0, 1))},
    "mesh": {"type": "mesh", "vertices": np.stack([x, y, z], -1).reshape(-1, 3), "faces": faces, "face_normals": True},
    "sky": {"type": "constant"}})
params = psdr.traverse(scene)
params.requires_grad("mesh.vertex_positions")
integrator = psdr.PathIntegrator(max_depth=2)
image = psdr.render(scene, integrator=integrator, spp=4).numpy()
psdr.render_backward(scene, params, np.ones((32, 32, 3)), integrator=integrator, spp=4)
gradient = params["mesh.vertex_positions"].grad.numpy()
assert len(faces) > 990000 and np.isfinite(gradient).all() and gradient.any()
assert np.isfinite(image).all() and image.any()
print("GB", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=os.environ, check=False)
    assert done.returncode == 0, done.stderr
    return float(done.stdout.split("GB")[-1])


CASES = (
    Case(
        family="geometry", name="needles of 1e-1 .. 1e-8, image and interior", slow=True, bound=5e-7,
        measure=lambda: same(needles("box", BOX, range(1, 9)) + needles("floor", FLOOR, (3, 6))),
        hard="needles have no normal to speak of, and edge functions of rounding noise",
        naive="false hits all over the image: errors of 1e-2 at 1e-6 and 0.3 at 1e-7",
    ),
    Case(
        family="geometry", name="needles of 1e-1, 1e-5 and 1e-7, derivative", slow=True, bound=2e-3,
        measure=lambda: slope(needles("box", BOX, (1, 5, 7))),
        hard="needles tilt by rounding, so that their long sides look like folds a hair from the true edge",
        naive="each is found to have the jump of the true edge: a quarter of the image is wrong at 1e-5",
    ),
    Case(
        family="geometry", name="needles, 11 widths between, derivative", bound=1.7e-3, slow=True,
        measure=lambda: slope(
            [with_mesh("box", *cut_everywhere(BOX, w)) for w in
             (1e-3, 3e-4, 1e-4, 5e-5, 3e-5, 2e-5, 1.5e-5, 7e-6, 4e-6, 2e-6, 1e-6)]),
        hard="as before, around the distances at which vertices are welded and edges are looked at",
        naive="as before: slope 1.56 at 7e-6",
    ),
    Case(
        family="geometry", name="T-junctions, image and interior", bound=5e-7,
        measure=lambda: same(junctions((0.3, 3e-2, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6))),
        hard="the vertex on a side is off it by rounding",
        naive="cracks",
    ),
    Case(
        family="geometry", name="T-junctions, derivative", slow=True, bound=2e-3,
        measure=lambda: slope(junctions((0.3, 1e-3))),
        hard="sides of different length do not match, so all of them look open",
        naive="a silhouette along such sides counts twice: slope 1.07, a third of the image wrong",
    ),
    Case(
        family="geometry", name="doubled, flat, inner and unshared faces, image and interior", bound=0.0,
        measure=lambda: same(ODD),
        hard="two triangles are hit at one distance; faces without an area have no normal",
        naive="NaN from the normal of a flat face",
    ),
    Case(
        family="geometry", name="doubled, flat, inner and unshared faces, derivative", bound=2.2e-3, slow=True,
        measure=lambda: slope(ODD),
        hard="edges with one, three and four faces",
        naive="unshared vertices make every edge a silhouette: METHODS' 4.0 for split vertices",
    ),
    Case(
        family="geometry", name="contact: noise at gaps of 1e-2 and 1e-6 .. 0 .. -1e-2", bound=4.0, slow=True,
        measure=lambda: contact((1e-2, 1e-6, 0.0, -1e-4, -1e-2)),
        hard="the geometric factor changes at the rate v / r, and r gets as small as the gap",
        naive="10 times the noise of a gap of 0.1, and more with more samples (6.2 with a quarter of them)",
    ),
    Case(
        family="geometry", name="contact: noise at gaps of 1e-3 and 1e-4", bound=14.0, slow=True,
        measure=lambda: contact((1e-3, 1e-4)),
        hard="light rises within the gap's width: samples are as large as v / gap, and count",
        naive="a weight as at a contact takes the rise: little noise, and derivatives of the wrong sign",
    ),
    Case(
        family="geometry", name="pushed into the floor by 1e-2 .. 1e-6: noise", bound=1.3, slow=True,
        measure=accumulated_in, hard="the curve of intersection shrinks to a point, next to which the surfaces touch",
        naive="without the curve the derivative lacks its motion; without the contact's weight it has no variance",
    ),
    Case(
        family="geometry", name="slabs of 1e-3 .. 1e-6, derivative", bound=2e-3, slow=True,
        measure=lambda: lids((1e-3, 1e-4, 2e-5, 1e-5, 7e-6, 5e-6, 4e-6, 3e-6, 1e-6)),
        hard="the edges around the upper and around the lower face have nearly one image",
        naive="each is found to have the jump of both: 0.39 at 4e-6",
    ),
    Case(
        family="geometry", name="10^6 triangles, memory [GB]", bound=2.0, slow=True, measure=vast_mesh,
        hard="edges, their adjacency and the tree of a million triangles at once",
        naive="a dense table of edge pairs does not fit any machine",
    ),
)  # fmt: skip


@pytest.mark.slow_rows("T-junctions, image and interior")
@pytest.mark.parametrize("case", parameters(CASES))
def test_geometry(case, check) -> None:
    check(case)


@pytest.mark.slow
def test_without_the_cut_t_junctions_count_twice(monkeypatch) -> None:
    monkeypatch.setattr(edges, "cut_sides", lambda points, group, shape, sides, face, tolerance: (sides, face))
    assert slope(junctions((0.3,))) > 0.05


@pytest.mark.slow
def test_without_the_tilt_needles_count_twice(monkeypatch) -> None:
    monkeypatch.setattr(edges, "TILT", 0.0)
    assert slope([with_mesh("box", *cut_everywhere(BOX, 4e-6))]) > 0.1


@pytest.mark.slow
def test_without_its_weight_a_contact_is_noisy() -> None:
    assert resting(0.0, 0.0).std(ddof=1) > 8.0 * resting(0.1).std(ddof=1)


def test_coincident_faces_of_two_materials_show_either() -> None:
    """Which of the two is undefined; that nothing else shows is not."""
    dark, bright = (with_mesh("floor", *FLOOR, bsdf={"type": "diffuse", "reflectance": r}) for r in (0.2, 0.6))
    both = bright | {"other": dark["floor"]}
    images = [passes(psdr.load_dict(scene), VELOCITY, boundary=False).image for scene in (dark, both, bright)]
    assert (images[0] <= images[1] * (1 + 1e-6)).all()
    assert (images[1] <= images[2] * (1 + 1e-6)).all()
    full = passes(psdr.load_dict(both), VELOCITY)
    assert np.isfinite(full.full).all()


def test_sides_are_cut_where_vertices_lie_on_them() -> None:
    points = np.array([[0, 0, 0], [4, 0, 0], [1, 0, 0], [3, 0, 0], [3, 0, 0], [2, 1e-3, 0], [2, 0, 0]], np.float64)
    group = np.array([0, 1, 2, 3, 3, 5, 6])
    shape = np.array([0, 0, 0, 0, 0, 0, 1])
    sides = np.array([[0, 1], [2, 3], [4, 5], [5, 6], [6, 2]])
    cut, face = t_junctions.cut_sides(points, group, shape, sides, np.arange(5), np.full(5, 1e-6))
    found = [tuple(group[s].tolist()) for s, f in zip(cut, face, strict=True) if f == 0]
    # In order, once a position, neither vertices off the side nor those of another shape.
    assert found == [(0, 2), (2, 3), (3, 1)]
    assert [tuple(s) for s, f in zip(cut.tolist(), face, strict=True) if f > 0] == [
        tuple(s) for s in sides[1:].tolist()
    ]
