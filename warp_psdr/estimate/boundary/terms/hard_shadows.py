"""Shadow edges of point, spot and directional lights alone, between surfaces and in media; frames of images."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.light_frame import make_light_frame_kernel
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_secondary_kernel
from warp_psdr.kernels.boundary.path_space.secondary import make_secondary_kernel
from warp_psdr.kernels.structs import Emitter
from warp_psdr.kernels.structs import Scene as SceneData
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.discontinuities import LIGHT_FRAME
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.scene.lights.light_sampling import cumulative
from warp_psdr.topology.edges_there import secondary_edges_there
from warp_psdr.topology.light_frames import frame_lines
from warp_psdr.topology.secondary_edges import secondary_edges


def applies(r: Request) -> bool:
    """Whether there is such a light."""
    return r.plan.max_depth != 1 and any(e.kind in c.DELTA_LIGHTS for e in r.scene.builder.emitters)


def point_like_lights(r: Request) -> SceneData:
    """Return the scene's record with the chances of its point, spot and directional lights alone."""
    data = r.scene.data()
    records = data.emitters.numpy().copy()  # on the CPU ``numpy`` is a view of the scene's own records
    cdf = cumulative(np.where(np.isin(records["kind"], list(c.DELTA_LIGHTS)), records["probability"], 0.0))
    records["probability"] = np.diff(cdf)
    data.emitters = wp.array(records, dtype=Emitter, device=r.scene.device)
    data.emitter_cdf = wp.array(cdf, dtype=wp.float32, device=r.scene.device)
    return data


def launch(r: Request) -> Term | None:
    """Return the term of the shadow edges of point, spot and directional lights alone."""
    edges = secondary_edges(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_secondary_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, False, r.indirect)
    # No share of the wedge: every sample goes to a light.
    head = [point_like_lights(r), r.camera, edges, moving_shapes(r.scene, r.moves), Guide()]
    return term_of(r, ON_SURFACES, kernel, head, samples)


def applies_in_media(r: Request) -> bool:
    """Whether there is such a light, and edges, lights or the camera move."""
    return r.config.media is not None and r.moves.edges and applies(r)


def launch_in_media(r: Request) -> Term | None:
    """Return the term of the shadow edges of point, spot and directional lights, of what is there."""
    edges = secondary_edges_there(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    deep = r.plan.max_depth != 2
    kernel = make_media_secondary_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, deep, r.moves.grids)
    # No share of the wedge: every sample goes to a light.
    head = [point_like_lights(r), r.camera, edges, moving_shapes(r.scene, r.moves), Guide()]
    return term_of(r, IN_MEDIA, kernel, head, samples)


def shows_frames(r: Request) -> bool:
    """Whether there is a projector, and lights, surfaces or the camera move."""
    there = any(e.kind == c.EMITTER_PROJECTOR for e in r.scene.builder.emitters)
    return there and LIGHT_FRAME.applies(r.asked)


def launch_frames(r: Request) -> Term | None:
    """Return the term of the frames of projected images, and of their texels."""
    lines = frame_lines(r.scene)
    if lines is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_light_frame_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose)
    return term_of(r, FRAMES, kernel, [r.scene.data(), r.camera, lines, moving_shapes(r.scene, r.moves)], samples)


ON_SURFACES = BoundaryTerm(
    name="hard_shadows",
    title="{} hard shadows",
    stream=1,
    methods=(EdgeSampling,),
    launch=launch,
    applies=applies,
    splits=True,
)
IN_MEDIA = BoundaryTerm(
    name="media_hard_shadows",
    title="hard shadows in media",
    stream=11,
    methods=(EdgeSampling,),
    launch=launch_in_media,
    applies=applies_in_media,
    knows=words("media", "material_points"),
)
FRAMES = BoundaryTerm(
    name="light_frame",
    title="frames of projected images",
    stream=62,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch_frames,
    applies=shows_frames,
    knows=LIGHT_FRAME.knows,
)
TERMS = {term.name: term for term in (ON_SURFACES, IN_MEDIA, FRAMES)}
