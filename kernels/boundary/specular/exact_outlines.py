"""Outlines of exact shapes that a line crosses (``chain_outlines.py``): their smooth silhouettes, and their rims.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.silhouette.dispatch import make_silhouettes
from warp_psdr.kernels.boundary.silhouette.rim import make_rims
from warp_psdr.kernels.boundary.specular.chain_touch import APART, GRAZED, SAME, ChainOutline, ChainTouch
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.primitive.affine import cofactor, from_axes, make_pose_sink, to_axes
from warp_psdr.kernels.primitive.kind import Affine
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def exact_sheet(scene: Scene, tri: Triangle, low: Link, high: Link) -> wp.int32:
    """Two hits on one side of a shape are neighbours."""
    return wp.where(low.facing == high.facing, SAME, APART)


@functools.cache
def make_exact_outlines(number: int, affine: Affine) -> ChainTouch:
    """Return the functions of an affine kind."""
    silhouettes = make_silhouettes((number,))
    rims = make_rims((number,))

    @wp.func
    def exact_outline(
        scene: Scene,
        tri: Triangle,
        face: wp.int32,
        low: Link,
        high: Link,
        own_low: wp.bool,
        hit: wp.vec3,
        o: wp.vec3,
        d: wp.vec3,
        front: wp.bool,
    ) -> ChainOutline:
        r = ChainOutline()
        r.face = face
        g = affine.graze(from_axes(tri, hit - tri.normal), from_axes(tri, o - tri.normal), from_axes(tri, d))
        r.rim = g.rim
        r.q = g.q
        r.x = tri.normal + to_axes(tri, g.q)
        w = wp.normalize(r.x - o)
        if wp.static(rims is not None):
            if g.rim == 1:
                r.m = wp.cross(rims.rate(tri, g.q), w)
        if wp.static(silhouettes is not None):
            if g.rim == 0:
                r.m = wp.normalize(cofactor(tri, g.normal))
                r.curvature = silhouettes.curvature(tri, g.q, w)
        r.valid = wp.where(g.off < GRAZED and wp.length_sq(r.m) > 0.0, 1, 0)
        return r

    def make_sink(role: str) -> wp.Function:
        accumulate_pose = make_pose_sink(role)

        @wp.func
        def accumulate_exact_outline(
            scene: Scene, target: wp.array(dtype=wp.float32), outline: ChainOutline, g: wp.vec3
        ) -> wp.float32:
            tri = scene.triangles[outline.face]
            return accumulate_pose(target, tri, outline.q[0] * g, outline.q[1] * g, outline.q[2] * g, g)

        return accumulate_exact_outline

    return ChainTouch(exact_outline, exact_sheet, make_sink)
