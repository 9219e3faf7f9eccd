"""Methods of the boundary term: options, one object each. ``terms.py`` says which launches each of them consists of."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Method(ABC):  # noqa: B024
    """A way to estimate the boundary term.

    Attributes:
        spp_primary: samples of the edges that the camera sees, a pixel; None: as many as the interior term's.
        spp_secondary: samples of shadow edges and their like, a pixel; None: as many as the interior term's.
    """

    spp_primary: int | None = None
    spp_secondary: int | None = None

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: a sample count is not a positive integer.
        """
        for name in ("spp_primary", "spp_secondary"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ValueError(f"{name}: got {value!r}, expected a positive integer (samples a pixel), or None")

    @property
    def label(self) -> str:
        """What the plan calls it."""
        return f"boundary.{type(self).__name__}"


@dataclass(frozen=True, kw_only=True)
class PathSpace(Method):
    """Multi-directional sampling of boundary paths [ZMY*20] (``kernels/boundary/``), unguided.

    Unbiased for triangle meshes with moving shapes, which may run through each other and interpolate normals, area,
    environment, point, spot and directional lights, and a moving camera, at any depth. Not covered, and
    refused: smooth mirrors and glass, hidden emitters, and textures with steps. Surfaces that merely touch are in
    contact: what changes when they move apart, or into each other, has no derivative and is left out.
    """
