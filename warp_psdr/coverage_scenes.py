"""The small scenes that ``psdr.coverage()`` asks the plan about: a shape of a kind, beside an effect, in a request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warp_psdr.options import boundary, guiding, interior
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.scene.transforms import Transform as T

Parts = dict[str, Any]
SIZE = 8
#: Nodes of a grid along each axis, and values of a ball at the nodes.
NODES = 8
BALL = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, NODES)] * 3), axis=-1), axis=-1) - 0.35
#: A box from -0.6 to 0.6 that holds a grid or a network.
BOX = T.translate([-0.6, -0.6, -0.6]) @ T.scale(1.2)
#: Directions of the neurons of a network whose level set is nearly a ball, and what they add up to there.
AXES = np.array([[1.0, 0.1, 0.0], [-0.1, 1.0, 0.15], [0.0, -0.15, 1.0], [0.4, 0.4, 0.4]], np.float32)
NEURONS, LEVEL = np.concatenate([AXES, -AXES]), 1.489
STRAND = np.array([[-0.3, 0.45 * (k - 2), 0.02 * k * k, 0.15] for k in range(5)], np.float32)
ROUGH = {"type": "roughconductor", "alpha": 0.3}


def _rgb(value: float) -> Parts:
    return {"type": "rgb", "value": [value, value, value]}


def _paint(value: float = 0.5) -> Parts:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(value)}}


def _panel(x: float, bsdf: Parts) -> Parts:
    """Return a rectangle beside the shape that faces it and the camera."""
    pose = T.look_at([x, -0.9, 0.6], [0.0, 0.0, -1.0], [0, 1, 0]) @ T.scale(0.5)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf}


def scene() -> Parts:
    """Return what all scenes have: a camera, a wall behind the shape, and a lamp in front of it."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "gaussian"}, "sample_border": True}
    lamp = T.look_at([1.2, 1.5, -2.5], [0.0, 0.0, 0.0], [0, 1, 0]) @ T.scale(0.4)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 45.0, "to_world": T.translate([0.0, 0.0, -4.0]), "film": film},
        "wall": {"type": "rectangle", "to_world": T.translate([0.0, 0.0, 1.6]) @ T.scale(2.5), "bsdf": _paint(0.7)},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": _rgb(9.0)}},
    }


#: Kind of a shape -> its plugin; its values that have derivatives, besides its pose.
KINDS: dict[str, tuple[Parts, str]] = {
    "mesh": ({"type": "cube", "to_world": T.rotate([1, 1, 0], 30) @ T.scale(0.45)}, "vertex_positions"),
    "mesh with vertex normals": ({"type": "sphere", "radius": 0.5, "resolution": 8}, "vertex_positions"),
    "exact sphere": ({"type": "sphere", "radius": 0.5, "exact": True}, ""),
    "exact disk": ({"type": "disk", "to_world": T.rotate([1, 0, 0], 200) @ T.scale(0.5), "exact": True}, ""),
    "exact cylinder": ({"type": "cylinder", "p0": [0, -0.4, 0], "p1": [0, 0.4, 0], "radius": 0.3, "exact": True}, ""),
    "sdfgrid": ({"type": "sdfgrid", "grid": BALL.astype(np.float32), "normals": "analytic", "to_world": BOX}, "grid"),
    "cubic sdfgrid": (
        {"type": "sdfgrid", "grid": BALL.astype(np.float32), "interpolation": "cubic", "to_world": BOX},
        "grid",
    ),
    "neuralsdf": (
        {
            "type": "neuralsdf",
            "beta": 4.0,
            "cells": 16,
            "to_world": BOX,
            "layer0.weight": NEURONS,
            "layer0.bias": -0.5 * NEURONS.sum(axis=1),
            "layer1.weight": np.ones((1, len(NEURONS)), np.float32),
            "layer1.bias": np.array([-LEVEL], np.float32),
        },
        "layer1.weight",
    ),
    "linearcurve": ({"type": "linearcurve", "control_points": STRAND, "curve_starts": [0]}, "control_points"),
    "bsplinecurve": ({"type": "bsplinecurve", "control_points": STRAND, "curve_starts": [0]}, "control_points"),
}


