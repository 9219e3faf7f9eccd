"""Methods of the boundary term: options, one object each. ``estimate/boundary/terms`` has the launches of each."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar, Self

from warp_psdr.kernels.boundary.edge_sampling.edge_tree import MAX_SPLIT
from warp_psdr.options import guiding as guiding_methods
from warp_psdr.options.words import COMMON, MEDIA, SOLIDS, words

#: Candidates without the hierarchies: [LADL18] take 64; more than 1024 cost more than they tell.
DEFAULT_CANDIDATES, MAX_CANDIDATES = 64, 1024
#: Most auxiliary rays of a net, and the range of the concentration of their weights: float32 knows the angles between.
MAX_RAYS, KAPPA_RANGE = 1024, (10.0, 1.0e5)
#: Range of the deviation of a kernel on the film [pixels].
SIGMA_RANGE = (0.05, 4.0)
#: What methods know that connect edges to the camera.
_FROM_EDGES = COMMON - words("radiancemeter", "irradiancemeter") | words("moving_mirrors") | MEDIA


@dataclass(frozen=True, kw_only=True)
class Method(ABC):  # noqa: B024
    """A way to estimate the boundary term.

    Attributes:
        spp_primary: samples of the edges that the camera sees, a pixel; None: as many as the interior term's.
        spp_secondary: samples of shadow edges and their like, a pixel; None: as many as the interior term's. Some terms
            of grids, networks and curves take shares of these two (``docs/theory/implicit.md#shares-of-the-samples``).
        knows: words (``options/words.py``) of what it copes with where something moves.
    """

    knows: ClassVar[frozenset[str]] = frozenset()

    spp_primary: int | None = None
    spp_secondary: int | None = None

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            TypeError: this is no method.
            ValueError: a sample count is not a positive integer.
        """
        if type(self) in (Method, Connecting, Reparametrised, Distances, AuxiliaryRays, WeightedRays):
            raise TypeError(f"boundary.{type(self).__name__} is what methods have in common; make one of them")
        for name in self._counts():
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ValueError(f"{name}: got {value!r}, expected a positive integer (samples a pixel), or None")

    @property
    def label(self) -> str:
        """What the plan calls it."""
        return f"boundary.{type(self).__name__}"

    def without_counts(self) -> Self:
        """Return the method with as many samples of everything as the interior term has."""
        return replace(self, **dict.fromkeys(self._counts()))

    def _counts(self) -> list[str]:
        return [f.name for f in fields(self) if f.name.startswith("spp_")]


@dataclass(frozen=True, kw_only=True)
class Connecting(Method):
    """What methods have in common that connect an edge to the camera on one side and to a light on the other.

    Attributes:
        spp_mirrors: paths along which what is seen through smooth mirrors and glass is searched, a pixel; None: as many
            as the interior term's.
        guiding: a method of ``psdr.guiding``; None: none.
    """

    spp_mirrors: int | None = None
    guiding: guiding_methods.Method | None = None

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        if self.guiding is not None and not isinstance(self.guiding, guiding_methods.Method):
            raise ValueError(
                f"guiding: got {self.guiding!r}, expected a method of psdr.guiding, for example psdr.guiding.KdTree(), "
                "or None"
            )


@dataclass(frozen=True, kw_only=True)
class PathSpace(Connecting):
    """Multi-directional sampling of boundary paths [ZMY*20] (``kernels/boundary/``).

    The method is unbiased for triangle meshes with moving shapes, which may run through each other and interpolate
    normals, for area, environment, point, spot and directional lights, and for a moving camera, at any depth. Through
    smooth mirrors and glass it searches along lines, to 16 path vertices
    (``kernels/boundary/specular/line_search.py``).

    It refuses faces' attributes where texture coordinates move, spots whose light ends abruptly, projectors of that
    kind beside media, surfaces that a clip plane cuts in sight, and shapes that share an edge.

    Surfaces that merely touch are in contact. As they move apart, or into each other, the image has two one-sided
    derivatives, and the result at the contact is neither. Forward mode warns of such tangents. The gradient of reverse
    mode holds for motions along contacts and for those that keep together what touches; the plan names the shapes
    (``warp_psdr/topology/contacts.py``).

    Attributes:
        guiding: a method of ``psdr.guiding`` that learns where silhouettes between path vertices (shadow edges, for
            example) carry light, such as ``psdr.guiding.KdTree()``; None: edges by length and angle, directions by the
            wedge or the lights.
        spp_mirrors: paths a pixel along which discontinuities behind smooth mirrors and glass are searched; None: as
            many as the interior term's.
    """

    knows: ClassVar[frozenset[str]] = _FROM_EDGES | SOLIDS | words("solids_in_media", "transient", "material_first")


@dataclass(frozen=True, kw_only=True)
class EdgeSampling(Method):
    """Unidirectional edge sampling [LADL18]: silhouette edges as every vertex of a camera path sees them.

    The method is unbiased for what ``PathSpace`` covers, without mirrors and glass. Edges are resampled by the line
    integral of the scattering lobe; half of the samples aim at a light
    (``kernels/boundary/edge_sampling/edge_sampling.py``). A path vertex cannot meet a point, spot or directional light,
    so their shadow edges are sampled from the edge, as in ``PathSpace``. In media, vertices may be points of the medium
    (``kernels/boundary/edge_sampling/media_edge_sampling.py``).

    Attributes:
        tree: choose edges by hierarchies over position and face planes; otherwise by length and angle alone.
        candidates: edges that are resampled for each sample; None: 16 with the hierarchies, else 64.
    """

    knows: ClassVar[frozenset[str]] = COMMON - words("mirrors", "rough_glass", "irradiancemeter") | MEDIA

    tree: bool = True
    candidates: int | None = None

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        if not isinstance(self.tree, bool):
            raise ValueError(f"tree: got {self.tree!r}, expected True or False")
        most = MAX_SPLIT if self.tree else MAX_CANDIDATES
        value = self.candidates
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most):
            raise ValueError(f"candidates: got {value!r}, expected an integer from 1 to {most}, or None")


