"""What a family of shapes without triangles tells the terms of its silhouettes on the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warp_psdr.options.boundary import Method, PathSpace

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


class Shares(NamedTuple):
    """Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``)."""

    values: float  #: where single values move the surface
    pose: float  #: where a pose or the camera does


#: As many as the interior.
EQUAL = Shares(1.0, 1.0)


class Streams(NamedTuple):
    """Sub-streams of the boundary term's random numbers; None: there is no such term."""

    primary: int
    secondary: int
    foreground: int | None = None


@dataclass(frozen=True, kw_only=True)
class Family:
    """A family of shapes; ``items`` are records of the struct that its touch declares (``silhouette/touch.py``).

    Attributes:
        touch: its row of ``silhouette/table.py`` of the kernels.
        term: how the names of its terms end.
        title: how their titles do.
        streams: of its terms.
        primary: shares of the samples.
        secondary: the same between two path vertices.
        foreground: the same of what it sends past its silhouettes.
        is_in: kinds of a scene -> whether some are of the family.
        shapes: scene -> the numbers of its shapes.
        seen: (scene, shapes, sensor, creases) -> the items that a camera may see a silhouette of; None: there are none.
            ``creases``: of ``both`` parts those that are creases, or that are not; None: all.
        touched: (scene, own share, creases) -> all items, with the share of the segments that are not aimed at lights,
            at most ``own share``; None: there are none.
        fronts: (scene, creases) -> the items of the foreground; None: there are none.
        require_uncut: (scene, sensor, shapes): raises if a clip plane of the camera cuts a shape.
        masses: (scene, items) -> technique -> names of items that come and go, which stay the same from step to step,
            and how long their intervals are at first; empty: items do not come and go.
        both: some items are creases.
        flows: its points may flow along normals, and then send no foreground.
        in_media: what moves beside them is followed in media.
        methods: the boundary methods that know it.
    """

    touch: str
    term: str
    title: str
    streams: Streams
    primary: Shares
    secondary: Shares
    foreground: Shares = EQUAL
    is_in: Callable[[tuple[int, ...]], bool]
    shapes: Callable[[Scene], list[int]]
    seen: Callable[[Scene, list[int], int, bool | None], Any]
    touched: Callable[[Scene, float, bool | None], Any]
    fronts: Callable[[Scene, bool | None], Any] = lambda _scene, _creases: None
    require_uncut: Callable[[Scene, int, list[int]], None]
    masses: Callable[[Scene, Any], dict[str, tuple[np.ndarray, np.ndarray]]] = lambda _scene, _items: {}
    both: bool = False
    flows: bool = False
    in_media: bool = False
    methods: tuple[type[Method], ...] = (PathSpace,)