def _film(**more: Any) -> Callable[[Parts], Parts]:
    return lambda parts: parts | {"sensor": parts["sensor"] | {"film": parts["sensor"]["film"] | more}}


def _sensor(**more: Any) -> Callable[[Parts], Parts]:
    return lambda parts: parts | {"sensor": parts["sensor"] | more}


def _with(**more: Parts) -> Callable[[Parts], Parts]:
    return lambda parts: parts | more


def _of_shape(**more: Any) -> Callable[[Parts], Parts]:
    return lambda parts: parts | {"shape": parts["shape"] | more}


def _meter(kind: str) -> Callable[[Parts], Parts]:
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}

    def change(parts: Parts) -> Parts:
        meter = {"type": kind, "film": film}
        if kind == "radiancemeter":
            return parts | {"sensor": meter | {"to_world": T.look_at([0.0, 0.0, -4.0], [0.7, -0.9, 1.6], [0, 1, 0])}}
        return {k: v for k, v in parts.items() if k != "sensor"} | {"wall": parts["wall"] | {"sensor": meter}}

    return change


def _orthographic(parts: Parts) -> Parts:
    pose = T.translate([0.0, 0.0, -4.0]) @ T.scale(1.5)
    return parts | {"sensor": {"type": "orthographic", "to_world": pose, "film": parts["sensor"]["film"]}}


def _alone(parts: Parts) -> Parts:
    """Leave the shape alone under a sky."""
    return {k: v for k, v in parts.items() if k not in ("wall", "lamp")} | {"sky": {"type": "constant"}}