@dataclass(frozen=True, kw_only=True)
class FilmEdges(Method):
    """Edges that the camera sees, and no others: what ``interior.RadiativeTransfer()`` has beside it, unnamed."""


@dataclass(frozen=True, kw_only=True)
class Projective(Connecting):
    """Projective sampling [ZRJ23]: ordinary paths teach where boundary segments carry light.

    Segments of camera paths that end on a surface are projected to the nearest silhouette of that surface, by a walk
    over its mesh (``kernels/boundary/guiding/projective.py``). Guiding puts its cells where these seeds lie. Otherwise
    the estimator is that of ``PathSpace``: unbiased whatever the projection finds, with the same coverage, except
    that grids, networks and curves are refused where something moves.

    Attributes:
        guiding: a method of ``psdr.guiding``; ``KdTree`` and ``Octree`` are finest where seeds lie. None: the paper's
            reference, uniform sampling of edges by length and angle and of directions by the wedge; half of the samples
            then aim at point, spot and directional lights.
        paths: camera paths whose segments are projected, for each kind of them.
        spp_mirrors: as of ``PathSpace``.
    """

    knows: ClassVar[frozenset[str]] = _FROM_EDGES | words("material_points", "solids_in_media")

    guiding: guiding_methods.Method | None = field(default_factory=guiding_methods.Octree)
    paths: int = 1 << 16

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        if isinstance(self.paths, bool) or not isinstance(self.paths, int) or self.paths < 1:
            raise ValueError(f"paths: got {self.paths!r}, expected a positive integer")


@dataclass(frozen=True, kw_only=True)
class Reparametrised(Method):
    """What methods have in common whose rays move with discontinuities: none is sampled.

    Interior and boundary term are one integral, with the samples of the interior. Only the borders of pixels, where a
    filter jumps, have samples of their own, ``spp_primary``.
    """

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        if self.spp_secondary is not None:
            raise ValueError(
                f"spp_secondary: got {self.spp_secondary!r}, expected None: {self.label}() samples no shadow edges; "
                "its paths are those of the interior term, whose number is spp"
            )


@dataclass(frozen=True, kw_only=True)
class Distances(Reparametrised):
    """What methods have in common whose rays move with the silhouettes of a signed distance.

    Attributes:
        max_steps: steps of sphere tracing after which a ray's motion is decided. None: rays go on until they arrive or
            leave. A limit is a bias: rays next to silhouettes take the most steps.
        step_scale: share of the distance that a step takes, in (0, 1]. Grids that are steeper than a distance, by the
            factor k, need 1 / k at most. Networks are divided by a bound of their slope before.
    """

    knows: ClassVar[frozenset[str]] = SOLIDS | words("turned_normals", "far_lights", "hide_emitters", "hidden_lights")

    max_steps: int | None = None
    step_scale: float = 1.0

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        value = self.max_steps
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ValueError(f"max_steps: got {value!r}, expected a positive integer, or None")
        scale = self.step_scale
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0.0 < scale <= 1.0:
            raise ValueError(f"step_scale: got {scale!r}, expected a number in (0, 1]")


@dataclass(frozen=True, kw_only=True)
class SignedDistance(Distances):
    """Rays that move with the silhouettes of a signed distance function [VSJ22], each evaluated at one place.

    The method is unbiased without ``max_steps``. It serves one exact sphere, ``sdfgrid`` with cubic interpolation or
    ``neuralsdf`` that moves or changes, alone under a sky or with flat surfaces around it under a flat area light, in
    direct light (``max_depth`` 1 or 2). It refuses other motions, and discontinuities of other shapes within sight
    (``warp_psdr/rows/reparametrised.py``).
    """


