"""What ``rings.py`` reads of Middlebury's folders: cameras, photographs, silhouettes, and the hull of the silhouettes.

The data: https://vision.middlebury.edu/mview/data. S. Seitz, B. Curless, J. Diebel, D. Scharstein, R. Szeliski: A
Comparison and Evaluation of Multi-View Stereo Reconstruction Algorithms. CVPR 2006.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import psdr
from PIL import Image
from scipy import ndimage, optimize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import remesh

#: Names of what is sought.
SHAPE, ALBEDO, LIGHT = "object.vertex_positions", "object.vertex_color", "sky.data"
#: Nodes of the hull's grid along the longest edge of its box, and what is added to the box on all sides, as a share.
NODES, MARGIN = 128, 0.06
#: Most that principal points may be off, pixels; nodes of the hulls that tell.
OFF, COARSE = 3.0, 48
#: Edge of the squares of pixels that are averaged; of so many photographs, the last is kept.
REDUCE, EVERY = 4, 4
#: Texels of the light, and its radiance and the object's albedo at the start.
SKY, RADIANCE, PAINT = (12, 24), 0.8, 0.8
#: Photographs a step; samples a pixel of an image, and of its derivatives.
VIEWS, SPP, SPP_GRADIENT = 2, 8, 4
#: Adam forgets soon: its largest gradients are those of the first steps.
BETAS = (0.9, 0.95)


@dataclass(frozen=True)
class Stage:
    """Steps with one mesh.

    Attributes:
        steps: their number.
        spacing: length of an edge, m.
        smooth: weight of the Laplacian.
        rates: of learning, by name; 0: held.
    """

    steps: int
    spacing: float
    smooth: float
    rates: dict[str, float]


STAGES = (
    Stage(40, 0.0028, 1.0, {SHAPE: 0.0, ALBEDO: 0.0, LIGHT: 0.05}),
    Stage(200, 0.0028, 4.0, {SHAPE: 5e-3, ALBEDO: 0.003, LIGHT: 0.05}),
    Stage(260, 0.0013, 3.0, {SHAPE: 2e-3, ALBEDO: 0.015, LIGHT: 0.04}),
)
QUICK = (
    Stage(20, 0.006, 1.0, {SHAPE: 0.0, ALBEDO: 0.0, LIGHT: 0.1}),
    Stage(40, 0.006, 4.0, {SHAPE: 2e-3, ALBEDO: 0.01, LIGHT: 0.05}),
)


class Backdrop(NamedTuple):
    """How an object is told from what is behind it.

    Attributes:
        signal: codes (H, W, 3) -> (H, W), which is larger on the object.
        judging: threshold of the silhouettes that judge.
        carving: of those that carve and are fitted.
        grown: by how many pixels silhouettes grow.
        shrunk: by how many they shrink then.
        shadow: holes of fewer pixels are shadows on the object, and filled.
    """

    signal: Callable[[np.ndarray], np.ndarray]
    judging: float
    carving: float
    grown: int
    shrunk: int
    shadow: int


#: The dinosaur's README says how to find silhouettes that judge. Its threshold cuts off what lies in shadow.
BLACK = Backdrop(lambda codes: codes.max(axis=2), 0.19, 0.15, 10, 7, 1000)
#: The cloth behind the temple is brighter than what lies in shadow, but not yellow: outside the box, the red code is at
#: most 0.1 above the blue one. Silhouettes do not grow, so that narrow gaps between columns stay open.
CLOTH = Backdrop(lambda codes: codes[..., 0] - codes[..., 2], 0.1, 0.1, 2, 2, 600)
BACKDROPS = {"templeSR_par.txt": CLOTH}


@dataclass(frozen=True)
class Model:
    """What is sought.

    Attributes:
        vertices: (N, 3), m.
        faces: (M, 3).
        albedo: (N, 3) of the vertices.
        light: (H, W, 3) radiance from all directions.
    """

    vertices: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray
    light: np.ndarray


class View(NamedTuple):
    """One photograph.

    Attributes:
        file: of the photograph.
        K: (3, 3) camera matrix, pixels; the centre of the top left pixel is (0, 0).
        R: (3, 3) rotation from the world to the camera.
        t: (3,) translation, m.
        carves: whether its silhouette is good.
        backdrop: of the photograph.
    """

    file: Path
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    carves: bool
    backdrop: Backdrop


def read_views(folder: Path) -> list[View]:
    """Return the photographs of a folder in the order of its list.

    Raises:
        FileNotFoundError: there is no list of cameras.
    """
    lists = sorted(Path(folder).glob("*_par.txt"))
    if not lists:
        raise FileNotFoundError(f"{folder} has no *_par.txt; unpack a data set of vision.middlebury.edu/mview there")
    good = sorted(Path(folder).glob("*_good_silhouette_images.txt"))
    names = set(good[0].read_text(encoding="utf-8").split()) if good else None
    views = []
    for line in lists[0].read_text(encoding="utf-8").splitlines()[1:]:
        name, *numbers = line.split()
        k, r, t = np.split(np.array(numbers, float), [9, 18])
        carves = names is None or name in names
        backdrop = BACKDROPS.get(lists[0].name, BLACK)
        views.append(View(Path(folder) / name, k.reshape(3, 3), r.reshape(3, 3), t, carves, backdrop))
    return views


def read_box(folder: Path) -> np.ndarray:
    """Return the corners (2, 3) of the object's box, m, from the folder's README."""
    lines = (Path(folder) / "README.txt").read_text(encoding="utf-8").splitlines()
    corners = [line.strip("() ").split() for line in lines if line.startswith("(")][:2]
    return np.array(corners, float)


def silhouette(signal: np.ndarray, threshold: float, backdrop: Backdrop = BLACK) -> np.ndarray:
    """Return where an object is in a photograph.

    Args:
        signal: (H, W), larger on the object.
        threshold: of the signal.
        backdrop: what is behind the object.

    Returns:
        (H, W) booleans.
    """
    margin = backdrop.grown + backdrop.shrunk
    # Beyond the frame lies what is at its border: an object that is cut off does not shrink there.
    padded = np.pad(signal > threshold, margin, mode="edge")
    grown = ndimage.distance_transform_edt(~padded) <= backdrop.grown
    shrunk = ndimage.distance_transform_edt(grown) > backdrop.shrunk
    inside = shrunk[margin:-margin, margin:-margin]
    parts, count = ndimage.label(inside)
    if count == 0:
        raise ValueError(f"no pixel is brighter than {threshold}; the photograph shows no object")
    inside = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    holes, _count = ndimage.label(~inside)
    return inside | (np.bincount(holes.ravel()) < backdrop.shadow)[holes]


def read_silhouette(view: View, *, judging: bool) -> np.ndarray:
    """Return the silhouette of a photograph: the one that judges, or the one that carves and is fitted."""
    backdrop = view.backdrop
    signal = backdrop.signal(np.asarray(Image.open(view.file).convert("RGB")) / 255.0)
    return silhouette(signal, backdrop.judging if judging else backdrop.carving, backdrop)


def signed_distance(inside: np.ndarray) -> np.ndarray:
    """Return distances to the outline of a silhouette, pixels, negative inside."""
    return ndimage.distance_transform_edt(~inside) - ndimage.distance_transform_edt(inside)


def hull(views: list[View], silhouettes: list[np.ndarray], box: np.ndarray, nodes: int = NODES) -> tuple:
    """Return vertices (N, 3) and triangles (M, 3) of what all silhouettes leave of a box.

    Each node of a grid gets the largest of its distances to the outlines, pixels. Views that do not see a node do not
    carve it.

    Args:
        views: photographs.
        silhouettes: theirs, (H, W) each.
        box: (2, 3) its corners, m.
        nodes: of the grid, along the box's longest edge.
    """
    size = box[1] - box[0]
    low, spacing = box[0] - MARGIN * size.max(), (1.0 + 2.0 * MARGIN) * size.max() / (nodes - 1)
    counts = np.ceil((size + 2.0 * MARGIN * size.max()) / spacing).astype(int) + 1
    points = low + spacing * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    field = np.full(tuple(counts), -np.inf)
    for view, inside in zip(views, silhouettes, strict=True):
        seen = (points @ view.R.T + view.t) @ view.K.T
        x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
        values = ndimage.map_coordinates(signed_distance(inside), [y, x], order=1, mode="constant", cval=-np.inf)
        field = np.maximum(field, values)
    outside = np.pad(np.ones(counts - 2, bool), 1)
    field = np.where(outside, field, np.maximum(field, 1.0))  # closed where the grid ends
    vertices, quads = remesh.surface_net(field)
    return low + spacing * vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def lowered(view: View, offset: float) -> View:
    """Return a view whose principal point is lower in the image by an offset, pixels."""
    lens = view.K.copy()
    lens[1, 2] += offset
    return view._replace(K=lens)


def offset_of(views: list[View], silhouettes: list[np.ndarray], box: np.ndarray) -> float:
    """Return by how much principal points are too high, pixels: silhouettes that agree leave the largest hull.

    An offset along the ring's axis, to the side in these photographs, moves the object, and the hull does not tell it.
    """

    def negative_volume(offset: float) -> float:
        vertices, faces = hull([lowered(view, offset) for view in views], silhouettes, box, COARSE)
        corners = vertices[faces]
        return -float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0

    return float(optimize.minimize_scalar(negative_volume, bounds=(-OFF, OFF), options={"xatol": 0.1}).x)


class Ring:
    """The photographs of one object, reduced, and their cameras.

    Args:
        folder: with the photographs.
        nodes: of the hull's grid, along the box's longest edge.

    Attributes:
        views: what the folder holds, with the principal points that the silhouettes ask for.
        offset: by how much these are lower than the folder's, pixels.
        given: numbers of the views that are given; all that is recovered comes of them.
        kept: of those that judge.
        linear: (H, W, 3) of each view: codes, taken for linear, and 0 outside of the silhouette.
        inside: (H, W) of each view: pixels that judge, those of the silhouette.
        hull: vertices and triangles.
    """

    def __init__(self, folder: Path, nodes: int = NODES):
        self.views = read_views(folder)
        self.kept = list(range(EVERY - 1, len(self.views), EVERY))
        self.given = [i for i in range(len(self.views)) if i not in self.kept]
        outlined = [read_silhouette(view, judging=False) for view in self.views]
        carving, box = [i for i in self.given if self.views[i].carves], read_box(folder)
        silhouettes = [outlined[i] for i in carving]
        self.offset = offset_of([self.views[i] for i in carving], silhouettes, box)
        self.views = [lowered(view, self.offset) for view in self.views]
        self.hull = hull([self.views[i] for i in carving], silhouettes, box, nodes)
        self.linear, self.inside = [], []
        for view, inside in zip(self.views, outlined, strict=True):
            photograph = psdr.Photograph(view.file, response=1.0, reduce=REDUCE, saturated=2.0)
            h, w = photograph.shape
            seen, judged = (
                mask.reshape(h, REDUCE, w, REDUCE).mean(axis=(1, 3))
                for mask in (inside, read_silhouette(view, judging=True))
            )
            self.linear.append(np.where(seen[..., None] > 0.0, photograph.linear, 0.0).astype(np.float32))
            self.inside.append(judged > 0.5)

    def sensor(self, i: int) -> dict:
        """Return the camera of a view, of a photograph that is reduced."""
        view, (h, w) = self.views[i], self.inside[i].shape
        lens = view.K.copy()
        lens[:2] /= REDUCE
        lens[:2, 2] = (view.K[:2, 2] + 0.5) / REDUCE - 0.5
        return psdr.cameras.from_opencv(lens, view.R, view.t, (w, h))

    def decibels(self, image: np.ndarray, i: int) -> float:
        """Return 10 log10 of the inverse mean square of codes' errors inside the silhouette of a view."""
        error = np.clip(image, 0.0, 1.0) - np.clip(self.linear[i], 0.0, 1.0)
        return float(-10.0 * np.log10(np.mean(error[self.inside[i]] ** 2)))


def start(ring: Ring) -> Model:
    """Return the hull, of one albedo in even light."""
    vertices, faces = ring.hull
    return Model(vertices, faces, np.full(vertices.shape, PAINT), np.full((*SKY, 3), RADIANCE))


def lamp() -> np.ndarray:
    """Return a light that shows shapes: bright from one side, (H, W, 3)."""
    bright = np.full((*SKY, 3), 0.2)
    bright[:5, : SKY[1] // 2] = 2.5
    return bright
