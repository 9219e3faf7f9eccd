"""Smooth silhouettes of shapes without triangles: those that the camera sees, and those between two path vertices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.kernels.boundary.silhouette.secondary import make_secondary_silhouette_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.exact_shapes import require_uncut

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Share of the segments whose direction is drawn uniformly instead of towards a light, as ``secondary.py``'s; where the
#: camera sees nothing but lights' own light, and no light is everywhere, those alone count that end on one.
UNIFORM_SHARE_DIRECT, UNIFORM_SHARE = 0.1, 0.5


def applies(r: Request) -> bool:
    """Whether there are such shapes, and they or the camera move."""
    return bool(r.config.primitives) and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    faces = _faces(r.scene, None if r.moves.camera else r.moves.shapes)
    if faces is None:
        return None
    require_uncut(r.scene, r.sensor, None if r.moves.camera else r.moves.shapes)
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera)
    samples = r.pixels * (r.method.spp_primary or r.spp)
    return term_of(r, PRIMARY, kernel, [r.scene.data(), r.camera, faces], samples)


def applies_between(r: Request) -> bool:
    """Whether light is scattered beside such shapes, and anything moves."""
    lit = r.plan.max_depth != 1 and bool(r.scene.builder.emitters)
    return bool(r.config.primitives) and lit and r.moves.edges and r.scatters_smoothly


def launch_between(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on a shape that moves."""
    faces = _faces(r.scene, None)
    if faces is None:
        return None
    kernel = make_secondary_silhouette_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, r.indirect)
    aimed = r.plan.max_depth == 2 and r.scene.builder.environment < 0
    share = UNIFORM_SHARE_DIRECT if aimed else UNIFORM_SHARE
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    head = [r.scene.data(), r.camera, faces, moving_shapes(r.scene, r.moves), share]
    return term_of(r, SECONDARY, kernel, head, samples)


def _faces(scene: Scene, shapes: frozenset[int] | None) -> wp.array | None:
    """Return the numbers of the records of some shapes without triangles (None: of all); None: there are none."""
    found = [scene.face_count + k for k, i in enumerate(scene.builder.primitives) if shapes is None or i in shapes]
    return wp.array(np.array(found, np.int32), dtype=wp.int32, device=scene.device) if found else None


PRIMARY = BoundaryTerm(
    name="primary_silhouette",
    title="primary silhouettes of exact shapes",
    stream=9,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
)
SECONDARY = BoundaryTerm(
    name="secondary_silhouette",
    title="{} silhouettes of exact shapes",
    stream=10,
    methods=(PathSpace,),
    launch=launch_between,
    applies=applies_between,
    splits=True,
    exact=True,
)
