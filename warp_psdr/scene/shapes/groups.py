"""Shapes made of shapes: groups, their instances, and merged shapes.

An instance is flattened on load: each shape of its group is copied to where ``to_world`` puts it. The copies share the
values of the shape in the group: its vertices, in the group's space, have one name, and each instance's matrix has one.
World-space values are derived from both (``derived_values``).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.description import ShapeDescription
from warp_psdr.scene.errors import ReportedError, error, limit
from warp_psdr.scene.kinds.kind import geometry_of
from warp_psdr.scene.origin import moved
from warp_psdr.scene.plugins import Properties
from warp_psdr.scene.shapes import reading as shapes
from warp_psdr.scene.shapes.meshes import MeshData, check
from warp_psdr.scene.transforms import transform_normals, transform_points

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: Triangles of all instances: more than is kept, and more than goes unsaid. Every copy takes memory of its own.
MOST_TRIANGLES, MANY_TRIANGLES = 10**8, 10**7


def build(node: dict, where: str, path: str, context: Context) -> list[ShapeDescription]:
    """Return the shapes that a plugin stands for: one, those of an instance or a merged shape, or none of a group.

    Args:
        node: The dictionary, references resolved.
        where: Its place, for messages.
        path: The name under which its parameters are listed.
        context: The load in progress.

    Raises:
        ValueError: If a parameter or the geometry cannot be used.
        FileNotFoundError: If a file does not exist.
    """
    kind = node["type"]
    if kind == "merge":
        return _merge(Properties(node, where, path, context))
    if kind == "instance":
        return _instance(Properties(node, where, path, context))
    if kind == "shapegroup":
        _group(node, where, path, context)
        return []
    return [shapes.build(node, where, path, context)]


def _merge(props: Properties) -> list[ShapeDescription]:
    """Build the shapes of a merged one, which stay apart and keep their names."""
    found = []
    for key, node, where in props.children("shape", limit=len(props.node)):
        found += build(node, where, _name(node, key), props.context)
    props.finish()
    return found


def _name(node: dict, key: str) -> str:
    """Return the name of a nested shape: its id or, as in Mitsuba, its key."""
    return node["id"] if isinstance(node.get("id"), str) else key


def _group(node: dict, where: str, path: str, context: Context) -> list[ShapeDescription]:
    """Return the shapes of a group, in its own space; the same ones for each of its instances."""
    # Where the group has a name that references use, it is the same wherever they stand.
    names = [name for name, named in context.named.items() if named is node]
    path = str(node.get("id") or (names[0] if names else path))

    def make() -> list[ShapeDescription]:
        props = Properties(node, where, path, context)
        # In the group's space there is no far away.
        origin, context.origin = context.origin, np.zeros(3)
        found: list[ShapeDescription] = []
        try:
            for key, child, place in props.children("shape", limit=len(node)):
                _member(found, child, place, f"{path}.{_name(child, key)}", context)
        finally:
            context.origin = origin
        props.finish()
        alone = next((shape.geometry for shape in found if shape.geometry is not None), None)
        if len(found) > 1 and alone is not None:
            raise error(where, f"{alone.title} beside other shapes of a 'shapegroup'", "give it a group of its own")
        return found

    return context.build(node, where, "shapegroup", make, shared=True)


def _member(found: list[ShapeDescription], node: dict, where: str, path: str, context: Context) -> None:
    """Build a shape of a group."""
    if node["type"] in ("shapegroup", "instance", "merge"):
        raise error(where, f"a '{node['type']}' inside a 'shapegroup'", "put its shapes into the group themselves")
    shape = shapes.build(node, where, path, context)
    if shape.emitter is not None or shape.carried is not None:
        raise error(
            where, "an emitter on a shape of a 'shapegroup'", "instances do not shine: put the shape in the scene"
        )
    if shape.sensor is not None:
        raise error(where, "a sensor on a shape of a 'shapegroup'", "put the shape that measures in the scene")
    if shape.geometry is not None:
        if shape.geometry.outside_groups:
            raise error(where, f"{shape.geometry.title} inside a 'shapegroup'", shape.geometry.outside_groups)
        if shape.to_world is not None and not np.array_equal(shape.to_world, np.eye(4)):
            raise error(where, f"a pose of {shape.geometry.title} inside a 'shapegroup'", "give it to the 'instance'")
        found.append(shape)
        return
    # Its own pose is a part of its vertices.
    found.append(dataclasses.replace(shape, to_world=None, local_vertices=None, local_normals=None))


def _instance(props: Properties) -> list[ShapeDescription]:
    """Copy the shapes of a group to where an instance has them."""
    context = props.context
    to_world = moved(props.transform("to_world"), context.origin)
    nested = props.children("shape")
    props.finish()
    if not nested:
        if props.incomplete:
            raise ReportedError(props.where)
        raise error(props.where, "an 'instance' without a 'shapegroup'", "nest one, or refer to it by its id")
    key, node, where = nested[0]
    if node["type"] != "shapegroup":
        raise error(where, f"an 'instance' of a '{node['type']}'", "give a 'shapegroup' that holds it")
    group = _group(node, where, f"{props.path}.{key}", context)
    _count(group, props)
    if group and group[0].geometry is not None:
        return [_place_alone(group[0], props, to_world)]
    return [_copy(prototype, props, to_world) for prototype in group]


def _place_alone(shape: ShapeDescription, props: Properties, to_world: np.ndarray) -> ShapeDescription:
    """Return the shape without triangles of a group where its only instance has it, under the group's names.

    Raises:
        ValueError: If the group has another instance.
    """
    geometry = geometry_of(shape)
    if shape.path in props.context.placed_shapes:
        problem = f"a second 'instance' of {geometry.title}, of whose values there is one set"
        raise error(props.where, problem, f"give a second '{shape.kind}', in the scene itself or in a group of its own")
    props.context.placed_shapes.add(shape.path)
    vertices = transform_points(to_world, geometry.corners(to_world)).astype(np.float32)
    return dataclasses.replace(shape, vertices=vertices, to_world=to_world.astype(np.float32), instance=props.path)


def _count(group: list[ShapeDescription], props: Properties) -> None:
    """Count what an instance takes before it is made.

    Raises:
        ValueError: If that is too much.
    """
    context = props.context
    before = context.instanced
    context.instanced += sum(len(shape.faces) for shape in group)
    if context.instanced > MOST_TRIANGLES:
        raise limit(
            props.where,
            f"the instances have more than {MOST_TRIANGLES:g} triangles by here, each of them kept",
            "use fewer instances, or simpler shapes",
        )
    if before < MANY_TRIANGLES <= context.instanced:
        context.note(
            f"{props.where}: instances are copies, with more than {MANY_TRIANGLES:g} triangles by here; all are kept"
        )
    context.count(sum(3 * len(s.vertices) * (1 if s.normals is None else 2) + s.faces.size for s in group), props.where)


def _copy(prototype: ShapeDescription, props: Properties, to_world: np.ndarray) -> ShapeDescription:
    """Return the copy of a shape of a group.

    A pose that mirrors turns the triangles over, but not the normals of the group; the triangles are turned back.
    """
    mirrored = bool(np.linalg.det(to_world[:3, :3]) < 0.0)
    name = prototype.path.rsplit(".", 1)[-1]
    with np.errstate(over="ignore"):  # what overflows becomes infinite, which the check reports
        vertices = transform_points(to_world, prototype.vertices).astype(np.float32)
    faces = np.ascontiguousarray(prototype.faces[:, [0, 2, 1]]) if mirrored else prototype.faces
    check(MeshData(vertices, faces), f"{props.where}, after to_world")
    normals = prototype.normals
    return dataclasses.replace(
        prototype,
        path=f"{props.path}.{name}",
        vertices=vertices,
        faces=faces,
        normals=None if normals is None else transform_normals(to_world, normals).astype(np.float32),
        normals_computed=False,  # they follow those of the group
        to_world=to_world.astype(np.float32),
        local_vertices=prototype.vertices,
        local_normals=normals,
        prototype=prototype,
        instance=props.path,
        repairs={},
    )
