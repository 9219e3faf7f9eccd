"""A camera's projection on the host, in double precision: which edges and triangles its film can see.

An eye is homogeneous, (e, w): the direction from a point x towards it is e - w x, with w = 1 for a pinhole and the
centre of a lens, and w = 0, e = -M e_z for an orthographic camera. Over a lens of radius a, in the plane of M e_x and
M e_y, a linear function v . eye varies by ``spread``, a times the length of v's part in that plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch_on_host
from warp_psdr.kernels.boundary.film_clip import View, Window, clip_edges
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC, DISTORTED_CAMERAS, THIN_LENSES
from warp_psdr.scene.distortion import bounds_of, filter_reach

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class CameraView:
    """Where a camera stands and how it projects.

    Attributes:
        camera: its record.
        pose: (4, 4).
        eye: (3,) position, or direction towards the camera.
        finite: 1; 0 for an orthographic camera.
        radius: of the lens, world units; 0 without one.
        focus: distance of the plane in focus, world units.
        scale: (2,) pixels that a unit of camera space's x and y (divided by depth unless orthographic) fills.
        center: (2,) pixels of the full film at which x and y are zero; with distortion, of the pinhole's image.
        bounds: (2, 2) with distortion: least and largest x and y, in those pixels, that the film sees; else None.
    """

    camera: Camera
    pose: np.ndarray
    eye: np.ndarray
    finite: float
    radius: float
    focus: float
    scale: np.ndarray
    center: np.ndarray
    bounds: np.ndarray | None = None

    def numbers(self) -> tuple:
        """Return all that the view depends on, to compare it by."""
        c = self.camera
        window = (c.kind, c.width, c.height, c.crop_x, c.crop_y, c.crop_width, c.crop_height, c.near, c.far)
        film = (c.filter, c.filter_radius, c.filter_stddev, c.sample_border)
        arrays = tuple(a.tobytes() for a in (self.pose, self.eye, self.scale, self.center))
        arrays += () if self.bounds is None else (self.bounds.tobytes(),)
        return (*window, *film, *arrays, self.finite, self.radius, self.focus)

    def towards(self, points: np.ndarray) -> np.ndarray:
        """Return vectors (..., 3) from points to the eye; unscaled, and the same everywhere, if it is at infinity."""
        return self.eye - self.finite * points

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return how far points (..., 3) lie in front of the camera, in units of its axis."""
        return (points - self.pose[:3, 3]) @ np.linalg.inv(self.pose[:3, :3])[2]

    def clip_depths(self) -> tuple[float, float]:
        """Return the depths of the clip planes."""
        size = float(np.linalg.norm(self.pose[:3, 2]))
        near, far = self.camera.near, self.camera.far
        # Along the axis of an orthographic camera; see ``kernels/sensor/camera.py``.
        return (near / size, far / size) if self.finite else (near, near + (far - near) / size)

    def spread(self, v: np.ndarray) -> np.ndarray:
        """Return the largest change of v . eye over the lens; v has shape (..., 3)."""
        if self.radius == 0.0:
            return np.zeros(v.shape[:-1])
        return self.radius * np.linalg.norm(np.ascontiguousarray(v) @ self.pose[:3, :2], axis=-1)

    def clip(self, ends: np.ndarray, numbers: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Clip edges to what the film, filter margin included, can see of them.

        Through a lens a point at depth z is seen within ``scale a |1/f - 1/z|`` of its image from the centre; times z
        that is convex along an edge, so what is interpolated from the ends is too wide rather than too narrow.

        Args:
            ends: (N, 2, 3).
            numbers: (E,) which of them; None: all.

        Returns:
            (E,) the stretches' ends, low and high in [0, 1], and the root mean square over the lens of the length of
            their images in pixels: 0 where nothing is seen.
        """
        camera = self.camera
        size = np.linalg.norm(self.pose[:3, 2])
        far = camera.far if self.finite else camera.near * size + camera.far - camera.near
        window = Window()
        window.finite = self.finite
        window.near = camera.near / (size if self.finite else 1.0)
        window.far = far / size
        window.center = wp.vec2d(*(self.center - [camera.crop_x, camera.crop_y]))
        window.scale = wp.vec2d(*self.scale)
        window.size = wp.vec2d(camera.crop_width, camera.crop_height)
        window.border = filter_reach(camera)
        if self.bounds is not None:
            # Edges are curves on the film, but lines in the pinhole's image: a box there holds all that is seen.
            window.center = wp.vec2d(*(self.center - self.bounds[0]))
            window.size = wp.vec2d(*(self.bounds[1] - self.bounds[0]))
            window.border = 0.0
        window.radius, window.focus = self.radius, self.focus
        window.position = wp.vec3d(*self.pose[:3, 3])
        window.to_camera = wp.mat33d(*np.linalg.inv(self.pose[:3, :3]).reshape(-1).tolist())
        numbers = np.arange(len(ends)) if numbers is None else numbers
        inputs = [window, ends, numbers.astype(np.int32)]
        low, high, length = launch_on_host(clip_edges, len(numbers), inputs, [wp.float64] * 3)
        return low, high, length

    def record(self) -> View:
        """Return what kernels take."""
        view = View()
        view.eye, view.finite, view.radius = wp.vec3d(*self.eye), self.finite, self.radius
        view.across, view.down = (wp.vec3d(*self.pose[:3, i]) for i in range(2))
        return view


def camera_view(scene: Scene, sensor: int) -> CameraView:
    """Return the view of a sensor at the scene's present values."""
    camera = scene.camera(sensor)
    values = scene.values.numpy()
    pose = values[camera.to_world : camera.to_world + 16].astype(np.float64).reshape(4, 4)
    parallel = camera.kind == CAMERA_ORTHOGRAPHIC
    lens = camera.kind in THIN_LENSES
    k = 1.0 if parallel else np.tan(np.radians(np.float64(values[camera.x_fov])) / 2.0)
    offset = np.zeros(2) if parallel else values[camera.principal : camera.principal + 2].astype(np.float64)
    scale = np.full(2, 0.5 * camera.width / k)
    center = np.array([camera.width, camera.height]) * (0.5 - offset)
    bounds = None
    if camera.kind in DISTORTED_CAMERAS:
        low, high = bounds_of(camera, scene.values)
        bounds = np.stack([center - scale * high, center - scale * low])
    return CameraView(
        camera=camera,
        pose=pose,
        eye=-pose[:3, 2] if parallel else pose[:3, 3],
        finite=0.0 if parallel else 1.0,
        radius=float(values[camera.aperture_radius]) if lens else 0.0,
        focus=float(values[camera.focus_distance]) if lens else 1.0,
        scale=scale,
        center=center,
        bounds=bounds,
    )
