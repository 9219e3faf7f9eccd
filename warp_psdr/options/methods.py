"""The table of the published methods behind ``psdr.methods()``, the README and the documentation."""

from __future__ import annotations

from dataclasses import dataclass, fields

from warp_psdr import html


@dataclass(frozen=True, kw_only=True)
class Method:
    """A published method and where it stands.

    Attributes:
        key: the paper, by its key in the references of the survey [ZCZ25] and in ``docs/references.bib``.
        paper: what the paper calls the method.
        option: the expression behind ``psdr.`` that asks for it.
        term: what it estimates, or helps to: "interior", "boundary" or "guiding".
        file: the file that implements it, from the repository's root.
        page: its page, from the repository's root.
    """

    key: str
    paper: str
    option: str
    term: str
    file: str
    page: str


class MethodTable(tuple[Method, ...]):
    """All methods; prints as a table."""

    __slots__ = ()

    def __repr__(self) -> str:
        rows = [["paper", "method", "option", "term", "file", "page"]]
        rows += [[f"[{m.key}]", m.paper, f"psdr.{m.option}", m.term, m.file, m.page] for m in self]
        return "\n".join(html.aligned(rows))

    def _repr_html_(self) -> str:
        names = [f.name for f in fields(Method)]
        head = "".join(f"<th>{name}</th>" for name in names)
        body = "".join("<tr>" + "".join(f"<td>{getattr(m, name)}</td>" for name in names) + "</tr>" for m in self)
        return f"<table><tr>{head}</tr>{body}</table>"

    def markdown(self) -> str:
        """Return the table as Markdown, with links from the repository's root."""
        lines = ["| paper | term | option | file | page |", "|---|---|---|---|---|"]
        for m in self:
            key, file = m.key.replace("*", "\\*"), m.file.rpartition("/")[2]
            name = m.page.rpartition("/")[2].removesuffix(".md")
            lines.append(f"| {m.paper} [{key}] | {m.term} | `{m.option}` | [`{file}`]({m.file}) | [{name}]({m.page}) |")
        return "\n".join(lines)


_METHODS = MethodTable(
    Method(key=key, paper=paper, option=option, term=term, file=file, page=f"docs/methods/{page}.md")
    for key, paper, option, term, file, page in (
        (
            *("VSJ21", "Path replay, by record and sweep", "interior.Replay()", "interior"),
            *("kernels/interior/replay.py", "replay"),
        ),
        (
            *("VSJ21", "Path replay, as published", "interior.Textbook()", "interior"),
            *("kernels/interior/textbook.py", "textbook"),
        ),
        (
            *("NDSRJ20", "Radiative backpropagation", "interior.Radiative()", "interior"),
            *("kernels/interior/radiative.py", "radiative"),
        ),
        (
            *("NDSRJ20", "Light tracing, its adjoint by record and sweep", "interior.LightTracing()", "interior"),
            *("kernels/interior/light_tracing.py", "light_tracing"),
        ),
        (
            *("VSJ21", "Bidirectional paths, by record and sweep", "interior.Bidirectional()", "interior"),
            *("kernels/interior/bidirectional.py", "bidirectional"),
        ),
        (
            *("BXB*24", "Positivisation, by resampling", "interior.Resampled()", "interior"),
            *("kernels/interior/resampled.py", "resampled"),
        ),
        (
            *("ZSGJ21", "Attached samples", 'interior.Attached(bsdf="attached", weights="attached")', "interior"),
            *("kernels/interior/attached.py", "attached"),
        ),
        (
            *("BXB*24", "Positivisation, in closed form", "interior.Decomposed()", "interior"),
            *("kernels/interior/decomposed.py", "decomposed"),
        ),
        (
            *("ZDDZ21", "Antithetic sampling of scattering functions", "interior.Antithetic()", "interior"),
            *("kernels/interior/antithetic.py", "antithetic"),
        ),
        (
            *("NDMKJ22", "Differential ratio tracking", "interior.DifferentialRatioTracking()", "interior"),
            *("kernels/interior/differential_ratio_tracking.py", "differential_ratio_tracking"),
        ),
        (
            *("ZWZ*19", "Differential radiative transfer", "interior.RadiativeTransfer()", "interior"),
            *("kernels/transfer/radiative_transfer.py", "radiative_transfer"),
        ),
        (
            *("YZN*22", "Mirrored film points", "interior.FilmAntithetic()", "interior"),
            *("kernels/interior/film_antithetic.py", "film_antithetic"),
        ),
        (
            *("ZMY*20", "Path-space boundary sampling", "boundary.PathSpace()", "boundary"),
            *("kernels/boundary/path_space/secondary.py", "path_space"),
        ),
        (
            *("ZCM*24", "Boundaries of implicit surfaces", "boundary.PathSpace(guiding=None)", "boundary"),
            *("kernels/boundary/silhouette/grid_touch.py", "implicit_surfaces"),
        ),
        (
            *("ZYZ21", "Path-space boundaries in media", "boundary.PathSpace(spp_secondary=None)", "boundary"),
            *("kernels/boundary/path_space/media_secondary.py", "path_space_media"),
        ),
        (
            *("LADL18", "Edge sampling", "boundary.EdgeSampling()", "boundary"),
            *("kernels/boundary/edge_sampling/edge_sampling.py", "edge_sampling"),
        ),
        (
            *("ZRJ23", "Projective sampling", "boundary.Projective()", "boundary"),
            *("kernels/boundary/guiding/projective.py", "projective"),
        ),
        (
            *("VSJ22", "Rays that move with silhouettes", "boundary.SignedDistance()", "boundary"),
            *("kernels/boundary/signed_distance/reparametrised.py", "signed_distance"),
        ),
        (
            *("BGL*22", "The same, with the weights of neural fields", "boundary.NeuralSignedDistance()", "boundary"),
            *("kernels/boundary/signed_distance/march.py", "signed_distance"),
        ),
        (
            *("BLD20", "Warped-area sampling", "boundary.WarpedArea()", "boundary"),
            *("kernels/boundary/warped_area/warped_area.py", "warped_area"),
        ),
        (
            *("XBLZ23", "The same beside path space's interior", "boundary.PathWarpedArea()", "boundary"),
            *("kernels/boundary/warped_area/path_warped_area.py", "warped_area"),
        ),
        (
            *("LHJ19", "Rotations of kernels (biased)", "boundary.Rotation()", "boundary"),
            *("kernels/boundary/warped_area/rotation.py", "rotation"),
        ),
        (
            *("ZMY*20", "Grid of photons and importons", "guiding.Grid()", "guiding"),
            *("warp_psdr/estimate/guiding/grid.py", "grid"),
        ),
        (
            *("YLB*22", "k-d tree over edges and directions", "guiding.KdTree()", "guiding"),
            *("warp_psdr/estimate/guiding/kdtree.py", "kd_tree"),
        ),
        (
            *("ZRJ23", "Octree over edges and directions", "guiding.Octree()", "guiding"),
            *("warp_psdr/estimate/guiding/octree.py", "octree"),
        ),
    )
)


def methods() -> MethodTable:
    """Return the published methods that exist here, with paper, option, file and page.

    Returns:
        One ``Method`` each; ``print`` shows a table.
    """
    return _METHODS
