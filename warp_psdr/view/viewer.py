"""Scenes and gradient fields in 3D, drawn with pyvista.

``view`` looks named parameters up in a scene, turns their gradients into fields (``warp_psdr.view.fields``) and draws
them, a panel a kind of parameter. Signed values have the look of ``warp_psdr.plots``: white is zero, red positive, blue
negative, the range is clipped and the panel says where. pyvista is loaded on the first call.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from warp_psdr.plots import (
    Reduce,
    as_array,
    clip_text,
    diverging_colormap,
    symmetric_limit,
    tonemap,
    write_picture,
)
from warp_psdr.scene.description import SceneDescription, SensorDescription, ShapeDescription, TextureDescription
from warp_psdr.scene.materials.bsdfs import lets_through, model_of
from warp_psdr.view.fields import Arrows, Field, arrows, environment_field, mesh_field, texture_field, vertex_normals
from warp_psdr.view.panels import Labels, arrangement, color_table
from warp_psdr.view.surfaces import (
    Surface,
    own_fields,
    surface_of,
    value_now,
)
from warp_psdr.view.view import View
from warp_psdr.view.volume_fields import volume_field, volumes_of
from warp_psdr.view.vtk_window import import_pyvista

_BACKGROUND = (0.86, 0.87, 0.88)  # not white, which means zero
_PLAIN = (0.72, 0.72, 0.72)  # surfaces that carry no field, beside surfaces that do
_LIGHT = (1.0, 0.85, 0.35)
_METAL = (0.75, 0.75, 0.78)
_GLASS = (0.70, 0.82, 0.90)
#: Radius of the sphere that shows an environment, in radii of the scene.
_ENVIRONMENT = 1.8


#: Last part of a parameter's name -> its unit, where it is not 1.
_UNITS = {
    "vertex_positions": "world unit",
    "vertex_texcoords": "unit of u or v",
    "vertex_normals": "unit of the normal",
    "control_points": "world unit",
}


class NotDrawableError(ValueError):
    """A parameter has no look on a surface."""


def view(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    fields: str | Sequence[str] | Mapping[str, Any] | None = None,
    screenshot: str | os.PathLike | None = None,
    camera: int | None = 0,
    show_emitters: bool = True,
    window_size: tuple[int, int] = (1024, 768),
    percentile: float = 99.0,
    reduce: Reduce = "mean",
) -> View:
    """Draw a scene, and gradients on its surfaces.

    Positions and normals are drawn as arrows (the direction in which the value grows) and as the component along the
    vertex normal, control points of curves on their tubes, values of grids of signed distances on their surface (how
    the value grows as it moves outwards), poses of shapes and weights of networks as the motion of their surface in a
    step along the gradient; arrows shorter than two of their standard deviations (``render_backward(errors=True)``) are
    grey; textures through their texture coordinates; attributes,
    constants and the two texture coordinates as colours; coefficients of media on the shapes that bound them, voxels as
    their sums along each axis, on planes through the middle of their box; environment maps on a sphere around the
    scene, seen from outside in two panels, towards and against the camera's direction. Parameters of one kind, such as
    the positions of all shapes, share a panel and a scale.

    Args:
        scene: A scene, or its ``SceneDescription``.
        params: The scene's parameters; current values, where there are any, stand in for those of the description.
        fields: Names of parameters whose ``.grad`` is drawn, or a mapping from names to arrays of the parameters'
            shapes. None: the scene alone, in its materials' colours.
        screenshot: PNG file to write; draws off-screen.
        camera: Number or id of the sensor to look through (principal point and crop are ignored); None: from outside.
        show_emitters: Draw area lights, and markers for point, spot and directional lights.
        window_size: Width and height in pixels of all panels together; titles and colour bars stand beside them and
            add to it.
        percentile: Of the non-zero magnitudes of a panel; its colour range and arrows end there.
        reduce: How colours become one signed value: the "mean" of the channels or their "luminance".

    Returns:
        The view, with all methods of its ``pyvista.Plotter``: ``show()`` opens a window where there is a display,
        ``close()`` ends it. ``html(path)`` writes a file that shows it in a browser, to be turned by the mouse; it
        needs ``pip install 'warp-psdr[html]'``. As the last value of a notebook's cell it shows itself: so, or as a
        picture where that package is missing.

    Raises:
        ValueError: A name is unknown or cannot be drawn, has no gradient, or its array has the wrong shape; there is no
            such sensor.
        RuntimeError: VTK cannot draw on this machine; the message says what to install.
        ModuleNotFoundError: pyvista is missing; the message says how to install it.
    """
    pyvista = import_pyvista()
    description: SceneDescription = getattr(scene, "description", scene)
    sensor = (
        description.sensors[description.camera_number(camera)] if camera is not None and description.sensors else None
    )
    values = dict(params) if params is not None else {}
    surfaces = [surface_of(values, shape) for shape in description.shapes]
    center, radius = _bounds(surfaces)
    panels = _panels(description, values, surfaces, _named_arrays(params, fields), _deviations(params, fields),
                     center, radius, reduce)  # fmt: skip
    cells, whole = arrangement(len(panels), window_size, labels=bool(panels[0].fields))
    labels = [_labels(panel, percentile) for panel in panels]

    def draw(plotter: Any, number: int) -> None:
        """Draw the scene of a panel in the active renderer."""
        panel, cell = panels[number], cells[number]
        plotter.set_background(_BACKGROUND)
        # One white light beside the camera: the usual warm and cool ones would tint what means zero.
        plotter.add_light(pyvista.Light(light_type="camera light", position=(-0.4, 0.6, 1.0)), only_active=True)
        _draw_shapes(plotter, description, values, surfaces, panel, show_emitters)
        if show_emitters:
            _draw_light_markers(plotter, description, values, center, radius)
        if panel.fields:
            _draw_fields(plotter, panel, percentile)
        _aim(plotter, panel, sensor, values, center, radius, cell.width / cell.height)

    result = View(cells, whole, labels, draw, background=_BACKGROUND, off_screen=screenshot is not None)
    if screenshot is not None:
        write_picture(screenshot, lambda file: file.write(result.png()))
    return result


@dataclass(eq=False)
class _Panel:
    """What one sub-window shows."""

    title: str
    fields: list[tuple[Field, np.ndarray | None, np.ndarray | None]]  #: a field, its vectors, and their normals
    shapes: set[str]  #: paths of the shapes that the fields stand for
    side: Literal["camera", "towards", "against"] = "camera"  #: the last two: an environment, from outside

    @property
    def unit(self) -> str:
        """What the values are per: the unit of the parameter."""
        name = self.title.partition(",")[0]
        for ending, unit in _UNITS.items():
            if name.rpartition("[")[0].endswith(ending) or name.endswith(ending):
                return f"per {unit}"
        light = any(word in name for word in ("radiance", "emitter")) or self.side != "camera"
        return "per W/m²/sr" if light else "per unit of the parameter"


def _named_arrays(params: Mapping[str, Any] | None, fields: Any) -> dict[str, np.ndarray]:
    """Return the arrays to draw by parameter name."""
    if fields is None:
        return {}
    if isinstance(fields, Mapping):
        return {name: as_array(array) for name, array in fields.items()}
    arrays = {}
    for name in [fields] if isinstance(fields, str) else fields:
        if params is None or name not in params:
            raise ValueError(f"no parameter {name!r}; got {'no params' if params is None else sorted(params)}")
        gradient = getattr(params[name], "grad", None)
        if gradient is None:
            raise ValueError(f"{name!r} has no gradient; call params.requires_grad({name!r}) and render_backward first")
        arrays[name] = as_array(gradient)
    return arrays


def _deviations(params: Mapping[str, Any] | None, fields: Any) -> dict[str, np.ndarray]:
    """Return the standard deviations of the gradients to draw, where ``render_backward`` told them."""
    if params is None or fields is None or isinstance(fields, Mapping):
        return {}
    found = {n: getattr(params[n], "std", None) for n in ([fields] if isinstance(fields, str) else fields)}
    return {name: as_array(std) for name, std in found.items() if std is not None}


def _surface_textures(shape: ShapeDescription) -> Iterator[TextureDescription]:
    for side in shape.bsdf.sides:
        yield from side.textures.values()
    if shape.emitter is not None:
        yield shape.emitter.radiance


def _panels(
    description: SceneDescription,
    values: Mapping[str, Any],
    surfaces: list[Surface],
    arrays: dict[str, np.ndarray],
    deviations: dict[str, np.ndarray],
    center: np.ndarray,
    radius: float,
    reduce: Reduce,
) -> list[_Panel]:
    """Find what each named array belongs to, and group by kind of parameter."""
    panels: dict[str, _Panel] = {}
    drawable = set()

    def add(
        name: str, owner: str, field: Field, vectors: np.ndarray | None = None, normals: np.ndarray | None = None
    ) -> None:
        # "vertex_positions", "vertex_color", "reflectance.data": what shapes have in common.
        tail = ".".join(name.split(".")[-2 if name.endswith((".value", ".data")) else -1 :])
        if tail in panels and owner in panels[tail].shapes:
            tail = name  # a second texture of this kind on the same shape, such as its back's
        panel = panels.setdefault(tail, _Panel(name, [], set()))
        if panel.title != name:
            panel.title = f"*.{tail}"
        panel.fields.append((field, vectors, normals))
        panel.shapes.add(owner)

    for shape, (vertices, faces, texcoords) in zip(description.shapes, surfaces, strict=True):
        for name in (f"{shape.path}.vertex_positions", f"{shape.path}.vertex_normals"):
            drawable.add(name)
            if name in arrays:
                vectors = _reshaped(name, arrays[name], (len(vertices), 3))
                normals = vertex_normals(vertices, faces) * (-1.0 if shape.flip_normals else 1.0)
                field = mesh_field(vertices, faces, vectors, vectors=True, normals=normals)
                if name in deviations:
                    length, deviation = (np.linalg.norm(v, axis=1) for v in (vectors, deviations[name]))
                    field = replace(field, unsure=length < 2.0 * deviation)
                add(name, shape.path, field, vectors, normals)
        for name, (size, drawn) in own_fields(values, shape, (vertices, faces, texcoords)).items():
            drawable.add(name)
            if name in arrays:
                add(name, shape.path, *drawn(_reshaped(name, arrays[name], size)))
        name = f"{shape.path}.vertex_texcoords"
        if shape.texcoords is not None:
            drawable.add(name)
            for axis in (0, 1) if name in arrays else ():
                data = _reshaped(name, arrays[name], shape.texcoords.shape)[:, axis]
                add(f"{name}[{'uv'[axis]}]", shape.path, mesh_field(vertices, faces, data))
        for attribute, data in shape.attributes.items():
            name = f"{shape.path}.{attribute}"
            drawable.add(name)
            if name in arrays:
                on: Literal["vertex", "face"] = "vertex" if attribute.startswith("vertex_") else "face"
                data = _reshaped(name, arrays[name], data.shape)
                add(name, shape.path, mesh_field(vertices, faces, data, on=on, reduce=reduce))
        for texture in dict.fromkeys(_surface_textures(shape)):
            if texture.kind in ("mesh_attribute", "volume"):
                continue
            name = texture.parameter
            drawable.add(name)
            if name in arrays:
                data = _reshaped(name, arrays[name], texture.value.shape)
                if texture.kind == "constant":
                    data = np.broadcast_to(data.reshape(1, -1), (len(faces), data.size))
                    add(name, shape.path, mesh_field(vertices, faces, data, on="face", reduce=reduce))
                else:
                    add(name, shape.path, texture_field(vertices, faces, texcoords, data,
                        to_uv=texture.to_uv, wrap=texture.wrap, reduce=reduce))  # fmt: skip
        for volume in volumes_of(shape):
            name = volume.parameter
            drawable.add(name)
            if name in arrays:
                data = _reshaped(name, arrays[name], volume.value.shape)
                if volume.value.ndim == 4:
                    pose = f"{name.removesuffix('.data')}.to_world"
                    add(
                        name,
                        shape.path,
                        volume_field(volume, data, value_now(values, pose, volume.to_world), reduce=reduce),
                    )
                else:
                    data = np.broadcast_to(data.reshape(1, -1), (len(faces), data.size))
                    add(name, shape.path, mesh_field(vertices, faces, data, on="face", reduce=reduce))
    for emitter in description.emitters:
        if emitter.kind not in ("constant", "envmap"):
            continue
        constant = emitter.radiance.kind == "constant"
        name = emitter.radiance.parameter
        drawable.add(name)
        if name in arrays:
            data = _reshaped(name, arrays[name], emitter.radiance.value.shape)
            data = data.reshape(1, 1, -1) if constant else data
            to_world = value_now(values, f"{emitter.path}.to_world", emitter.to_world)
            item = (
                environment_field(data, to_world, center=center, radius=_ENVIRONMENT * radius, reduce=reduce),
                None,
                None,
            )
            panels[f"{name}, towards"] = _Panel(f"{name}, ahead of the camera", [item], set(), "towards")
            panels[f"{name}, against"] = _Panel(f"{name}, behind the camera", [item], set(), "against")
    unknown = sorted(set(arrays) - drawable)
    if unknown:
        known = ", ".join(sorted(drawable))
        raise NotDrawableError(f"cannot draw {', '.join(unknown)} on a surface; drawable here: {known}")
    return list(panels.values()) or [_Panel("", [], set())]


def _reshaped(name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.size != math.prod(shape):
        raise ValueError(f"{name}: got an array of shape {array.shape}; expected {shape}")
    return array.reshape(shape)


def _bounds(surfaces: list[Surface]) -> tuple[np.ndarray, float]:
    """Return centre and radius of a sphere around all shapes."""
    corners = [bound for vertices, *_ in surfaces if len(vertices) for bound in (vertices.min(0), vertices.max(0))]
    if not corners:
        return np.zeros(3), 1.0
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-6)


def _poly_data(vertices: np.ndarray, faces: np.ndarray) -> Any:
    import pyvista

    return pyvista.PolyData.from_regular_faces(np.asarray(vertices, np.float32), np.asarray(faces, np.int64))


def _texture(rgb: np.ndarray, wrap: str) -> Any:
    """Return a pyvista texture of colours in [0, 1], (H, W, 3), first row at v = 0."""
    import pyvista

    texture = pyvista.Texture(np.ascontiguousarray(np.round(255.0 * rgb[::-1]).astype(np.uint8)))
    modes = {"repeat": "REPEAT", "mirror": "MIRRORED_REPEAT", "clamp": "CLAMP_TO_EDGE"}
    texture.wrap = getattr(pyvista.Texture.WrapType, modes[wrap])
    texture.interpolate = False  # interpolated colours would lead from red to blue past violet, not white
    return texture


def _draw_shapes(
    plotter: Any,
    description: SceneDescription,
    values: Mapping[str, Any],
    surfaces: list[Surface],
    panel: _Panel,
    show_emitters: bool,
) -> None:
    """Draw the shapes that carry no field: plain beside fields, in their materials' colours otherwise."""
    for shape, (vertices, faces, texcoords) in zip(description.shapes, surfaces, strict=True):
        if shape.path in panel.shapes or (shape.emitter is not None and not show_emitters):
            continue
        if not len(faces):
            continue
        mesh = _poly_data(vertices, faces)
        look: dict[str, Any] = {"color": _PLAIN}
        texture = shape.bsdf.textures.get("reflectance")
        if shape.emitter is not None:
            look = {"color": _LIGHT, "lighting": False}
        elif panel.fields:
            pass
        elif lets_through(model_of(shape.bsdf)):
            look = {"color": _GLASS, "opacity": 0.4, "specular": 0.5}
        elif texture is None:
            look = {"color": _METAL, "specular": 0.5}
        elif texture.kind == "constant":
            data = as_array(value_now(values, f"{texture.path}.value", texture.value))
            look = {"color": tuple(tonemap(data.reshape(1, 1, -1))[0, 0])}
        elif texture.kind == "bitmap" and texcoords is not None:
            data = as_array(value_now(values, f"{texture.path}.data", texture.value)).reshape(texture.value.shape)
            field = texture_field(mesh.points, faces, texcoords, data[..., 0], to_uv=texture.to_uv)
            mesh = _poly_data(field.vertices, field.faces)
            mesh.active_texture_coordinates = np.asarray(field.uvs, np.float32)
            look = {"texture": _texture(tonemap(data), texture.wrap)}
        elif texture.kind == "mesh_attribute":
            data = as_array(value_now(values, f"{shape.path}.{texture.attribute}", shape.attributes[texture.attribute]))
            data = data.reshape(shape.attributes[texture.attribute].shape)
            look = {"scalars": np.round(255.0 * tonemap(data[:, None])[:, 0]).astype(np.uint8), "rgb": True}
        else:  # a checkerboard, a volume, or a bitmap on a tube
            read = [leaf.value for leaf in texture.leaves if leaf.value.size]
            held = [np.broadcast_to(value.reshape(-1, value.shape[-1]).mean(axis=0), 3) for value in read]
            data = np.mean(held, axis=0).astype(np.float32) if held else np.full(3, 0.5, np.float32)
            look = {"color": tuple(tonemap(data.reshape(1, 1, -1))[0, 0])}
        plotter.add_mesh(mesh, ambient=0.3, diffuse=0.7, show_scalar_bar=False, **look)