@dataclass(frozen=True, kw_only=True)
class NeuralSignedDistance(Distances):
    """Rays that move with the silhouettes of a signed distance function, evaluated at every step [BGL*22].

    Covers what ``SignedDistance`` covers. The paper's fields are networks; the weights serve any signed distance.
    """


@dataclass(frozen=True, kw_only=True)
class AuxiliaryRays(Method):
    """What methods have in common whose auxiliary rays see what moves about a ray.

    Attributes:
        rays: auxiliary rays about each ray.
        kappa: their concentration: they count up to an angle of some kappa^-1/2 radians.
    """

    knows: ClassVar[frozenset[str]] = words("far_lights", "hide_emitters", "hidden_lights")

    rays: int = 16
    kappa: float = 1000.0

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        k = self.rays
        if isinstance(k, bool) or not isinstance(k, int) or not 2 <= k <= MAX_RAYS:
            raise ValueError(f"rays: got {k!r}, expected an integer from 2 to {MAX_RAYS}")
        low, high = KAPPA_RANGE
        if isinstance(self.kappa, bool) or not isinstance(self.kappa, (int, float)) or not low <= self.kappa <= high:
            raise ValueError(f"kappa: got {self.kappa!r}, expected a number from {low:g} to {high:g}")


@dataclass(frozen=True, kw_only=True)
class WeightedRays(AuxiliaryRays):
    """What methods have in common that take the weighted mean of what auxiliary rays see move.

    Attributes:
        rays: K, auxiliary rays about each ray, a power of two.
        debias: double their number at random, so that the mean is that of infinitely many: 2.3 K rays in the mean.
            False: K rays, whose quotient of sums has a bias; it falls with K.
    """

    debias: bool = True

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        if self.rays & (self.rays - 1):
            raise ValueError(f"rays: got {self.rays!r}, expected a power of two from 2 to {MAX_RAYS}")
        if not isinstance(self.debias, bool):
            raise ValueError(f"debias: got {self.debias!r}, expected True or False")


@dataclass(frozen=True, kw_only=True)
class WarpedArea(Reparametrised, WeightedRays):
    """Rays that move with the edges of meshes: warped-area sampling [BLD20].

    The weighted mean of what auxiliary rays about a ray of a path see move is the motion of that ray. Unbiased with
    ``debias``, for triangle meshes without interpolated normals that move under area lights and skies before a
    perspective camera at rest, at most 16 path vertices. Hard shadows, mirrors and glass, media, shapes without
    triangles, shapes that touch or run through each other, and textures with steps are refused
    (``warp_psdr/rows/warped_area.py``).
    """


@dataclass(frozen=True, kw_only=True)
class Rotation(Reparametrised, AuxiliaryRays):
    """Rays that turn with the edges of meshes: rotations of kernels of directions [LHJ19].

    Biased by design: one rotation serves all edges that a kernel sees, and few rays choose it
    (``docs/methods/rotation.md``). ``WarpedArea`` is its unbiased successor. Covers and refuses what ``WarpedArea``
    does.

    Attributes:
        rays: auxiliary rays of a kernel, which choose its rotation.
        kappa: concentration of the von Mises-Fisher kernels of rays from path vertices: a larger one sees fewer
            edges at once, and has more noise.
        film_sigma: standard deviation of the kernels of the camera's rays [pixels].
        pairs: give each ray two kernels, which mirror each other about it and cancel where nothing moves but
            one surface. False: one, of half the cost and many times the variance.
        fresh: choose by other rays than the one that turns. False: that one is among them, as published, and another
            one's divergence is subtracted with ``pairs``.
    """

    rays: int = 4
    film_sigma: float = 0.4
    pairs: bool = True
    fresh: bool = False

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        low, high = SIGMA_RANGE
        sigma = self.film_sigma
        if isinstance(sigma, bool) or not isinstance(sigma, (int, float)) or not low <= sigma <= high:
            raise ValueError(f"film_sigma: got {sigma!r}, expected a number of pixels from {low:g} to {high:g}")
        for name in ("pairs", "fresh"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected True or False")


@dataclass(frozen=True, kw_only=True)
class PathWarpedArea(WeightedRays):
    """Warped-area sampling of path space's boundary term [XBLZ23], beside its interior term as it is.

    Rays move against the points that they find, along camera paths of their own, ``spp_secondary`` a pixel; samples of
    the borders of pixels, where a filter jumps, are ``spp_primary``. Covers what ``WarpedArea`` covers.
    """
