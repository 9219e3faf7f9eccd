"""Which samples and weights may be attached together [ZSGJ21]: the table of ``interior.Attached``, its errors and page.

Two techniques find light, sampling of scattering directions and sampling of lights, and multiple importance sampling
weights them. A sample is attached if it moves with a parameter through the routine that draws it from random numbers,
and detached if it stays. The numbers are those of a one-dimensional toy problem, which
``tests/interior/test_attached.py`` computes: two Gaussian densities, with light from about the centre of the second.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Samples; weights: "position" is through the sample alone, their own parameters held.
SAMPLES, WEIGHTS = ("detached", "attached"), ("detached", "position", "attached")
#: Conditions of rows: none; where the light or what hides it has edges; where light moves that ends somewhere.
ALWAYS, EDGES, MOVING_LIGHT = "", "edges", "moving light"


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A row.

    Attributes:
        bsdf: what sampling of directions may be for the row to apply.
        emitter: what sampling of lights may be.
        weights: what the weights may be.
        when: the condition; empty: none.
        right: whether the estimate has the right mean.
        offered: whether ``interior.Attached`` estimates it.
        parameter: of the toy that the numbers are the derivative by, "alpha" of the directions' density or "light", the
            place of the light.
        found: what the toy finds.
        exact: what it should find.
        variance: of the toy's estimate.
        reason: why it is right or wrong, or not offered, and what to do instead.
    """

    bsdf: tuple[str, ...]
    emitter: tuple[str, ...]
    weights: tuple[str, ...]
    when: str = ALWAYS
    right: bool
    offered: bool
    parameter: str
    found: float
    exact: float
    variance: float
    reason: str

    def covers(self, bsdf: str, emitter: str, weights: str) -> bool:
        """Whether the row is of these choices."""
        return bsdf in self.bsdf and emitter in self.emitter and weights in self.weights

    @property
    def numbers(self) -> str:
        """The toy's, as an error says it."""
        return f"{self.found:.2g} in place of {self.exact:.2g} in a toy of one dimension"


#: The first row without a condition that covers a choice is its own.
TABLE = (
    Combination(
        bsdf=("detached",),
        emitter=("detached",),
        weights=("detached", "position"),
        right=True,
        offered=True,
        parameter="alpha",
        found=-0.259,
        exact=-0.259,
        variance=0.54,
        reason="at every sample that stays the weights add up to 1, and their derivatives to 0; this is replay",
    ),
    Combination(
        bsdf=("detached",),
        emitter=("detached",),
        weights=("attached",),
        right=True,
        offered=True,
        parameter="alpha",
        found=-0.259,
        exact=-0.259,
        variance=0.63,
        reason="the derivatives of the weights add up to 0 on average: noise, and nothing else",
    ),
    Combination(
        bsdf=("attached",),
        emitter=("detached",),
        weights=("detached",),
        right=False,
        offered=False,
        parameter="alpha",
        found=-0.139,
        exact=-0.259,
        variance=0.35,
        reason=(
            "along a sample that moves, weights that are held no longer add up to 1; use weights='position' or "
            "weights='attached'"
        ),
    ),
    Combination(
        bsdf=("attached",),
        emitter=("detached",),
        weights=("position",),
        right=True,
        offered=True,
        parameter="alpha",
        found=-0.259,
        exact=-0.259,
        variance=0.41,
        reason="the weights are a fixed function of the direction, and add up to 1 in each",
    ),
    Combination(
        bsdf=("attached",),
        emitter=("detached",),
        weights=("attached",),
        right=True,
        offered=True,
        parameter="alpha",
        found=-0.259,
        exact=-0.259,
        variance=0.13,
        reason="the weights add up to 1 for every value of the parameter",
    ),
    Combination(
        bsdf=SAMPLES,
        emitter=("attached",),
        weights=("detached",),
        right=False,
        offered=False,
        parameter="light",
        found=-0.585,
        exact=-0.397,
        variance=0.28,
        reason=(
            "along a light sample that moves, weights that are held no longer add up to 1; interior.Replay() moves the "
            "points of lights with them, in both techniques alike"
        ),
    ),
    Combination(
        bsdf=SAMPLES,
        emitter=("attached",),
        weights=("position", "attached"),
        right=True,
        offered=False,
        parameter="light",
        found=-0.397,
        exact=-0.397,
        variance=0.12,
        reason=(
            "it would be right, but no light is sampled by the roughness of a surface, so nothing is left to attach: "
            "use emitter='detached'; where lights move, interior.Replay() moves their points with them"
        ),
    ),
    Combination(
        bsdf=("attached",),
        emitter=SAMPLES,
        weights=WEIGHTS,
        when=EDGES,
        right=False,
        offered=False,
        parameter="alpha",
        found=0.393,
        exact=0.619,
        variance=0.39,
        reason=(
            "a direction that moves crosses edges, of lights or of what hides them, even in a scene that stands still, "
            "and there is no boundary term for these; use bsdf='detached' or interior.Resampled()"
        ),
    ),
    Combination(
        bsdf=SAMPLES,
        emitter=("detached",),
        weights=WEIGHTS,
        when=MOVING_LIGHT,
        right=False,
        offered=False,
        parameter="light",
        found=0.0,
        exact=-0.607,
        variance=0.01,
        reason=(
            "light samples that stay while the light moves need the light's edges as a boundary term; request the "
            "light in a call of its own with interior.Replay(), whose light points move with it"
        ),
    ),
)

_BY_CHANCE = (
    "a direction is of one lobe or another by chance, with shares of densities that would all move; "
    "interior.Resampled() draws for it"
)
#: Models with glossy lobes whose directions stay -> why.
UNMOVED = {
    "roughdielectric": "directions that enter the body meet its far side, whose edges they cross",
    "roughplastic": _BY_CHANCE,
    "principled": _BY_CHANCE,
    "principledthin": _BY_CHANCE,
    "ashikhminshirley": _BY_CHANCE,
    "blendbsdf": _BY_CHANCE,
    "mask": _BY_CHANCE,
    "abc": "its sampling is not differentiated; interior.Resampled() draws for it",
    "orennayar": "its directions are drawn by the cosine, which sigma does not move: replay is attached already",
}


def combination(bsdf: str, emitter: str, weights: str) -> Combination:
    """Return the row of three choices."""
    return next(row for row in TABLE if row.when == ALWAYS and row.covers(bsdf, emitter, weights))


def refused_when(condition: str, bsdf: str, emitter: str, weights: str) -> Combination | None:
    """Return the row that forbids three choices under a condition; None: there is none."""
    return next((row for row in TABLE if row.when == condition and row.covers(bsdf, emitter, weights)), None)
