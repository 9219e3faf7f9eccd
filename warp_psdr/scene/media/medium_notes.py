"""Likely mistakes about media, noted on load: sides that disagree, boxes of grids that end early, what is opaque."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from warp_psdr.scene.lights.emitters import IN_MEDIA
from warp_psdr.scene.origin import moved

if TYPE_CHECKING:
    from warp_psdr.scene.description import MediumDescription, SceneDescription, ShapeDescription

    #: A shape that bounds media, and the medium that it has on the side that was met.
    Answer: TypeAlias = tuple[ShapeDescription, MediumDescription | None]

#: Directions that are asked from a point, none along an axis.
DIRECTIONS = np.array([[0.31, 0.62, 0.72], [-0.81, 0.27, 0.52], [0.44, -0.87, 0.23], [-0.36, -0.29, -0.89]])
#: Triangles of a shape from which is asked what lies around it.
ASKED = 3
#: Tests of a ray with a triangle, at most: some tenths of a second. Sensors come first, then shapes by their order.
MOST_TESTS = 2_000_000
#: Distance, over the extent of the interfaces, within which surfaces coincide, and tell nothing.
TOUCHING = 1e-5
#: Share of a grid's box by which an interface has to reach beyond it.
BEYOND = 1e-3
#: Optical thickness from which a medium is noted: a slab in the sun is exact at 6e5, and 4 % too dark at 6e6.
OPAQUE = 1e6


def note_media(scene: SceneDescription) -> None:
    """Add notes on what is likely a mistake about a scene's media."""
    bounding = [s for s in scene.shapes if s.interior is not None or s.exterior is not None]
    meshes = [s for s in bounding if s.geometry is None]
    if meshes:
        interfaces = Interfaces(meshes)
        scene.notes += _about_sensors(scene, interfaces) + _about_lights(scene, interfaces)
        scene.notes += _about_shapes(meshes, interfaces)
    scene.notes += _about_grids(scene, bounding) + _about_thickness(scene, bounding)


class Interfaces:
    """The triangles of shapes that bound media.

    Args:
        shapes: Those.
    """

    def __init__(self, shapes: list[ShapeDescription]):
        corners = [s.vertices.astype(np.float64)[s.faces] for s in shapes]
        self._shapes = shapes
        self._of_face = np.repeat(np.arange(len(shapes)), [len(c) for c in corners])
        self._corners = np.concatenate(corners)
        self._origin, self._a, self._b = self._edges(self._corners)
        turned = np.array([-1.0 if s.flip_normals else 1.0 for s in shapes])[self._of_face]
        self._normal = np.cross(self._a, self._b) * turned[:, None]
        self._first = np.concatenate([[0], np.cumsum([len(c) for c in corners])])
        self._touching = TOUCHING * float(np.ptp(self._corners.reshape(-1, 3), axis=0).max())
        self._left = MOST_TESTS

    @staticmethod
    def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]

    def met(self, o: np.ndarray, d: np.ndarray, own: int = -1) -> Answer | None:
        """Return the first interface on a ray, its ``own`` triangle aside; None: none, or it touches the origin."""
        if self._left < len(self._corners):
            return None
        self._left -= len(self._corners)
        p = np.cross(d, self._b)
        det = np.einsum("ij,ij->i", self._a, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = o - self._origin
            u = np.einsum("ij,ij->i", s, p) / det
            q = np.cross(s, self._a)
            v = q @ d / det
            t = np.einsum("ij,ij->i", self._b, q) / det
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > -self._touching)
        if own >= 0:
            inside[own] = False
        if not inside.any():
            return None
        face = int(np.argmin(np.where(inside, t, np.inf)))
        shape = self._shapes[self._of_face[face]]
        if t[face] <= self._touching:
            return None
        return shape, shape.interior if self._normal[face] @ d > 0.0 else shape.exterior

    def around(self, point: np.ndarray) -> list[Answer]:
        """Return what interfaces say of the medium at a point."""
        center = self._corners.reshape(-1, 3).mean(axis=0) - point
        center = center / max(float(np.linalg.norm(center)), 1e-300) + 1e-3 * DIRECTIONS[0]
        found = [self.met(point, d / np.linalg.norm(d)) for d in (*DIRECTIONS, center)]
        return [answer for answer in found if answer is not None]

    def outside(self, number: int) -> list[Answer]:
        """Return what interfaces say of the medium before some triangles of a shape."""
        first, end = self._first[number], self._first[number + 1]
        found = []
        for face in np.unique(np.linspace(first, end - 1, ASKED).astype(int)).tolist():
            n = self._normal[face] / max(float(np.linalg.norm(self._normal[face])), 1e-300)
            # Not along the normal, which may lead to corners of parallel faces.
            d = n + 0.1 * DIRECTIONS[0]
            found.append(self.met(self._corners[face].mean(axis=0), d / np.linalg.norm(d), face))
        return [answer for answer in found if answer is not None]


