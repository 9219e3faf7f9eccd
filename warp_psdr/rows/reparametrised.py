"""Boundary methods whose rays move with the silhouettes of a signed distance: the scenes for which they are right.

Rays near a silhouette move whatever else they see. No other discontinuity may therefore lie there: neither on the film,
nor anywhere in what a path vertex sees of the lights. Scenes that are not known to be free of them are refused.

Derivation: ``docs/theory/signed_distances.md#what-rays-that-move-may-see``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.signed_distance.box import FADE
from warp_psdr.kernels.boundary.signed_distance.reparametrised import make_reparametrised_kernel
from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpOptions
from warp_psdr.kernels.boundary.warped_area.auxiliary import WarpedOptions
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions
from warp_psdr.kernels.primitive.kind import FLOWS
from warp_psdr.options import interior
from warp_psdr.options.boundary import AuxiliaryRays, Distances, Method, NeuralSignedDistance, Reparametrised
from warp_psdr.plan.motion import motion
from warp_psdr.rows import warped_area
from warp_psdr.scene.kinds.neuralsdf import Network, bound_slopes, network_and_cells
from warp_psdr.scene.kinds.zero_set import CORNERS, ZeroSet
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.edges import area_normals
from warp_psdr.topology.film_edges import film_edges
from warp_psdr.topology.grid_contacts import in_box, require_uncut_grids
from warp_psdr.topology.kinds.exact_shapes import pose, require_uncut
from warp_psdr.topology.kinds.grid_silhouettes import grid_values
from warp_psdr.topology.kinds.network_silhouettes import passed_cells

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.rows.replay import Kept
    from warp_psdr.scene.scene import Scene

#: Difference of the lengths of a pose's axes, over their length, up to which it is a similarity.
SIMILAR = 1.0e-4
#: Height over the scene's size up to which a point lies in a plane.
FLAT = 1.0e-5
#: Most triangles of a light: each point of it looks for its border among their edges.
MOST_TRIANGLES = 16
INSTEAD = "use boundary.PathSpace()"


def compiled(method: Method | None) -> WarpOptions | WarpedOptions | RotationOptions | None:
    """Return what of a method is compiled; None: its rays stay."""
    if isinstance(method, AuxiliaryRays) and isinstance(method, Reparametrised):
        return warped_area.compiled(method)
    if not isinstance(method, Distances):
        return None
    return WarpOptions(isinstance(method, NeuralSignedDistance), method.max_steps or 0, float(method.step_scale))


def make_reparametrised(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    """Return the kernel of interior and boundary term."""
    assert isinstance(kept.warp, WarpOptions)
    return make_reparametrised_kernel(config, wanted, role, kept.warp)


def describe(method: Method) -> list[tuple[str, str, str]]:
    """Return the plan's lines; none of a method whose rays stay."""
    if isinstance(method, AuxiliaryRays):
        return warped_area.describe(method)
    if not isinstance(method, Distances):
        return []
    steps = "until they arrive or leave"
    if method.max_steps is not None:
        steps = f"at most {method.max_steps}: biased next to silhouettes"
    return [("silhouettes", "rays move with them", f"steps of sphere tracing: {steps}")]


def refused(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, method: Method, names: list[str], sensor: int
) -> str:
    """Say why rays that move are not right; empty: they are, or they stay."""
    if not isinstance(method, (AuxiliaryRays, Distances)):
        return ""
    if isinstance(method, Reparametrised) and not isinstance(integrator.interior, interior.Replay):
        return f"it is beside interior.Replay() alone, got interior.{type(integrator.interior).__name__}()"
    film = camera_view(scene, sensor).camera
    if film.filter == c.RFILTER_BOX and film.filter_radius != 0.5:
        return f"a box filter of the radius {film.filter_radius} overlaps its neighbours; give it 0.5"
    if isinstance(method, AuxiliaryRays):
        return warped_area.refused(scene, config, integrator, method, names, sensor)
    return (
        _of_request(scene, config, integrator, names)
        or _of_camera(scene, config, sensor)
        or _of_light(scene, config)
        or _of_film(scene, config, sensor)
        or _of_shadows(scene, config)
    )


