"""``interior="auto"`` in the plan: the methods of the interior term that could gain, and what the scene knows of them.

The rule offers branches for shapes of lobes and weights of mixtures, pairs for normals of glossy surfaces, and replay
for everything else. An offer is taken once a pilot has found that it pays (``estimate/choice.py``). The pilot waits for
a repeated gradient; the first gradients are replayed, by the kernel that they would have without the rule. The result
is kept with the scene.

Derivation: ``docs/theory/interior.md#which-method``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from warp_psdr.kernels.interior.factors.mixtures import mixed_values
from warp_psdr.kernels.interior.factors.shape_parameters import branched_values, unsplit_values
from warp_psdr.kernels.interior.factors.tilts import tilting_values
from warp_psdr.options.interior import Branches, Method, Replay
from warp_psdr.rows.branches import drawn_by_choice, refused_by_antithetic, refused_by_branches, rest_of
from warp_psdr.rows.replay import is_asked
from warp_psdr.rows.table import row_of
from warp_psdr.scene.layout import CAMERA, MATERIAL, NORMALS, POSITIONS, SHAPE_POSE, TEXCOORDS, TO_UV

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: Time of a sample over that of replay, measured with the benchmarks of each: of branches by shapes of lobes and by
#: weights of mixtures, and of pairs by normals. It is no clock that chooses, so that equal calls choose alike.
SHAPES_COST = {"resampled": 4.1, "decomposed": 3.9}
WEIGHTS_COST = {"resampled": 8.0, "decomposed": 2.9}
NORMALS_COST = {"antithetic": 2.0, "resampled": 4.8}
#: What turns normals besides maps.
TURNING = {CAMERA, NORMALS, POSITIONS, SHAPE_POSE, TEXCOORDS, TO_UV}
#: Parameters that a line of the plan names.
NAMED = 3
WAITS = "from a repeated gradient on, if a pilot says that it pays"
#: What the plan calls what is drawn for.
LABELS = {
    "shapes": {"resampled": "resampled branches", "decomposed": "decomposed branches"},
    "normals": {"antithetic": "antithetic pairs", "resampled": "resampled pairs"},
}


@dataclass(eq=False)
class Choice:
    """What is known of a request whose method is left to the plan.

    Attributes:
        spent: samples of its gradients so far.
        plain: (seed, checksum of the scene's values) of the calls that were replayed.
        decided: whether there was a pilot.
        method: what it chose; None: replay.
        gains: kind of what is drawn for -> variance by replay over that by its method, of all that is requested.
        costs: likewise, the cost of a sample over that of replay.
    """

    spent: float = 0.0
    plain: set[tuple] = field(default_factory=set)
    decided: bool = False
    method: Branches | None = None
    gains: dict[str, float] = field(default_factory=dict)
    costs: dict[str, float] = field(default_factory=dict)


def known(scene: Scene, names: list[str], max_depth: int) -> Choice:
    """Return what is known of a request: parameters, at a depth."""
    every = scene.__dict__.setdefault("_interior", {})
    return every.setdefault((tuple(names), max_depth), Choice())


def is_on(scene: Scene) -> bool:
    """Whether methods may be chosen for a scene."""
    return scene.__dict__.get("_chooses", True)


def set_on(scene: Scene, on: bool) -> None:
    """Let methods be chosen for a scene, or not."""
    scene.__dict__["_chooses"] = on


def reset(scene: Scene) -> None:
    """Forget what is known of a scene's requests."""
    scene.__dict__.pop("_interior", None)


def stored(scene: Scene) -> list[dict[str, Any]]:
    """Return what is known of all requests, in values that JSON has."""
    return [
        {
            "names": list(names),
            "max_depth": depth,
            "spent": found.spent,
            "decided": found.decided,
            "method": None if found.method is None else asdict(found.method),
            "gains": found.gains,
            "costs": found.costs,
        }
        for (names, depth), found in scene.__dict__.get("_interior", {}).items()
    ]


def restore(scene: Scene, rows: list[dict[str, Any]]) -> None:
    """Take over what ``stored`` returned.

    Raises:
        KeyError: something is missing.
        TypeError: something is of another kind.
    """
    for row in rows:
        method = None if row["method"] is None else Branches(**row["method"])
        found = Choice(float(row["spent"]), set(), bool(row["decided"]), method, row["gains"], row["costs"])
        scene.__dict__.setdefault("_interior", {})[tuple(row["names"]), int(row["max_depth"])] = found


def offered(config: PathConfig, wanted: GradientRequest, moves_edges: bool) -> tuple[str, ...]:
    """Return what the rule would draw for: "shapes" of lobes, "normals"; there is none where nothing is branched.

    ``moves_edges``: whether there is a boundary term. What moves with it is left to replay: most of its noise is that
    of other terms.
    """
    if config.media is not None or config.surfaces.primitives:
        return ()
    found = [] if refused_by_branches("", config, drawn_by_choice(config, wanted)) else ["shapes"]
    if not (moves_edges or refused_by_antithetic(config, wanted)):
        found.append("normals")
    return tuple(found)


def candidates(plan: Plan) -> list[tuple[str, Branches]]:
    """Return the methods that a pilot compares with replay, each with the kind of what is offered that it draws for."""
    assert plan.wanted is not None
    found = []
    if "shapes" in plan.offered:
        found.append(("shapes", Branches(shapes="resampled")))
        if not unsplit_values(plan.config.surfaces, drawn_by_choice(plan.config, plan.wanted)):
            found.append(("shapes", Branches(shapes="decomposed")))
    if "normals" in plan.offered:
        found += [("normals", Branches(normals=method)) for method in NORMALS_COST]
    return found


def both(found: tuple[Branches, ...]) -> Branches:
    """Return the methods of several side by side."""
    shapes = next((m.shapes for m in found if m.shapes), "")
    normals = next((m.normals for m in found if m.normals), "")
    return Branches(shapes=shapes, normals=normals)


def cost_of(method: Branches, config: PathConfig, wanted: GradientRequest) -> float:
    """Return the time of a sample over that of replay."""
    shapes_cost = WEIGHTS_COST if mixed_values(config.surfaces, drawn_by_choice(config, wanted)) else SHAPES_COST
    cost = shapes_cost[method.shapes] if method.shapes else 0.0
    cost += NORMALS_COST[method.normals] if method.normals else 0.0
    return cost + float(is_asked(rest_of(method, config, wanted)))


def by(plan: Plan, method: Method | None) -> Plan:
    """Return a plan by another method of the interior; None: by replay."""
    method = Replay() if method is None else method
    row = row_of(method, plan.boundary)
    return replace(plan, interior=row, kept=row.keep(method, plan.max_depth, plan.rr_depth))


def named(integrator: PathIntegrator) -> Method:
    """Return the method that an integrator names: replay where that is left to the plan."""
    return Replay() if isinstance(integrator.interior, str) else integrator.interior


def describe(
    scene: Scene, config: PathConfig, wanted: GradientRequest, names: list[str], kinds: tuple[str, ...], found: Choice
) -> list[tuple[str, str, str]]:
    """Return the plan's lines: what each parameter is differentiated by, and why."""
    owns = {
        "shapes": {
            MATERIAL + s.name
            for s, b in zip(
                config.surfaces.material, branched_values(config.surfaces, drawn_by_choice(config, wanted)), strict=True
            )
            if b
        },
        "normals": {
            MATERIAL + s.name
            for s, t in zip(config.surfaces.material, tilting_values(config.surfaces, wanted), strict=True)
            if t
        }
        | TURNING,
    }
    reasons = {
        "shapes": "shape of a lobe, or weight of a mixture",
        "normals": "turns normals of glossy surfaces",
    }
    lines, left = [], list(names)
    for kind in kinds:
        own = [name for name in left if scene.parameters[name].uses & owns[kind]]
        left = [name for name in left if name not in own]
        label = _label(found.method, kind)
        said = _said(found, kind)
        lines.append(("drawn for", label or "nothing: replayed", f"{_listed(own)}: {reasons[kind]}; {said}"))
    if left:
        lines.append(("drawn for", "nothing: replayed", f"{_listed(left)}: replay is best"))
    return lines


def _label(method: Branches | None, kind: str) -> str:
    """Return what the plan calls a method of a kind; empty: replay."""
    if method is None:
        return ""
    return LABELS[kind].get(getattr(method, kind), "")


def _said(found: Choice, kind: str) -> str:
    if not found.decided:
        return WAITS
    if kind not in found.gains:
        return "pilot: nothing to tell"
    return f"pilot: the variance is {found.gains[kind]:.3g} times less at {found.costs[kind]:.3g} times the cost"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