def _labels(panel: _Panel, percentile: float) -> Labels | None:
    """Return what stands beside a panel: nothing beside a scene alone."""
    if not panel.fields:
        return None
    scalars, limit, longest = _limits(panel, percentile)
    quantity = ", ".join(part for part in (panel.unit, panel.fields[0][0].quantity) if part)
    arrow = "" if longest is None else f"; longest arrow: {longest:.3g}"
    return Labels(panel.title, (quantity, clip_text(scalars, limit) + arrow), limit, color_table(limit))


def _limits(panel: _Panel, percentile: float) -> tuple[np.ndarray, float, float | None]:
    """Return a panel's values, the end of their colour range, and the longest arrow's magnitude, if there is one."""
    scalars = np.concatenate([field.values.reshape(-1) for field, _, _ in panel.fields])
    vectors = [np.linalg.norm(v, axis=1) for _, v, _ in panel.fields if v is not None]
    longest = symmetric_limit(np.concatenate(vectors), percentile) if any(np.any(v > 0.0) for v in vectors) else None
    return scalars, symmetric_limit(scalars, percentile), longest


def _draw_fields(plotter: Any, panel: _Panel, percentile: float) -> None:
    """Draw a panel's fields and arrows on one scale."""
    _, limit, longest = _limits(panel, percentile)
    table = color_table(limit)
    faithful: dict[str, Any] = {"ambient": 0.6, "diffuse": 0.45, "show_scalar_bar": False}  # shaded, but readable
    if panel.side != "camera":
        faithful |= {"lighting": False, "culling": "back"}  # the far half, from inside
    for field, _, _ in panel.fields:
        mesh = _poly_data(field.vertices, field.faces)
        finite = np.where(np.isfinite(field.values), field.values, np.nan)
        if field.on == "texel":
            mesh.active_texture_coordinates = np.asarray(field.uvs, np.float32)
            colors = diverging_colormap()(np.ma.masked_invalid(0.5 + 0.5 * finite / limit))[..., :3]
            plotter.add_mesh(mesh, texture=_texture(colors, field.wrap), **faithful)
        else:
            preference = "point" if field.on == "vertex" else "cell"
            plotter.add_mesh(mesh, scalars=finite.astype(np.float32), preference=preference, cmap=table, **faithful)
    moving = [(field, vector, normals) for field, vector, normals in panel.fields if vector is not None]
    for field, vector, normals in moving if longest is not None else ():
        share = max(160 // len(moving), 20)
        drawn = arrows(field.vertices, vector, normals=normals, unsure=field.unsure, limit=longest, count=share)
        if len(drawn.starts):
            _draw_arrows(plotter, drawn)


def _draw_arrows(plotter: Any, drawn: Arrows) -> None:
    import pyvista

    shape = pyvista.Arrow(tip_length=0.35, tip_radius=0.12, shaft_radius=0.04, tip_resolution=12, shaft_resolution=8)
    for chosen, grey in ((~drawn.unsure, 0.1), (drawn.unsure, 0.65)):
        if np.any(chosen):
            points = pyvista.PolyData(drawn.starts[chosen].astype(np.float32))
            points["vector"] = drawn.vectors[chosen].astype(np.float32)
            glyphs = points.glyph(orient="vector", scale="vector", factor=1.0, geom=shape)
            plotter.add_mesh(glyphs, color=(grey, grey, grey), ambient=0.4, show_scalar_bar=False)


def _draw_light_markers(
    plotter: Any, description: SceneDescription, values: Mapping[str, Any], center: np.ndarray, radius: float
) -> None:
    """Draw a ball for each point light, a cone for spots and projectors, an arrow for directional lights."""
    import pyvista

    for emitter in description.emitters:
        pose = np.asarray(value_now(values, f"{emitter.path}.to_world", np.eye(4) if emitter.to_world is None else
                                 emitter.to_world), dtype=float)  # fmt: skip
        place, direction = pose[:3, 3], pose[:3, 2]
        if emitter.kind == "point":
            position = value_now(values, f"{emitter.path}.position", emitter.position)
            marker = pyvista.Sphere(radius=0.03 * radius, center=position)
        elif emitter.kind in ("spot", "projector"):
            angle = float(emitter.cutoff_angle if emitter.kind == "spot" else 0.5 * emitter.x_fov)
            height = 0.15 * radius  # VTK's cone points along its direction: away from the beam, apex at the light
            marker = pyvista.Cone(center=place + 0.5 * height * direction, direction=-direction, height=height,
                                  angle=angle, resolution=32)  # fmt: skip
        elif emitter.kind == "directional":
            marker = pyvista.Arrow(start=center - 1.2 * radius * direction, direction=direction, scale=0.3 * radius)
        else:
            continue
        plotter.add_mesh(marker, color=_LIGHT, lighting=False)


def _aim(
    plotter: Any,
    panel: _Panel,
    sensor: SensorDescription | None,
    values: Mapping[str, Any],
    center: np.ndarray,
    radius: float,
    aspect: float,
) -> None:
    """Look through the sensor, or at the whole scene or environment from outside."""
    pose, fov = None, 40.0
    if sensor is not None:
        pose = as_array(value_now(values, f"{sensor.path}.to_world", sensor.to_world))
        if sensor.kind != "orthographic":
            fov = float(as_array(value_now(values, f"{sensor.path}.x_fov", sensor.x_fov)).reshape(-1)[0])
    forward, up = (np.array([-0.6, -0.45, -0.66]), np.array([0.0, 1.0, 0.0])) if pose is None else pose[:3, [2, 1]].T
    forward = forward / np.linalg.norm(forward)
    if sensor is None or pose is None or panel.side != "camera":
        extent = radius if panel.side == "camera" else 1.05 * _ENVIRONMENT * radius
        forward = -forward if panel.side == "against" else forward
        angle = math.radians(30.0)
        distance = extent / math.sin(0.5 * angle) / min(aspect, 1.0)
        eye, vertical = center - distance * forward, angle
    else:
        film, half = sensor.film, math.tan(math.radians(0.5 * fov))
        # VTK takes the vertical angle, or half the height; the panel shows at least the film.
        shape = min(aspect, film.width / film.height)
        eye, vertical = pose[:3, 3], 2.0 * math.atan(half / shape)
        if sensor.kind == "orthographic":
            plotter.camera.parallel_projection = True
            plotter.camera.parallel_scale = float(np.linalg.norm(pose[:3, 0])) / shape
    plotter.camera.position = tuple(eye)
    plotter.camera.focal_point = tuple(eye + forward * max(float(np.dot(center - eye, forward)), 0.1 * radius))
    plotter.camera.up = tuple(up)
    plotter.camera.view_angle = math.degrees(vertical)
    plotter.renderer.ResetCameraClippingRange()
