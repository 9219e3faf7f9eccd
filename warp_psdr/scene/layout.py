"""The flat array of all continuous values of a scene, and the list of its named parameters.

One float32 array holds every vertex, normal, texel, matrix and constant. A parameter is a named slice of it, seen
through a Warp array of its natural shape. Gradients and tangents are arrays of the same layout.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import warp as wp

#: How a parameter is used; decides what the plan compiles. A parameter can have several uses.
MATERIAL = "material:"  #: followed by the slot's name, c0 ... s1
TO_UV = "to_uv"
POSITIONS = "positions"
NORMALS = "normals"
TEXCOORDS = "texcoords"
SHAPE_POSE = "shape pose"
SHAPE_GRID = "shape grid"  #: of shapes without triangles: grids, and control points of curves
RADIANCE = "radiance"
LIGHT_RADIANCE = "light radiance"
LIGHT_POSE = "light pose"
CAMERA = "camera"
MEDIUM = "medium:"  #: followed by what of it, as in ``kernels/medium/coefficients.py``
#: Uses that change how bright lights are.
BRIGHTNESS = {RADIANCE, LIGHT_RADIANCE, LIGHT_POSE}


@dataclass(eq=False)
class Parameter:
    """A named stretch of the flat array."""

    name: str
    offset: int
    shape: tuple[int, ...]  #: of the Warp array
    dtype: type  #: wp.float32, wp.vec2 or wp.vec3
    bounds: tuple[float, float]
    uses: set[str] = field(default_factory=set)
    owner: int = -1  #: shape or emitter number, for updates
    #: Numbers of all shapes whose values these are, or which they move: copies, by instances, of one in a group.
    copies: tuple[int, ...] = ()
    prototype: int = -1  #: values of a shape in a group: its number in ``Builder.prototypes``
    placed: bool = False  #: a position or a pose: relative to the scene's origin on the device (``origin``)

    @property
    def owners(self) -> tuple[int, ...]:
        """Numbers of the shapes that these values belong to."""
        return self.copies or (self.owner,)

    @property
    def size(self) -> int:
        """Number of floats."""
        return int(np.prod(self.numpy_shape))

    @property
    def numpy_shape(self) -> tuple[int, ...]:
        """Shape of the values as NumPy sees them."""
        return self.shape if self.dtype is wp.float32 else (*self.shape, wp.types.type_size(self.dtype))

    def view(self, flat: wp.array) -> wp.array:
        """Return this parameter's stretch of a flat float32 array as an array of its own shape; no copy."""
        return self.shaped(flat[self.offset : self.offset + self.size])

    def shaped(self, stretch: wp.array) -> wp.array:
        """View this parameter's numbers, flat float32, as an array of its own shape; no copy."""
        return stretch.reshape(self.numpy_shape).view(self.dtype)


@dataclass(frozen=True)
class Held:
    """An array that a field of the description holds, too."""

    holder: object
    field: str
    offset: int  #: flat


class Layout:
    """Collects values while a scene is built."""

    def __init__(self):
        self.parameters: dict[str, Parameter] = {}
        self.held: list[Held] = []
        self._chunks: list[np.ndarray] = []
        self._size = 0

    def add_values(self, values: np.ndarray) -> int:
        """Append unnamed values and return their flat offset."""
        chunk = np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
        offset = self._size
        self._chunks.append(chunk)
        self._size += chunk.size
        return offset

    def add(
        self,
        name: str,
        values: np.ndarray,
        use: str,
        *,
        dtype: type = wp.float32,
        bounds: tuple[float, float] = (-np.inf, np.inf),
        owner: int = -1,
        placed: bool = False,
    ) -> int:
        """Append a named parameter and return its flat offset.

        Raises:
            ValueError: The name is taken.
        """
        if name in self.parameters:
            raise ValueError(f"two values are both named {name!r}; give their objects different ids")
        values = np.asarray(values, dtype=np.float32)
        offset = self.add_values(values)
        self.name(name, offset, values.shape, use, dtype=dtype, bounds=bounds, owner=owner)
        self.parameters[name].placed = placed
        return offset

    def name(
        self,
        name: str,
        offset: int,
        numpy_shape: tuple[int, ...],
        use: str,
        *,
        dtype: type = wp.float32,
        bounds: tuple[float, float] = (-np.inf, np.inf),
        owner: int = -1,
    ) -> None:
        """Name a stretch that was added before."""
        shape = tuple(numpy_shape) if dtype is wp.float32 else tuple(numpy_shape[:-1])
        self.parameters[name] = Parameter(name, offset, shape, dtype, bounds, {use}, owner)

    def hold(self, holder: object, field: str, offset: int) -> None:
        """Note which field of the description holds the values that were added at an offset."""
        self.held.append(Held(holder, field, offset))

    def release(self) -> list[np.ndarray]:
        """Return the parts of the flat array in their order, and forget them."""
        released, self._chunks, self.held = self._chunks, [], []
        return released


def struct_array(struct, records: list, device) -> wp.array:
    """Return a Warp array of struct instances; one zeroed record where the list is empty (Warp has no null struct)."""
    if not records:
        return wp.zeros(1, dtype=struct, device=device)
    return wp.array(records, dtype=struct, device=device)
