"""Methods of the interior term ([ZCZ25] eq. 12 first term, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from warp_psdr.options import combinations
from warp_psdr.options.words import COMMON, MEDIA, SOLIDS, words


class Method:
    """Base of all methods: a way to estimate the interior term.

    Attributes:
        knows: words (``options/words.py``) of what it copes with.
    """

    knows: ClassVar[frozenset[str]] = frozenset()


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
        block: K, the number of path vertices that are kept at a time. Longer paths are replayed in blocks.
            (Without a depth limit, paths are cut some 500 vertices after Russian roulette begins, one in 10^11.)
        flow: how vertices of smooth grids (``interpolation: cubic``) and networks move, which have no material points.
            "ray": along the rays that found them; "normal": along the normals, as in [ZCM*24], with the change of the
            area element. Under "normal" light that such shapes send past their silhouettes does not count in the
            boundary term. Both are unbiased. "normal" refuses curves, and shapes whose normals are not continuous
            (linear grids) (``docs/theory/implicit.md#normal-flow``). All other shapes have material points.
    """

    knows: ClassVar[frozenset[str]] = COMMON | MEDIA | SOLIDS | words("moving_mirrors", "solids_in_media", "transient")

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

    The method draws the image as well as its derivatives. It finds light of no area behind glass and mirrors, which
    paths from the camera never find. Camera rays draw what the camera sees in mirrors and glass, and the lights
    that it sees. Samples a pixel are light paths over pixels; there are as many camera paths. Derivatives, by record
    and sweep [NDSRJ20], are by everything that moves no vertex (``kernels/interior/light_tracing.py``). What moves
    vertices, or the camera, is differentiated by paths from the camera, whose image has the same mean. With
    ``boundary=None`` light paths follow it, interior term alone (``light_motion.py``).

    Attributes:
        block: K, as of ``Replay``.
    """

    knows: ClassVar[frozenset[str]] = COMMON - words("radiancemeter") | words("moving_mirrors")

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

    A camera path finds light by hitting it and by next-event estimation; a light path is joined to the camera. Each
    counts with the balance heuristic over all ways to draw it [Vea97]. The method draws the image as well as its
    derivatives by parameters that move no vertex of its paths; the others are those of ``Replay``. Samples a pixel are
    camera paths; there are as many light paths.

    Attributes:
        connections: "light": the three ways above; "all": the vertices of both paths are joined as well, for paths of
            at most 16 vertices.
        block: K, as of ``Replay``; with "all" the whole path is kept.
    """

    knows: ClassVar[frozenset[str]] = COMMON - words("radiancemeter", "hide_emitters", "moving_vertices") | words(
        "moving_mirrors"
    )

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

    The method branches for two kinds of parameters. The first are numbers of materials with smooth lobes (roughnesses,
    exponents, indices of refraction, weights of mixtures, opacities), one of them a sample. For weights, half of the
    candidates come from each end of the mixture. The second turn the normals of glossy surfaces (normal and bump maps,
    vertex normals, and positions, poses and cameras as far as they turn normals); a pair of directions, drawn by both
    tilts, serves them (``kernels/interior/factors/opposite.py``). Beside smooth mirrors and glass, vertices that
    move are replayed. In scenes with participating media the method branches for `g` of `hg` alone. ``Replay()``
    does the rest.

    Attributes:
        candidates: number of directions, and of light points, that are compared where a path branches; a square.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("media", "moving_mirrors")

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
    One table says which choices go together, and why: ``docs/methods/attached.md``. With all detached the method is
    replay. Attached directions are those of rough metal by its roughness, where reflected rays meet only the sky.

    Attributes:
        bsdf: directions that leave surfaces: "attached" or "detached".
        emitter: points on lights; "detached" alone is offered.
        weights: weights of multiple importance sampling: "detached", "attached", or "position": attached through the
            moving direction alone.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("moving_mirrors")

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
    """Derivatives of one sign each [BXB*24] (``kernels/interior/decomposed.py``, ``factors/mixtures.py`` beside it).

    The method branches by the lobes of the derivative for roughnesses of `roughconductor` (either distribution),
    exponents of `ashikhminshirley` (isotropic or not), `A`, `B` and `C` of `abc`, `sigma` of `orennayar`, and `eta` of
    `roughplastic`, which weighs its coat against its base. It branches by the two ends of a mixture for `weight` of
    `blendbsdf`, `opacity` of `mask`, and `metallic`, `spec_trans`, `clearcoat`, `sheen`, `sheen_tint`, `flatness`,
    `spec_tint` and `diff_trans` of `principled` and `principledthin`, nested or not. In scenes with participating media
    it branches for `g` of `hg`. It refuses other shapes of lobes, which ``Resampled()`` takes; ``Replay()`` does the
    rest.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("media", "moving_mirrors")


@dataclass(frozen=True, kw_only=True)
class Antithetic(Method):
    """Antithetic pairs at glossy surfaces [ZDDZ21] (``kernels/interior/antithetic.py``); the rest: replay.

    Pairs serve derivatives by parameters that turn the normals of glossy surfaces: normal and bump maps, vertex
    normals, and positions and poses as far as they turn normals. ``Replay()`` does everything else that is requested,
    and everything else that those parameters move. The method refuses requests in which no normal turns, and moving
    vertices beside smooth mirrors or glass.
    """

    knows: ClassVar[frozenset[str]] = COMMON


@dataclass(frozen=True, kw_only=True)
class Branches(Method):
    """What ``PathIntegrator(interior="auto")`` chooses: several methods side by side, and ``Replay()`` of the rest.

    Attributes:
        shapes: "resampled" or "decomposed": shapes of lobes are ``Resampled()``'s or ``Decomposed()``'s; "": replayed.
        normals: "antithetic" or "resampled": normals are ``Antithetic()``'s or ``Resampled()``'s; "": replayed.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("moving_mirrors")

    shapes: str = ""
    normals: str = ""


