"""What float32 costs: scenes whose images and derivatives are known in float64, evaluated here with NumPy.

*White furnace.* In a closed box whose walls shine with 1 and reflect rho, a path of at most D vertices behind the
camera meets sum_{k<D} rho^k, whatever its directions; d/d rho is sum_{k<D} k rho^(k-1). With rho = 0.999 and D = 128
the last bounce counts nearly as much as the first, so rounding adds up over all of them.

*A square light over a plane*, parallel, at height h, seen by nobody: a point p of the plane has the radiance

    rho / pi L_e integral h^2 / d^4 dA,    and its derivative with respect to h    integral 2 h / d^4 - 4 h^3 / d^6 dA,

with r the horizontal distance and d^2 = r^2 + h^2. Both integrals and the average over the pixel are smooth, so
products of Gauss-Legendre rules reach float64. The light's corners are those of the file, that is float32; the scene
far away has corners that float32 holds exactly. So only what a renderer computes is measured, not how its input was
rounded. (Mitsuba's wheels have no variant in double precision that could serve as reference.)
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes import write_ply

ALBEDO, FURNACE_DEPTH = 0.999, 128
#: A side of the plane, which is what "sizes away" counts.
SIZE = 2.0
#: Of the light above the plane; its centre, off the axis of the camera.
LIGHT_HEIGHT, LIGHT_CENTER = 1.0, (0.25, -0.125)
#: Power of the light over its radius squared: an irradiance near one for every radius.
POWER = 1.0
#: Of the camera, which looks at the origin from the side; it does not see the light.
ORIGIN, FIELD_OF_VIEW = (0.0, -2.0, 0.5), 8.0
REFLECTANCE = 0.5
HEIGHT = (0.0, 0.0, 1.0)
#: Nodes a dimension, over the light and over a pixel: more of them change nothing above 1e-11.
LIGHT_NODES, PIXEL_NODES = 16, 6

FURNACE = f"""<scene version="3.0.0"><default name="resolution" value="4"/>
    <integrator type="path"><integer name="max_depth" value="{FURNACE_DEPTH}"/></integrator>
    <sensor type="perspective"><float name="fov" value="90"/>
        <transform name="to_world"><lookat origin="0, 0, 0" target="0.3, 0.5, 1" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
    <shape type="cube" id="walls"><boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="{ALBEDO}"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="1"/></emitter></shape>
</scene>
"""
PLANE = """<scene version="3.0.0"><default name="resolution" value="8"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective"><float name="fov" value="{fov}"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
    <shape type="ply" id="plane"><string name="filename" value="plane_{stem}.ply"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="{reflectance}"/></bsdf></shape>
    <shape type="ply" id="light"><string name="filename" value="light_{stem}.ply"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="{radiance!r}"/></emitter></shape>
</scene>
"""


def write_furnace(folder: Path) -> Path:
    """Write the scene."""
    file = folder / "furnace.xml"
    file.write_text(FURNACE)
    return file


def furnace(pixels: int) -> np.ndarray:
    """Return its image, (pixels, pixels, 3)."""
    return np.full((pixels, pixels, 3), sum(_rho() ** k for k in range(FURNACE_DEPTH)))


def furnace_derivative(pixels: int) -> np.ndarray:
    """Return its derivative with respect to the albedo."""
    return np.full((pixels, pixels, 3), sum(k * _rho() ** (k - 1) for k in range(1, FURNACE_DEPTH)))


def _rho() -> float:
    return float(np.float32(ALBEDO))  # the number that the renderers get


def _text(values) -> str:
    return ", ".join(repr(float(v)) for v in values)


@dataclass(frozen=True)
class Plane:
    """A square light over a plane.

    Attributes:
        radius: half of the light's side.
        away: how many sizes of the scene it lies from the origin, along x and y.
    """

    radius: float = 0.25
    away: float = 0.0

    @property
    def _offset(self) -> np.ndarray:
        return np.array([SIZE * self.away, SIZE * self.away, 0.0])

    @property
    def _radiance(self) -> float:
        return float(np.float32(POWER / self.radius**2))

    def light(self) -> np.ndarray:
        """Return the light's corners as float32 holds them, (4, 3), counter-clockwise as seen from below."""
        x, y = LIGHT_CENTER
        r = self.radius
        corners = np.array([[x - r, y - r], [x - r, y + r], [x + r, y + r], [x + r, y - r]])
        return (np.column_stack([corners, np.full(4, LIGHT_HEIGHT)]) + self._offset).astype(np.float32)

    def write(self, folder: Path) -> Path:
        """Write the scene and its meshes."""
        stem = f"{self.radius:g}_{self.away:g}"
        half = SIZE / 2.0
        ground = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
        quad = np.array([[0, 1, 2], [0, 2, 3]])
        write_ply(folder / f"plane_{stem}.ply", ground + self._offset, quad)
        write_ply(folder / f"light_{stem}.ply", self.light(), quad)
        file = folder / f"plane_{stem}.xml"
        values = {"fov": FIELD_OF_VIEW, "reflectance": REFLECTANCE, "radiance": self._radiance, "stem": stem}
        origin, target = _text(ORIGIN + self._offset), _text(self._offset)
        file.write_text(PLANE.format(origin=origin, target=target, **values))
        return file

    def image(self, pixels: int) -> np.ndarray:
        """Return the image, (pixels, pixels, 3)."""
        return self._integrate(pixels, lambda h, d2: h**2 / d2**2)

    def derivative(self, pixels: int) -> np.ndarray:
        """Return its derivative with respect to the light's height."""
        return self._integrate(pixels, lambda h, d2: 2.0 * h / d2**2 - 4.0 * h**3 / d2**3)

    def _integrate(self, pixels: int, kernel) -> np.ndarray:
        corners = self.light().astype(np.float64) - self._offset
        u, weights = np.polynomial.legendre.leggauss(LIGHT_NODES)
        low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        x, y = (0.5 * (low[k] + high[k]) + 0.5 * (high[k] - low[k]) * u for k in range(2))
        area = np.prod(high - low) / 4.0 * np.outer(weights, weights)
        points, pixel_weights = _seen(pixels)
        h = float(corners[0, 2])
        squared = (points[..., 0, None, None] - x[:, None]) ** 2 + (points[..., 1, None, None] - y) ** 2 + h * h
        values = (kernel(h, squared) * area).sum(axis=(-2, -1))
        average = (values * pixel_weights).sum(axis=(-2, -1)) * self._radiance * np.float32(REFLECTANCE) / np.pi
        return np.repeat(average[..., None], 3, axis=-1)


def _seen(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the plane that the pixels see, (rows, columns, n, n, 2), and their weights, (n, n)."""
    forward = -np.array(ORIGIN) / np.linalg.norm(ORIGIN)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    u, weights = np.polynomial.legendre.leggauss(PIXEL_NODES)
    film = 2.0 * (np.arange(pixels)[:, None] + 0.5 + 0.5 * u) / pixels - 1.0  # (pixels, n), of [-1, 1]
    scale = np.tan(np.radians(0.5 * FIELD_OF_VIEW))
    down, along = film[:, None, :, None, None], film[None, :, None, :, None]
    directions = forward + scale * (along * right - down * up)
    distance = -ORIGIN[2] / directions[..., 2]
    return (np.array(ORIGIN) + distance[..., None] * directions)[..., :2], np.outer(weights, weights) / 4.0