def _disagreeing(found: list[Answer], medium: MediumDescription | None) -> Answer | None:
    """Return an answer that all share, and that is another medium; None: there is none."""
    media = {id(m) for _shape, m in found}
    return found[0] if len(media) == 1 and found[0][1] is not medium else None


def _called(medium: MediumDescription | None) -> str:
    return "no medium" if medium is None else f"'{medium.path}'"


def _about_sensors(scene: SceneDescription, interfaces: Interfaces) -> list[str]:
    notes = []
    for sensor in scene.sensors:
        if sensor.kind in ("batch", "irradiancemeter"):
            continue
        pose = sensor.to_world.astype(np.float64)
        start = pose[:3, 3] + sensor.near_clip * pose[:3, 2]
        wrong = _disagreeing(interfaces.around(start), sensor.medium)
        if wrong is not None:
            notes.append(
                f"'{sensor.path}' names {_called(sensor.medium)}, but where it stands '{wrong[0].path}' has "
                f"{_called(wrong[1])}: rays that meet it are counted as invalid; give the sensor that 'medium'"
            )
    return notes


def _about_lights(scene: SceneDescription, interfaces: Interfaces) -> list[str]:
    notes = []
    places = []
    for e in scene.emitters:
        if e.kind in IN_MEDIA:
            place = e.position if e.to_world is None else e.to_world[:3, 3]
            assert place is not None
            places.append((e, place))
    # Shapes without triangles have the corners of a box around them.
    shining = [(s.emitter, s.vertices[s.faces[0] if len(s.faces) else ...]) for s in scene.shapes if s.emitter]
    places += [(light, corners.mean(axis=0)) for light, corners in shining]
    for light, place in places:
        if light.medium is None:
            continue
        wrong = _disagreeing(interfaces.around(place.astype(np.float64)), light.medium)
        if wrong is not None:
            notes.append(
                f"'{light.path}' names {_called(light.medium)}, but where it is '{wrong[0].path}' has "
                f"{_called(wrong[1])}, and that is what its light flies through"
            )
    return notes


def _about_shapes(shapes: list[ShapeDescription], interfaces: Interfaces) -> list[str]:
    notes = []
    for number, shape in enumerate(shapes):
        wrong = _disagreeing(interfaces.outside(number), shape.exterior)
        if wrong is not None:
            notes.append(
                f"'{shape.path}' has {_called(shape.exterior)} for its exterior, where '{wrong[0].path}' has "
                f"{_called(wrong[1])}: rays between them are counted as invalid; let both name one medium"
            )
    return notes


def _about_grids(scene: SceneDescription, shapes: list[ShapeDescription]) -> list[str]:
    """Note grids of extinction that end inside of what they are the interior of, without vanishing there."""
    notes = []
    for shape in shapes:
        m = shape.interior
        if m is None or not m.grids:
            continue
        assert m.sigma_t.to_world is not None
        pose = moved(m.sigma_t.to_world, scene.origin)
        points = (shape.vertices.astype(np.float64) - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
        values = m.sigma_t.value if m.sigma_t.value.ndim == 4 else m.sigma_t.value.reshape(1, 1, 1, -1)
        low, high = points.min(axis=0) < -BEYOND, points.max(axis=0) > 1.0 + BEYOND
        # Axes x, y, z of the box are the axes 2, 1, 0 of the grid.
        ends = [low[k] and values.take(0, 2 - k).any() for k in range(3)]
        ends += [high[k] and values.take(-1, 2 - k).any() for k in range(3)]
        if m.scale > 0.0 and any(ends):
            notes.append(
                f"'{m.sigma_t.parameter}' is not 0 at the border of its box, which lies inside of '{shape.path}': the "
                "medium ends there, abruptly; let 'to_world' place the box (the unit cube from 0 to 1 without it) "
                "around the shape, or let the grid vanish at its border"
            )
    return notes


def _about_thickness(scene: SceneDescription, shapes: list[ShapeDescription]) -> list[str]:
    """Note media whose optical thickness is beyond what light gets through."""
    corners = np.concatenate([s.vertices for s in scene.shapes] or [np.zeros((1, 3))])
    extents: dict[int, tuple[MediumDescription, float]] = {}
    around = [(s.exterior, corners) for s in shapes] + [(s.medium, corners) for s in scene.sensors]
    for m, points in [*((s.interior, s.vertices) for s in shapes), *around]:
        if m is not None:
            size = float(np.linalg.norm(np.ptp(points.astype(np.float64), axis=0)))
            extents[id(m)] = m, max(size, extents[id(m)][1] if id(m) in extents else 0.0)
    return [
        f"'{m.path}' has an optical thickness of {thickness:.1g}: light gets hardly deeper than float32 tells places "
        "apart, and what is scattered back may be too dark by some percent; lower 'sigma_t' or 'scale', or give the "
        "shape a surface in place of a medium"
        for m, thickness in ((m, float(m.sigma_t.value.max()) * m.scale * size) for m, size in extents.values())
        if thickness >= OPAQUE
    ]
