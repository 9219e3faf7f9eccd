"""Methods of the interior term ([ZCZ25] eq. 12 first term, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from warp_psdr.options import combinations


class Method:
    """Base of all methods: a way to estimate the interior term."""


def _check_block(block: int, instead_of_zero: str) -> None:
    """Raise unless K is an integer from 1 to 64."""
    if isinstance(block, bool) or not isinstance(block, int) or not 1 <= block <= 64:
        remedy = instead_of_zero if block == 0 else ""
        raise ValueError(f"block: got {block!r}, expected an integer from 1 to 64{remedy}")


#: How vertices of shapes without material points move.
FLOWS = ("ray", "normal")


@dataclass(frozen=True, kw_only=True)
class Replay(Method):
    """Path replay [VSJ21] by record and sweep (``kernels/interior/replay.py``).

    Attributes:
        block: K, how many path vertices are kept at a time. Longer paths are replayed in blocks of K (without a depth
            limit those of some 500 vertices more than Russian roulette begins at are cut, one in 10^11).
        flow: how vertices of smooth grids (``interpolation: cubic``) and networks move, which have no material points.
            "ray": along the rays that found them; "normal": along the normals, as [ZCM*24] have it, with the change of
            the area element, and without what such shapes send past their silhouettes in the boundary term. Both are
            unbiased. Shapes whose normals are not continuous (linear grids) and curves are refused with "normal"
            (``docs/theory/implicit.md#normal-flow``). All other shapes have material points.
    """

    block: int = 8
    flow: str = "ray"

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``block`` is not between 1 and 64, or ``flow`` is unknown.
        """
        _check_block(self.block, "; textbook replay, which keeps no vertices, is interior.Textbook()")
        if self.flow not in FLOWS:
            raise ValueError(f"flow: got {self.flow!r}, expected {' or '.join(map(repr, FLOWS))}")


@dataclass(frozen=True, kw_only=True)
class LightTracing(Method):
    """Light tracing: paths start at the lights, and the camera is joined to every vertex (``kernels/light_path.py``).

    It draws the image as well as its derivatives. Lights of no area shine through glass and mirrors, which paths from
    the camera never find. What the camera sees in mirrors and glass themselves, and the lights that it sees, is drawn
    from the camera. Samples a pixel are light paths over pixels, and as many paths from the camera. Derivatives, by
    record and sweep [NDSRJ20], are by all but the camera and the shapes of lights; by what moves vertices of its paths
    they are the interior term alone, with ``boundary=None`` (``kernels/interior/light_tracing.py``,
    ``light_motion.py``).

    Attributes:
        block: K, as of ``Replay``.
    """

    block: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``block`` is not between 1 and 64.
        """
        _check_block(self.block, "")


#: Most vertices of a path all of whose vertices are joined: rays grow with their square.
MOST_CONNECTED = 16
#: Which ways of drawing a path ``Bidirectional`` weighs against each other.
CONNECTIONS = ("light", "all")


@dataclass(frozen=True, kw_only=True)
class Bidirectional(Method):
    """Paths from the camera and from the lights, weighted against each other (``kernels/bidirectional_path.py``).

    A path from the camera finds light by hitting it and by next-event estimation, a light path by being joined to the
    camera; each counts with the balance heuristic over all ways to draw it [Vea97]. It draws the image as well as its
    derivatives, which are by what moves no vertex of its paths. Samples a pixel are paths from the camera, and as
    many light paths.

    Attributes:
        connections: "light": the three ways above; "all": the vertices of the one are joined to those of the other
            too, of paths of at most 16 vertices.
        block: K, as of ``Replay``; with "all" the whole path is kept.
    """

    connections: str = "light"
    block: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``connections`` is unknown, or ``block`` is not between 1 and 64.
        """
        if self.connections not in CONNECTIONS:
            raise ValueError(f"connections: got {self.connections!r}, expected {' or '.join(map(repr, CONNECTIONS))}")
        _check_block(self.block, "")


#: Methods whose paths start at the lights too.
FROM_LIGHTS = (LightTracing, Bidirectional)

#: Fewest and most candidates of ``Resampled``.
LEAST_CANDIDATES, MOST_CANDIDATES = 4, 256


@dataclass(frozen=True, kw_only=True)
class Resampled(Method):
    """Resampled branches (``kernels/interior/resampled.py``), after [BXB*24]; the rest: replay.

    Branched are the numbers of materials with smooth lobes (roughnesses, exponents, indices of refraction, weights of
    mixtures, opacities), by one of them a sample; by weights half of the candidates are of each end. What turns the
    normals of glossy surfaces (normal and bump maps, vertex normals, and positions, poses and cameras as far as they
    turn normals) has a pair of directions of its own, drawn by both tilts (``kernels/interior/opposite.py``); beside
    smooth mirrors and glass, vertices that move are replayed. In scenes with participating media it is `g` of `hg`
    alone. All else that is requested is left to ``Replay()``.

    Attributes:
        candidates: how many directions, and light points, are looked at where a path branches, a square.
    """

    candidates: int = 16

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``candidates`` is no square from 4 to 256.
        """
        n = self.candidates
        square = isinstance(n, int) and not isinstance(n, bool) and n >= 0 and math.isqrt(n) ** 2 == n
        if not square or not LEAST_CANDIDATES <= n <= MOST_CANDIDATES:
            raise ValueError(
                f"candidates: got {n!r}, expected a square from {LEAST_CANDIDATES} to {MOST_CANDIDATES}, for example 16"
            )


@dataclass(frozen=True, kw_only=True)
class Attached(Method):
    """Samples that move with a roughness, or stay [ZSGJ21] (``kernels/interior/attached.py``); the rest: replay.

    A sample is attached if it moves with the parameter through the routine that draws it, and detached if it stays.
    Which choices go together, and why, is one table: ``docs/methods/attached.md``. With all detached it is replay.
    Attached directions are those of rough metal by its roughness, where reflected rays meet nothing but the sky.

    Attributes:
        bsdf: "attached" or "detached": the directions that leave surfaces.
        emitter: the same of points on lights; "detached" alone is offered.
        weights: of multiple importance sampling: "detached", "attached", or "position": through the direction alone.
    """

    bsdf: str = "detached"
    emitter: str = "detached"
    weights: str = "detached"

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: a choice is unknown, or the three together are biased or not offered.
        """
        for name, allowed in (
            ("bsdf", combinations.SAMPLES),
            ("emitter", combinations.SAMPLES),
            ("weights", combinations.WEIGHTS),
        ):
            given = getattr(self, name)
            if given not in allowed:
                warped = "; boundary.WarpedArea() warps rays for what moves, not for a roughness"
                raise ValueError(
                    f"{name}: got {given!r}, expected one of {', '.join(map(repr, allowed))}"
                    f"{warped if given == 'reparametrised' else ''}"
                )
        row = self.combination
        if not row.offered:
            verdict = "is not offered" if row.right else f"is biased ({row.numbers})"
            raise ValueError(f"{self.label} {verdict}: {row.reason}")

    @property
    def combination(self) -> combinations.Combination:
        """Its row of the table."""
        return combinations.combination(self.bsdf, self.emitter, self.weights)

    @property
    def label(self) -> str:
        """The expression that asks for it."""
        return f"interior.Attached(bsdf={self.bsdf!r}, emitter={self.emitter!r}, weights={self.weights!r})"


@dataclass(frozen=True, kw_only=True)
class Decomposed(Method):
    """Derivatives of one sign each [BXB*24] (``kernels/interior/decomposed.py``, ``kernels/interior/mixtures.py``).

    Branched are the roughnesses of `roughconductor`, of either distribution, and the exponents of `ashikhminshirley`,
    isotropic or not, `A`, `B` and `C` of `abc`, `sigma` of `orennayar` and `eta` of `roughplastic`, which weighs its
    coat against its base, by the lobes of their derivative; and weights of mixtures by what they mix: `weight` of
    `blendbsdf`, and `metallic`, `spec_trans`, `clearcoat`, `sheen`, `sheen_tint`, `flatness`, `spec_tint` and
    `diff_trans` of `principled` and `principledthin`, nested or not, and `opacity` of `mask`. In scenes with
    participating media it is `g` of `hg`. All else that is requested is left to ``Replay()``; it refuses other shapes
    of lobes, which ``Resampled()`` differentiates by.
    """


@dataclass(frozen=True, kw_only=True)
class Antithetic(Method):
    """Antithetic pairs at glossy surfaces [ZDDZ21] (``kernels/interior/antithetic.py``); the rest: replay.

    Paired are derivatives by what turns the normals of glossy surfaces: normal and bump maps, vertex normals, and
    positions and poses as far as they turn normals. All else that is requested, and what else those move, is left to
    ``Replay()``. It refuses requests in which no normal turns, and moving vertices beside smooth mirrors or glass.
    """


@dataclass(frozen=True, kw_only=True)
class Branches(Method):
    """What ``PathIntegrator(interior="auto")`` chooses: several methods side by side, and ``Replay()`` of the rest.

    Attributes:
        shapes: "resampled" or "decomposed": shapes of lobes are ``Resampled()``'s or ``Decomposed()``'s; "": replayed.
        normals: "antithetic" or "resampled": normals are ``Antithetic()``'s or ``Resampled()``'s; "": replayed.
    """

    shapes: str = ""
    normals: str = ""


@dataclass(frozen=True, kw_only=True)
class DifferentialRatioTracking(Method):
    """Differential ratio tracking [NDMKJ22] in grids of density (``kernels/interior/differential_ratio_tracking.py``).

    Of in-scattering, points by transmittance alone share the derivative by the density with collisions; one stretch of
    each path has such a point, and a path of its own from there. All else is ``Replay()``.

    Attributes:
        block: K, as of ``Replay``.
    """

    block: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``block`` is not between 1 and 64.
        """
        _check_block(self.block, "")


@dataclass(frozen=True, kw_only=True)
class RadiativeTransfer(Method):
    """Differential radiative transfer [ZWZ*19] (``kernels/transfer/radiative_transfer.py``), for comparison.

    For small scenes with homogeneous media. Directions and distances are fixed in the world, unlike in ``Replay()``.
    Ends of flights that move, and edges that vertices of a path see, on surfaces and in the medium, have terms that are
    estimated with it: there is no method of the boundary term beside it. All that moves nothing is as in ``Replay()``.

    Attributes:
        edges: sample the edges that path vertices see; False leaves them out.
        block: K, as of ``Replay``.
    """

    edges: bool = True
    block: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``edges`` is no bool, or ``block`` is not between 1 and 64.
        """
        if not isinstance(self.edges, bool):
            raise ValueError(f"edges: got {self.edges!r}, expected True or False")
        _check_block(self.block, "")


@dataclass(frozen=True, kw_only=True)
class FilmAntithetic(Method):
    """First vertices that stay on surfaces, and film points in mirrored fours [YZN*22], for moving cameras and meshes.

    What the camera sees moves under the pixel filter, which is differentiated instead of the surfaces' textures
    (``kernels/interior/film_antithetic.py``). Edges that stay with a surface need no boundary term; silhouettes have
    that of ``boundary.PathSpace`` in this form, but where the camera sees a closed convex room and nothing else. Four
    samples share their random numbers: take multiples of four.

    Attributes:
        mirrored: whether film points come in fours; drawn one by one they are there to compare with.
    """

    mirrored: bool = True


@dataclass(frozen=True, kw_only=True)
class Textbook(Method):
    """Path replay as [VSJ21] print it (``kernels/interior/textbook.py``), for comparison only.

    It keeps no vertices and divides by every factor, and therefore loses the derivative of factors that are exactly
    zero. It refuses vertices that move in scenes with smooth mirrors or glass, or with participating media
    (``kernels/interior/media_textbook.py``), where it loses what a density or an albedo of zero would scatter.
    """


@dataclass(frozen=True, kw_only=True)
class Radiative(Method):
    """Radiative backpropagation [NDSRJ20] (``kernels/interior/radiative.py``), for comparison only.

    Every vertex of a path estimates the light that arrives there with a path of its own: nothing is kept, and time
    grows with the square of the depth. It refuses vertices that move in scenes with smooth mirrors or glass.

    Attributes:
        linear: take 1 for that light, which costs no further paths and is biased.
    """

    linear: bool = False
