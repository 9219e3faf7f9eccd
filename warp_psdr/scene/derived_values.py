"""Derived values from their sources, and back: poses to vertices and to inverses, positions to vertex normals.

The rendering kernels know only vertex positions and normals, and the inverse of a volume's pose. Reverse mode pulls
their gradients back to the sources. Forward mode pushes the tangents of the sources on before the kernels run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.shape.normals import (
    normalization_jvp,
    normalization_vjp,
    normalize_sums,
    sum_normals,
    sum_normals_jvp,
    sum_normals_vjp,
)
from warp_psdr.kernels.shape.transform import add_pose, pose_shape_jvp, pose_shape_vjp
from warp_psdr.scene.layout import SHAPE_POSE
from warp_psdr.scene.lights.sunsky import pull_sky, push_sky, sky_ranges
from warp_psdr.scene.media.volume_pose import INVERSE, of, pull_poses, push_poses

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def sum_of_normals(
    scene: Scene, positions: int, indices: wp.array, face: int, faces: int, vertex: int, vertices: int, normals: int
) -> wp.array:
    """Return the unnormalised normals of vertices.

    Args:
        scene: the scene.
        positions: flat offset of the position of vertex 0.
        indices: vertices of triangles, flat.
        face: the first triangle.
        faces: how many.
        vertex: the first vertex.
        vertices: how many.
        normals: flat offset where the unit normals are written; -1: they are not.
    """
    sums = wp.zeros(3 * vertices, dtype=wp.float32, device=scene.device)
    inputs = [scene.values, positions, indices, face, vertex]
    launch(sum_normals, dim=faces, inputs=inputs, outputs=[sums], device=scene.device)
    if normals >= 0:
        launch(normalize_sums, dim=vertices, inputs=[sums, normals], outputs=[scene.values], device=scene.device)
    return sums


def derived_ranges(scene: Scene, names: list[str]) -> list[tuple[int, int]]:
    """Flat (offset, size) of what is derived and whose gradients ``pull_derived`` reads."""
    return _geometry_ranges(scene, names) + [(p.inverse, INVERSE) for p in of(scene, names)] + sky_ranges(scene, names)


def _geometry_ranges(scene: Scene, names: list[str]) -> list[tuple[int, int]]:
    """Flat (offset, size) of the vertices and normals among them."""
    ranges = []
    for shape in scene.derived_normals(names):
        record = scene.builder.shapes[shape]
        ranges.append((record.normal_offset + 3 * record.first_vertex, 3 * record.vertex_count))
    for shape in sorted({*_posed(scene, names), *scene.instances.following(names)}):
        _to_world, positions, normals = scene.poses.offsets(shape)
        size = 3 * scene.builder.shapes[shape].vertex_count
        ranges.append((positions, size))
        if normals >= 0:
            ranges.append((normals, size))
    return ranges


def pull_kernels(scene: Scene, names: list[str]) -> list[wp.Kernel]:
    """Return kernels of the modules that ``pull_derived`` launches from."""
    return [normalization_vjp] if _geometry_ranges(scene, names) else []


def pull_derived(scene: Scene, names: list[str], grad: wp.array) -> None:
    """Add the gradients of poses and positions that arrive through derived vertices and normals.

    Args:
        scene: the scene.
        names: requested parameters.
        grad: flat gradients, in place.
    """
    device = scene.device
    pull_poses(scene, names, grad)
    pull_sky(scene, names, grad)
    _pull_normals(scene, names, grad)
    # Poses after normals that are computed from positions: a pose moves the positions, and these normals follow.
    for shape in _posed(scene, names):
        record = scene.builder.shapes[shape]
        vertices, normals = scene.poses.local(shape)
        offsets = scene.poses.offsets(shape)
        pose = wp.zeros((3, 4), dtype=wp.float64, device=device)
        launch(
            pose_shape_vjp,
            dim=record.vertex_count,
            inputs=[scene.values, vertices, normals, *offsets, grad],
            outputs=[pose],
            device=device,
        )
        launch(add_pose, dim=(3, 4), inputs=[pose, offsets[0]], outputs=[grad], device=device)
    scene.instances.pull(names, grad)


def _pull_normals(scene: Scene, names: list[str], grad: wp.array) -> None:
    """Add the gradients of positions that arrive through normals that are computed from them."""
    for shape in scene.derived_normals(names):
        record = scene.builder.shapes[shape]
        sums = scene.normal_sums(shape, write=False)
        adjoint = wp.zeros_like(sums)
        launch(
            normalization_vjp,
            dim=record.vertex_count,
            inputs=[sums, grad, record.normal_offset + 3 * record.first_vertex],
            outputs=[adjoint],
            device=scene.device,
        )
        launch(
            sum_normals_vjp,
            dim=record.face_count,
            inputs=[scene.values, scene.positions, scene.indices, record.first_face, record.first_vertex, adjoint],
            outputs=[grad],
            device=scene.device,
        )


def accumulate_derived(scene: Scene, names: list[str], tangent: wp.array) -> None:
    """Add the tangents of vertices and normals that follow the named poses and positions.

    Args:
        scene: the scene.
        names: parameters with a tangent.
        tangent: flat tangents, in place.
    """
    device = scene.device
    push_poses(scene, names, tangent)
    push_sky(scene, names, tangent)
    # In the order opposite to the above.
    scene.instances.push(names, tangent)
    for shape in _posed(scene, names):
        record = scene.builder.shapes[shape]
        vertices, normals = scene.poses.local(shape)
        launch(
            pose_shape_jvp,
            dim=record.vertex_count,
            inputs=[scene.values, vertices, normals, *scene.poses.offsets(shape)],
            outputs=[tangent],
            device=device,
        )
    for shape in scene.derived_normals(names):
        record = scene.builder.shapes[shape]
        sums = scene.normal_sums(shape, write=False)
        sums_tangent = wp.zeros_like(sums)
        launch(
            sum_normals_jvp,
            dim=record.face_count,
            inputs=[scene.values, scene.positions, scene.indices, record.first_face, record.first_vertex, tangent],
            outputs=[sums_tangent],
            device=device,
        )
        launch(
            normalization_jvp,
            dim=record.vertex_count,
            inputs=[sums, sums_tangent, record.normal_offset + 3 * record.first_vertex],
            outputs=[tangent],
            device=device,
        )


def _posed(scene: Scene, names: list[str]) -> list[int]:
    return sorted({s for n in names if SHAPE_POSE in scene.parameters[n].uses for s in scene.parameters[n].owners})