def _fog(kind: str = "homogeneous", **more: Any) -> Parts:
    medium = {"type": kind, "albedo": 0.8, **(more or {"sigma_t": 1.0})}
    pose = T.translate([-0.9, 0.9, 0.3]) @ T.scale(0.3)
    return {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": medium}


BINS = {
    "type": "transient_hdr_film",
    "temporal_bins": 4,
    "bin_width_opl": 2.0,
    "start_opl": 4.0,
    "pulse_width_opl": 0.5,
}
SMOKE = {"type": "gridvolume", "data": np.linspace(0.5, 1.5, 8, dtype=np.float32).reshape(2, 2, 2)}
BITMAP = np.linspace(0.2, 0.8, 12, dtype=np.float32).reshape(2, 2, 3)
TILES = {"type": "checkerboard", "color0": _rgb(0.2), "color1": _rgb(0.7)}
HEIGHTS = {"type": "bumpmap", "arbitrary": {"type": "bitmap", "data": BITMAP, "raw": True}, "bsdf": {"type": "diffuse"}}
TURNED = {
    "type": "normalmap",
    "normalmap": {"type": "bitmap", "data": BITMAP, "raw": True},
    "bsdf": {"type": "diffuse"},
}
#: What a scene may hold besides -> how it comes in.
EFFECTS: dict[str, Callable[[Parts], Parts]] = {
    "media": _with(fog=_fog()),
    "heterogeneous media": _with(fog=_fog("heterogeneous", sigma_t=SMOKE)),
    "mirror": _with(panel=_panel(0.9, {"type": "conductor"})),
    "glass": _with(panel={"type": "sphere", "center": [0.9, -0.9, 0.0], "radius": 0.3, "bsdf": {"type": "dielectric"},
                          "face_normals": True}),
    "rough glass": _with(panel=_panel(0.9, {"type": "roughdielectric", "alpha": 0.3})),
    "mask": _with(panel=_panel(0.9, {"type": "mask", "opacity": 0.5, "bsdf": _paint()})),
    "bump map": _with(panel=_panel(0.9, HEIGHTS)),
    "normal map": _with(panel=_panel(0.9, TURNED)),
    "texture with steps": _with(panel=_panel(0.9, {"type": "diffuse", "reflectance": TILES})),
    "vertex normals": _with(ball={"type": "sphere", "center": [0.9, -0.9, 0.0], "radius": 0.3, "resolution": 8}),
    "point light": _with(bulb={"type": "point", "position": [-1.0, 1.0, -2.0], "intensity": _rgb(5.0)}),
    "directional light": _with(sun={"type": "directional", "direction": [0.3, -0.4, 1.0], "irradiance": _rgb(2.0)}),
    "projector": _with(beam={"type": "projector", "irradiance": {"type": "bitmap", "data": BITMAP},
                             "to_world": T.look_at([-1.0, 1.0, -3.0], [0, 0, 0], [0, 1, 0])}),
    "sky": _with(sky={"type": "constant", "radiance": _rgb(0.5)}),
    "transient film": _film(**BINS),
    "thin lens": _sensor(type="thinlens", aperture_radius=0.05, focus_distance=4.0),
    "lens distortion": _sensor(distortion="opencv", k1=-0.2, k2=0.05, p1=0.002),
    "fisheye": _sensor(distortion="fisheye", k1=0.02),
    "orthographic camera": _orthographic,
    "radiancemeter": _meter("radiancemeter"),
    "irradiancemeter": _meter("irradiancemeter"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Request:
    """What is asked for: a column of the table.

    Attributes:
        of: what of the shape is requested: "pose", "values", "material", "roughness", or "" (an image).
        change: what the scene has for it.
        options: of the integrator.
    """

    of: str
    change: Callable[[Parts], Parts] = lambda parts: parts
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def integrator(self) -> PathIntegrator:
        """Direct light, by the request's methods."""
        return PathIntegrator(**{"max_depth": 2, "caustics": False} | self.options)


def _method(of: str, method: interior.Method, **options: Any) -> Request:
    change = _of_shape(bsdf=ROUGH) if of == "roughness" else (lambda parts: parts)
    return Request(of, change, {"interior": method} | options)


def _attached(parts: Parts) -> Parts:
    return _of_shape(bsdf=ROUGH)(_alone(parts))


#: Title of a column -> what is asked for.
REQUESTS: dict[str, Request] = {
    "image": Request(""),
    "pose": Request("pose"),
    "values": Request("values"),
    "material": Request("material"),
    "in media": Request("pose", EFFECTS["media"]),
    "in a mirror": Request("pose", EFFECTS["mirror"]),
    "as a mirror": Request("pose", _of_shape(bsdf={"type": "conductor"})),
    "as glass": Request("pose", _of_shape(bsdf={"type": "dielectric"})),
    "as plastic": Request("pose", _of_shape(bsdf={"type": "plastic"})),
    "as a light": Request("pose", _of_shape(emitter={"type": "area", "radiance": _rgb(2.0)})),
    "transient film": Request("pose", EFFECTS["transient film"]),
    "vertex normals": Request("pose", EFFECTS["vertex normals"]),
    "guided": Request("pose", options={"boundary": boundary.PathSpace(guiding=guiding.KdTree())}),
    "Projective": Request("pose", options={"boundary": boundary.Projective()}),
    "EdgeSampling": Request("pose", options={"boundary": boundary.EdgeSampling()}),
    "WarpedArea": Request("pose", options={"boundary": boundary.WarpedArea()}),
    "SignedDistance": Request("pose", _alone, {"boundary": boundary.SignedDistance()}),
    "Textbook": _method("pose", interior.Textbook()),
    "Radiative": _method("pose", interior.Radiative()),
    "FilmAntithetic": _method("pose", interior.FilmAntithetic()),
    "Antithetic": Request("pose", _of_shape(bsdf=ROUGH), {"interior": interior.Antithetic(), "boundary": None}),
    "LightTracing": _method("material", interior.LightTracing()),
    "Bidirectional": _method("material", interior.Bidirectional()),
    "Resampled": _method("roughness", interior.Resampled()),
    "Decomposed": _method("roughness", interior.Decomposed()),
    "Attached": Request("roughness", _attached, {"interior": interior.Attached(bsdf="attached", weights="attached")}),
}


def names_of(request: Request, values: str) -> list[str] | None:
    """Return the parameters that a request differentiates by; None: the shape has none of that kind."""
    if request.of == "":
        return []
    if request.of == "values":
        return [f"shape.{values}"] if values else None
    if request.of == "material":
        return ["shape.bsdf.reflectance.value"]
    return ["shape.bsdf.alpha.value"] if request.of == "roughness" else ["shape.to_world"]
