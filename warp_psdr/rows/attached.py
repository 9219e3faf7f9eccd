"""Where attached samples are refused: a moving direction may cross an edge, or the material's directions stay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.model import key_of
from warp_psdr.kernels.bsdf.motion import MOVED_BY, MOVING
from warp_psdr.options import interior
from warp_psdr.options.combinations import EDGES, MOVING_LIGHT, UNMOVED, refused_when
from warp_psdr.scene.layout import MATERIAL, POSITIONS, SHAPE_POSE
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.outlook import sees_others

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Uses of a parameter that holds a roughness.
ROUGHNESS = frozenset(MATERIAL + name for name in MOVED_BY)


def refused_by_attached(method: interior.Method, scene: Scene, names: list[str], _sensor: int) -> str:
    """Return why a combination cannot estimate what is requested in a scene; empty: it can."""
    assert isinstance(method, interior.Attached)
    choice = method.bsdf, method.emitter, method.weights
    moved = [name for name in names if _moves_light(scene, name)]
    row = refused_when(MOVING_LIGHT, *choice)
    if moved and row is not None:
        return f"{method.label} is biased for {', '.join(moved)} ({row.numbers}): {row.reason}"
    if method.bsdf == "detached" and method.weights != "attached":
        return ""
    roughnesses = [name for name in names if scene.parameters[name].uses & ROUGHNESS]
    if not roughnesses:
        read = {s.model for name in names for i in _users(scene, name) for s in scene.description.shapes[i].bsdf.sides}
        known = "".join(f" Of {model!r}, {UNMOVED[model]}." for model in sorted(read & UNMOVED.keys()))
        return (
            f"{method.label} moves what is drawn by the roughness of a 'roughconductor', and no parameter that is "
            f"requested is one.{known} Use interior.Resampled() or interior.Replay()"
        )
    users = {name: _users(scene, name) for name in roughnesses}
    for name, shapes in users.items():
        for shape in shapes:
            other = _other_model(scene, shape, name)
            if other:
                path = scene.description.shapes[shape].path
                return (
                    f"{method.label} moves what a plain 'roughconductor' draws, and {name} is read by {other!r} of "
                    f"shape {path!r}{f' ({UNMOVED[other]})' if other in UNMOVED else ''}; use interior.Resampled() or "
                    "interior.Replay() for it"
                )
    row = refused_when(EDGES, *choice)
    if row is None:
        return ""
    for name, shapes in users.items():
        for shape in shapes:
            crossed = _crossed(scene, shape, name)
            if crossed:
                return f"{method.label} is biased for {name} ({row.numbers}), for {crossed}: {row.reason}"
    return ""


def _moves_light(scene: Scene, name: str) -> bool:
    """Whether a parameter moves a shape that shines, from which light points are drawn."""
    parameter = scene.parameters[name]
    shapes = scene.description.shapes
    moved = parameter.uses & {POSITIONS, SHAPE_POSE}
    return bool(moved) and any(shapes[owner].emitter is not None for owner in parameter.owners)


def _users(scene: Scene, name: str) -> list[int]:
    """Return the shapes whose materials read a parameter, or that own it as an attribute."""
    owners = scene.parameters[name].owners
    return [
        i
        for i, shape in enumerate(scene.description.shapes)
        if i in owners or any(side.reads(name) for side in shape.bsdf.sides)
    ]


def _other_model(scene: Scene, shape: int, name: str) -> str:
    """Return a material of a shape whose directions do not move smoothly and that may read a parameter; empty: none."""
    for side in scene.description.shapes[shape].bsdf.sides:
        attribute = any(leaf.kind == "mesh_attribute" for t in side.textures.values() for leaf in t.leaves)
        if (attribute or side.reads(name)) and key_of(side.model, side.variant, side.children) not in MOVING:
            return side.model
    return ""


def _crossed(scene: Scene, shape: int, name: str) -> str:
    """Return what a direction that moves may cross; empty: it leaves the scene, whatever it is."""
    path = scene.description.shapes[shape].path
    faces = scene.builder.face_shape == shape
    if (interpolated_faces(scene) & faces).any():
        return (
            f"the interpolated normals of {path!r} let directions cross its own surface (give it flat ones, "
            "face_normals)"
        )
    two_sided = scene.description.shapes[shape].bsdf.two_sided
    if sees_others(scene, shape, two_sided):
        return f"rays that leave {path!r} may meet surfaces"
    return ""