@dataclass(frozen=True, kw_only=True)
class DifferentialRatioTracking(Method):
    """Differential ratio tracking [NDMKJ22] in grids of density (``kernels/interior/differential_ratio_tracking.py``).

    The derivative of in-scattering by the density is shared between collisions and points that are drawn by
    transmittance alone. One stretch of each path has such a point, and a new path starts there. ``Replay()`` does the
    rest.

    Attributes:
        block: K, as of ``Replay``.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("media")

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

    The method is for small scenes with homogeneous media. Directions and distances are fixed in the world, unlike in
    ``Replay()``. It estimates the terms of moving ends of flights, and of edges that vertices of a path see, on
    surfaces and in the medium; there is no method of the boundary term beside it. Derivatives by parameters that
    move nothing are those of ``Replay()``.

    Attributes:
        edges: sample the edges that path vertices see; False leaves them out.
        block: K, as of ``Replay``.
    """

    knows: ClassVar[frozenset[str]] = COMMON | words("media", "moving_media")

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

    The image of a surface moves under the pixel filter, and the filter is differentiated in place of the surface's
    textures (``kernels/interior/film_antithetic.py``). Edges that stay with a surface need no boundary term.
    Silhouettes have that of ``boundary.PathSpace`` in this form, except where the camera sees a closed convex room and
    nothing else. Four samples share their random numbers: take multiples of four.

    Attributes:
        mirrored: draw film points in fours; False draws them one by one, for comparison.
    """

    knows: ClassVar[frozenset[str]] = words(
        *(
            "moving_vertices",
            "vertex_normals",
            "rough_glass",
            "turned_normals",
            "steps",
            "point_lights",
            "far_lights",
            "hide_emitters",
        )
    )

    mirrored: bool = True


@dataclass(frozen=True, kw_only=True)
class Textbook(Method):
    """Path replay as [VSJ21] print it (``kernels/interior/textbook.py``), for comparison only.

    It keeps no vertices and divides by every factor, and therefore loses the derivative of factors that are exactly
    zero. It refuses vertices that move in scenes with smooth mirrors or glass, or with participating media
    (``kernels/interior/media_textbook.py``), where it loses what a density or an albedo of zero would scatter.
    """

    knows: ClassVar[frozenset[str]] = (
        COMMON | SOLIDS - words("moving_slides") | MEDIA - words("moving_media", "density_grids")
    )


@dataclass(frozen=True, kw_only=True)
class Radiative(Method):
    """Radiative backpropagation [NDSRJ20] (``kernels/interior/radiative.py``), for comparison only.

    Every vertex of a path estimates its incident light with a path of its own. Nothing is kept, and time grows with the
    square of the depth. The method refuses vertices that move in scenes with smooth mirrors or glass.

    Attributes:
        linear: set that light to 1, which costs no further paths and is biased.
    """

    knows: ClassVar[frozenset[str]] = COMMON | SOLIDS - words("moving_slides")

    linear: bool = False
