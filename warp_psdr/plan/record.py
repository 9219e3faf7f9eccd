"""The plan's record: decisions and their reasons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from warp_psdr import html

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.boundary import Method
    from warp_psdr.plan.light import LightTracing
    from warp_psdr.rows.replay import Kept
    from warp_psdr.rows.table import Row
    from warp_psdr.scene.description import TimeBins


@dataclass(frozen=True)
class Plan:
    """Decisions and their reasons; ``print(plan)`` shows them.

    Attributes:
        config: what the path loop compiles.
        wanted: which derivatives are compiled; None: primal only.
        max_depth: most vertices of a path, -1: no limit.
        rr_depth: depth at which Russian roulette starts.
        interior: method of the interior term (``rows/table.py``); None: primal only.
        kept: what of a path it keeps.
        discontinuities: why the requested parameters move discontinuities; empty: they do not.
        lines: (item, decision, reason).
        boundary: method of the boundary term; None: there is none, or it was left out on purpose.
        shapes: numbers of the shapes that all that is requested belongs to; None: to lights too, or to the camera.
        light: the passes of methods whose paths start at the lights; None: all paths start at the camera.
        offered: what may be drawn for where the method of the interior is left to the plan (``choice.py``).
        times: time bins of the film; None: it has none.
    """

    config: PathConfig
    wanted: GradientRequest | None
    max_depth: int
    rr_depth: int
    interior: Row | None
    kept: Kept | None
    discontinuities: tuple[str, ...]
    lines: tuple[tuple[str, str, str], ...]
    boundary: Method | None = None
    shapes: frozenset[int] | None = None
    light: LightTracing | None = None
    offered: tuple[str, ...] = ()
    times: TimeBins | None = None

    @property
    def seen(self) -> PathConfig:
        """What paths from the camera compile."""
        return self.config if self.light is None else self.light.camera

    @property
    def seen_wanted(self) -> GradientRequest | None:
        """Which derivatives paths from the camera compute; None: none."""
        return self.wanted if self.light is None else self.light.wanted

    def __str__(self) -> str:
        """Return a table."""
        w0 = max(len(line[0]) for line in self.lines)
        w1 = max(len(line[1]) for line in self.lines)
        return "\n".join(f"{a:<{w0}}  {b:<{w1}}  {r}" for a, b, r in self.lines)

    def _repr_html_(self) -> str:
        """Return the table that a notebook shows."""
        return html.table(("", "decision", "reason"), self.lines)


class Plans(Mapping[str, Plan]):
    """The plans of several sensors, by the sensor's name; ``print`` shows those that differ, with their sensors."""

    def __init__(self, plans: Mapping[str, Plan]):
        self._plans = dict(plans)

    def __getitem__(self, sensor: str) -> Plan:
        return self._plans[sensor]

    def __iter__(self) -> Iterator[str]:
        return iter(self._plans)

    def __len__(self) -> int:
        return len(self._plans)

    def _grouped(self) -> list[tuple[str, Plan]]:
        """Return the plans that differ, each with the names of the sensors that have it."""
        groups: dict[tuple, list[str]] = {}
        for name, plan in self.items():
            groups.setdefault(plan.lines, []).append(name)
        return [(", ".join(names), self[names[0]]) for names in groups.values()]

    def __str__(self) -> str:
        """Return a table for each group of sensors."""
        return "\n\n".join(f"{names}:\n{plan}" for names, plan in self._grouped())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return "".join(f"<p>{escape(names)}</p>{plan._repr_html_()}" for names, plan in self._grouped())