def prepare(scene: Scene, method: Method) -> None:
    """Let a network hold what steps of rays along its distance need, once nothing is refused."""
    if isinstance(method, Distances):
        shape = scene.builder.primitives[0]
        if isinstance(scene.geometry(shape), Network):
            bound_slopes(scene, shape)


def _of_request(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """Say what is asked for beyond one signed distance that moves; empty: nothing."""
    shapes, held = scene.description.shapes, scene.builder.primitives
    if len(held) != 1:
        found = ", ".join(repr(shapes[i].path) for i in held) or "none (say 'exact' of a sphere)"
        return f"expected one shape with a signed distance, got {found}; {INSTEAD}"
    shape = held[0]
    what = _of_shape(scene, shape)
    if what:
        return f"{what}; {INSTEAD}"
    moves = motion(scene, names)
    others = [shapes[i].path for i in sorted(moves.shapes | moves.normals) if i != shape]
    if moves.camera or moves.light_pose or others:
        what = others[0] if others else "the camera" if moves.camera else "a light"
        return f"{what!r} moves, and its edges are not followed; request {shapes[shape].path!r} alone, or {INSTEAD}"
    if not 1 <= integrator.max_depth <= 2:
        return (
            f"max_depth is {integrator.max_depth}, and rays between surfaces are not moved; say max_depth=2 (direct "
            f"light), or {INSTEAD}"
        )
    return ""


def _of_shape(scene: Scene, shape: int) -> str:
    """Say why a shape has no signed distance with a continuous curvature; empty: it has one."""
    s = scene.description.shapes[shape]
    linear, _origin = pose(scene, shape)
    axes = np.linalg.svd(linear, compute_uv=False)
    similar = axes[0] - axes[2] <= SIMILAR * axes[0]
    geometry = scene.geometry(shape)
    if geometry.name == "sphere":
        return "" if similar else f"{s.path!r} is an ellipsoid, whose equation is no distance"
    if not isinstance(geometry, ZeroSet):
        return f"a {s.kind!r} has no signed distance here ({s.path!r})"
    if geometry.device.moves != FLOWS:
        what = "tri-linear grids have no curvature but at their creases, where the divergence of the rays' motion jumps"
        return f"{what} ({s.path!r}): say 'interpolation': 'cubic' and sample its values anew"
    if not similar:
        return f"the pose of {s.path!r} is no similarity, and its values are no distances behind it"
    if isinstance(geometry, Network):
        cells = network_and_cells(scene, shape)[1]
        at, layers = passed_cells(cells), int(np.ceil(FADE * len(cells)))
        if ((at < layers) | (at >= len(cells) - layers)).any():
            return f"the surface of {s.path!r} may reach the border of its box: say more 'cells', or fit it to less"
    else:
        values = grid_values(scene, shape)
        if any((np.take(values, n, axis=axis) <= 0.0).any() for axis in range(3) for n in (0, 1, -2, -1)):
            return f"the surface of {s.path!r} reaches the border of its box: give positive values in two layers there"
    other = in_box(scene, shape, np.zeros(3), np.ones(3))
    return "" if other is None else f"{scene.description.shapes[other].path!r} reaches into the box of {s.path!r}"


def _heights(scene: Scene, shape: int, at: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest height of a shape over a plane, of a grid those of its box."""
    linear, origin = pose(scene, shape)
    if scene.geometry(shape).name == "sphere":
        middle, reach = float((origin - at) @ normal), float(np.linalg.norm(linear, 2))
        return middle - reach, middle + reach
    found = (CORNERS @ linear.T + origin - at) @ normal
    return float(found.min()), float(found.max())


def _of_camera(scene: Scene, config: PathConfig, sensor: int) -> str:
    """Say why a camera's rays cannot move; empty: they can."""
    view = camera_view(scene, sensor)
    shape = scene.builder.primitives[0]
    linear, center = pose(scene, shape)
    local = np.linalg.solve(linear, view.pose[:3, 3] - center)
    within = bool(np.linalg.norm(local) <= 1.0)
    if scene.geometry(shape).name != "sphere":
        within = bool(((local >= 0.0) & (local <= 1.0)).all())
        require_uncut_grids(scene, sensor, [shape])
    else:
        require_uncut(scene, sensor, None)
    if within:
        return f"the camera stands inside of {scene.description.shapes[shape].path!r}; {INSTEAD}"
    return ""


def _of_light(scene: Scene, config: PathConfig) -> str:
    """Say which lights have borders that are not known; empty: none."""
    kinds = {e.kind for e in scene.builder.emitters}
    if not config.scatter or not scene.face_count:
        return ""
    if len(scene.builder.emitters) != 1 or kinds != {c.EMITTER_AREA}:
        return f"beside meshes, expected one area light and no other; {INSTEAD}"
    if scene.builder.radiance_kinds != {c.TEXTURE_CONSTANT}:
        return f"the area light has a texture; give it one radiance, or {INSTEAD}"
    return ""


def _of_film(scene: Scene, config: PathConfig, sensor: int) -> str:
    """Say which edge of a mesh the camera sees; empty: none."""
    if not scene.face_count:
        return ""
    shapes = set(range(len(scene.builder.shapes)))
    found = film_edges(scene, sensor, shapes, camera_moves=True, hide_emitters=config.rays.hidden)
    seen = np.append(found.others.keep, found.flat_creases.keep)
    if len(seen):
        edges = found.edges
        face = int(edges.faces[edges.first[seen[0]]])
        path = scene.description.shapes[int(scene.builder.face_shape[face])].path
        return f"the camera sees an edge of {path!r}, past which rays would move; keep edges off the film, or {INSTEAD}"
    return ""


def _of_shadows(scene: Scene, config: PathConfig) -> str:
    """Say which mesh may hide the light; empty: none."""
    if not config.scatter or not scene.face_count:
        return ""
    b, shapes = scene.builder, scene.description.shapes
    light = int(b.emitters[0].shape)
    points, triangles = scene.points.astype(np.float64), b.indices
    normal = area_normals(points, triangles)
    length = np.linalg.norm(normal, axis=1)
    size = float(np.ptp(points, axis=0).max())
    for face in np.flatnonzero(length > 0.0):
        n, at = normal[face] / length[face], points[triangles[face, 0]]
        shape = int(b.face_shape[face])
        mine = points[triangles[b.face_shape == shape]].reshape(-1, 3)
        if shape == light and np.abs((mine - at) @ n).max() > FLAT * size:
            return f"the light {shapes[shape].path!r} is not flat; take a 'rectangle', or {INSTEAD}"
        if shape == light:
            continue
        height = (points - at) @ n
        low, high = _heights(scene, b.primitives[0], at, n)
        below = min(height.min(), low) < -FLAT * size
        above = max(height.max(), high) > FLAT * size
        if below and above:
            return f"{shapes[shape].path!r} stands between other things, where it may hide the light; {INSTEAD}"
    faces = np.flatnonzero(b.face_shape == light)
    if len(faces) > MOST_TRIANGLES or not _is_convex(points[triangles[faces]]):
        return f"the light {shapes[light].path!r} is no convex shape of a few triangles; take a 'rectangle'"
    return ""


def _is_convex(corners: np.ndarray) -> bool:
    """Return whether flat triangles (F, 3, 3) fill a convex polygon: none reaches beyond an edge that only one has."""
    edges = [(f, corners[f, k], corners[f, (k + 1) % 3]) for f in range(len(corners)) for k in range(3)]
    names = [frozenset((tuple(a), tuple(b))) for _f, a, b in edges]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    least = -FLAT * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    for (f, a, b), name in zip(edges, names, strict=True):
        inwards = np.cross(normal[f], b - a)
        beyond = (corners.reshape(-1, 3) - a) @ (inwards / np.linalg.norm(inwards))
        if names.count(name) == 1 and beyond.min() < least:
            return False
    return True
