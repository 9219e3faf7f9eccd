"""The kinds of shapes without triangles, a row each."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from warp_psdr.kernels.primitive import kind as device
from warp_psdr.scene.kinds.affine import Exact
from warp_psdr.scene.kinds.bsplinecurve import BSplineCurve
from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.scene.kinds.cylinder import Cylinder
from warp_psdr.scene.kinds.disk import Disk
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.linearcurve import LinearCurve
from warp_psdr.scene.kinds.neuralsdf import Network
from warp_psdr.scene.kinds.sdfgrid import CubicSdfGrid, SdfGrid
from warp_psdr.scene.kinds.sphere import Sphere
from warp_psdr.scene.shapes.primitives import Tessellation, cube, rectangle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_psdr.scene.description import ShapeDescription
    from warp_psdr.scene.plugins import Properties

KINDS: tuple[type[Geometry], ...] = (
    Sphere,
    Disk,
    Cylinder,
    SdfGrid,
    CubicSdfGrid,
    LinearCurve,
    BSplineCurve,
    Network,
)
#: Kinds of which the plan speaks together, in its order.
TOLD_TOGETHER: tuple[type[Geometry], ...] = (Exact, SdfGrid, Network, Curves)

#: Plugin -> the kind that reads it; of several the first, whose others are its own.
PLUGINS = {kind.plugin: kind for kind in reversed(KINDS)}
#: Plugin -> the exact kind that it stands for where it says so; else it is made of triangles.
EXACT = {kind.plugin: kind for kind in KINDS if issubclass(kind, Exact)}
#: Plugin -> the triangles that it is made of, by the number of segments of a full turn.
TESSELLATED: dict[str, Callable[[int], Tessellation]] = {
    "rectangle": rectangle,
    "cube": cube,
    **{plugin: kind.tessellate for plugin, kind in EXACT.items()},
}
#: Numbers of the kinds whose points ride on their surface.
MATERIAL = tuple(kind.device.number for kind in KINDS if kind.device.moves == device.MATERIAL)


def kind_of(props: Properties) -> type[Geometry] | None:
    """Return the kind that a plugin asks for; None: it is made of triangles.

    Raises:
        ValueError: it also asks for what only triangles have.
    """
    kind = PLUGINS.get(props.type)
    return kind if kind is not None and kind.is_asked_for(props) else None


def describe(shapes: Sequence[ShapeDescription]) -> list[tuple[str, str, str]]:
    """Return the plan's lines about shapes without triangles."""
    held = [(s.path, s.geometry) for s in shapes if s.geometry is not None]
    found = [(family, [(path, g) for path, g in held if isinstance(g, family)]) for family in TOLD_TOGETHER]
    return [line for family, own in found if own for line in family.describe(own)]
