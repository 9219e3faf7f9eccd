"""Images of what the camera sees first: depth, position, normals and so on, Mitsuba's ``aov`` integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.arguments import checked_seed, sample_count
from warp_psdr.estimate.passes import STREAM_PRIMAL, Progress, visible
from warp_psdr.estimate.views import count_of_views, each, shape_of_views, whole
from warp_psdr.invalid import warns
from warp_psdr.kernels.aov import CHANNELS
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.plan.plan import decide
from warp_psdr.scene.aovs import check_type, parse_aovs
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


@warns
def render_aov(
    scene: Scene,
    aovs: str | Sequence[str] | Mapping[str, str] | None = None,
    *,
    sensor: Sensor = 0,
    spp: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, wp.array]:
    """Render properties of the surfaces that the camera sees, averaged under the pixel filter; 0 where it sees none.

    They are not differentiable. Numbers of shapes and triangles are averaged too, so they are whole only in pixels that
    see one: take a narrow box filter, or one sample.

    Args:
        scene: a loaded scene.
        aovs: what is wanted: types (``["depth", "sh_normal"]``), names with their types (``{"dd.y": "depth"}``), or
            Mitsuba's list (``"dd.y:depth,nn:sh_normal"``); default: what the ``aov`` integrator of the scene's file
            lists. The types are

            * ``depth``: distance from the near clip plane along the ray, world units;
            * ``position``: world units;
            * ``uv``: texture coordinates, without such the triangle's barycentrics;
            * ``geo_normal``, ``sh_normal``: unit, turned by ``flip_normals``;
            * ``dp_du``, ``dp_dv``: derivatives of the position;
            * ``albedo``: diffuse reflectance, or pi times what is scattered along the normal;
            * ``prim_index``, ``shape_index``: of the triangle in its shape, and of the shape in the scene;
            * ``mask``: share of the pixel that sees a surface.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits.
        progress: called with the finished fraction.

    Returns:
        name -> ``wp.array2d``, shape (H, W) of the crop window, or (B, H, W) of a list of sensors, of float32, vec2
            (``uv``) or vec3.

    Raises:
        ValueError: nothing or an unknown type is asked for, or an option is out of range.
    """
    check_loaded(scene)
    wanted = _wanted(scene, aovs)
    views, seed = scene.description.views(sensor), checked_seed(seed)
    if views.several:
        spp = count_of_views(scene, views, spp)
        shape_of_views(scene, views)  # stacks only what has one size
        found_of = [
            render_aov(scene, wanted, sensor=n, spp=spp, seed=seed, progress=told)
            for n, _place, told in each(scene, views, progress)
        ]
        together = {name: whole(views, [images[name].numpy() for images in found_of]) for name in wanted}
        return {n: wp.array(together[n], dtype=found_of[0][n].dtype, device=scene.device) for n in wanted}
    number = views.sensors[0]
    spp = sample_count(scene, number, spp)
    # At depth 2 a plan asks for the materials, and the camera sees the lights.
    plan = decide(scene, integrator=PathIntegrator(max_depth=2), sensor=number)
    rows = visible(scene, plan, number, spp, mix_seed(seed, STREAM_PRIMAL), progress)
    position, mask = (slice(first, first + size) for first, size in (CHANNELS["position"], CHANNELS["mask"]))
    rows[..., position] += rows[..., mask] * scene.origin
    found = {}
    for name, kind in wanted.items():
        first, size = CHANNELS[kind]
        values = np.ascontiguousarray(rows[..., first : first + size])
        dtype = {1: wp.float32, 2: wp.vec2, 3: wp.vec3}[size]
        found[name] = wp.array(values[..., 0] if size == 1 else values, dtype=dtype, device=scene.device)
    return found


def _wanted(scene: Scene, aovs: str | Sequence[str] | Mapping[str, str] | None) -> dict[str, str]:
    """Return name -> type."""
    if aovs is None:
        aovs = scene.description.integrator.get("aovs")
    if isinstance(aovs, str):
        aovs = parse_aovs(aovs, "aovs") if ":" in aovs else [aovs]
    if not aovs:
        raise ValueError(
            "aovs: got none, and the scene names no 'aov' integrator; give types such as ['depth', 'sh_normal']"
        )
    wanted = dict(aovs) if isinstance(aovs, Mapping) else {kind: kind for kind in aovs}
    for kind in wanted.values():
        check_type(kind, "aovs")
    return wanted
