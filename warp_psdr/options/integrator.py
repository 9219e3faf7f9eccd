"""Integrators: the light transport that is computed, and the methods that differentiate it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from warp_psdr.kernels.property import PROPERTIES
from warp_psdr.options import boundary as boundary_methods
from warp_psdr.options import interior as interior_methods

#: Numbers of vertices are 32-bit integers with a sign.
MOST_DEPTH = (1 << 31) - 1


@dataclass(frozen=True, kw_only=True)
class PathIntegrator:
    """Unidirectional path tracing with next-event estimation, MIS and Russian roulette.

    Attributes:
        max_depth: most vertices of a path behind the camera; 1: emission seen directly, 2: direct light, -1: no limit.
        rr_depth: depth from which Russian roulette ends paths, those behind a discontinuity four vertices earlier; very
            large: never.
        hide_emitters: lights are invisible to the camera.
        sampler: "sobol" (Owen-scrambled), "independent", or "auto": what the scene file says, else Sobol.
        interior: method of the interior term; "auto": ``Replay()``, and from a repeated gradient of a scene on
            ``Resampled()`` or ``Decomposed()`` for shapes of lobes and ``Antithetic()`` or ``Resampled()`` for normals
            beside it, where a pilot says that it pays.
        caustics: whether light paths join those of the camera, for light of lights of no area that mirrors or glass
            turn, which no path from the camera finds: in images, and in derivatives by what ``LightTracing()``
            differentiates, what moves vertices with ``boundary=None`` alone. "auto": with ``interior="auto"``, where
            all that such a light sends meets mirrors or glass first. False: that light is left out, and what lights of
            no area send through masks, thin glass and ``null``, as by Mitsuba's ``path``.
        boundary: method of the boundary term; "auto": ``PathSpace()``, whose shadow edges are guided once gradients of
            a scene have cost what a pilot's kernels do, if it says that it pays; None: left out on purpose (the
            gradient then misses moving discontinuities). ``psdr.guiding.set_automatic`` and ``reset`` serve both.
        shown: set by ``AovIntegrator``.
    """

    max_depth: int = -1
    rr_depth: int = 5
    hide_emitters: bool = False
    sampler: Literal["auto", "sobol", "independent"] = "auto"
    interior: interior_methods.Method | Literal["auto"] = "auto"
    boundary: boundary_methods.Method | Literal["auto"] | None = "auto"
    caustics: bool | Literal["auto"] = "auto"
    shown: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: a value out of range.
        """
        for name in ("max_depth", "rr_depth"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
                raise ValueError(f"{name}: expected an integer, got {value!r}")
            if value > MOST_DEPTH:
                raise ValueError(f"{name}: got {value}, expected at most {MOST_DEPTH}")
            object.__setattr__(self, name, int(value))
        if self.max_depth == 0 or self.max_depth < -1:
            raise ValueError(f"max_depth: got {self.max_depth}, expected -1 (no limit) or at least 1")
        if self.rr_depth < 1:
            raise ValueError(f"rr_depth: got {self.rr_depth}, expected at least 1")
        if not isinstance(self.hide_emitters, (bool, np.bool_)):
            raise ValueError(f"hide_emitters: got {self.hide_emitters!r}, expected True or False")
        if not isinstance(self.caustics, (bool, np.bool_)) and self.caustics != "auto":
            raise ValueError(f"caustics: got {self.caustics!r}, expected True, False or 'auto'")
        if self.caustics != "auto":
            object.__setattr__(self, "caustics", bool(self.caustics))
        if self.sampler not in ("auto", "sobol", "independent"):
            raise ValueError(f"sampler: got {self.sampler!r}, expected 'auto', 'sobol' or 'independent'")
        if not isinstance(self.interior, interior_methods.Method) and self.interior != "auto":
            raise ValueError(
                f"interior: got {self.interior!r}, expected a method of psdr.interior, for example "
                "psdr.interior.Replay(), or 'auto'"
            )
        if not isinstance(self.boundary, boundary_methods.Method) and self.boundary not in ("auto", None):
            raise ValueError(
                f"boundary: got {self.boundary!r}, expected a method of psdr.boundary, for example "
                "psdr.boundary.PathSpace(), 'auto' or None"
            )


@dataclass(frozen=True, kw_only=True)
class AovIntegrator:
    """What the camera sees first, as an image with derivatives: for losses on masks, depths, places and normals.

    The three channels are those of the property; a mask and a depth have three equal ones.

    Attributes:
        aov: "mask": share of the pixel that sees a surface; "depth": distance from the near clip plane along the ray,
            world units; "position": world units; "sh_normal": shading normal, unit, turned by ``flip_normals``. All are
            averaged under the pixel filter, and 0 where the camera sees nothing, as of ``psdr.render_aov``.
        boundary: method of the boundary term: "auto", ``PathSpace()``, ``EdgeSampling()``, or None.
        sampler: as of ``PathIntegrator``.
    """

    aov: Literal["mask", "depth", "position", "sh_normal"]
    boundary: boundary_methods.Method | Literal["auto"] | None = "auto"
    sampler: Literal["auto", "sobol", "independent"] = "auto"

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: a value out of range.
        """
        if self.aov not in PROPERTIES:
            raise ValueError(f"aov: got {self.aov!r}, expected one of {', '.join(map(repr, PROPERTIES))}")
        takes = (boundary_methods.PathSpace, boundary_methods.EdgeSampling)
        if not isinstance(self.boundary, takes) and self.boundary not in ("auto", None):
            raise ValueError(
                f"boundary: got {self.boundary!r}, expected psdr.boundary.PathSpace(), EdgeSampling(), 'auto' or None"
            )

    def as_path(self) -> PathIntegrator:
        """Return the paths of one vertex that show it."""
        # Nothing is guided: the camera sees all edges.
        boundary = boundary_methods.PathSpace() if self.boundary == "auto" else self.boundary
        return PathIntegrator(
            max_depth=1, sampler=self.sampler, interior=interior_methods.Replay(), boundary=boundary, caustics=False,
            shown=self.aov,
        )  # fmt: skip


#: What functions take for an integrator: an object, Mitsuba's dictionary or plugin name, or None: the scene file's.
Integrator = PathIntegrator | AovIntegrator | dict | str
