"""Images of what the camera sees first: depth, position, normals and so on, Mitsuba's ``aov`` integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import active_tape, launch
from warp_psdr.estimate.arguments import checked_seed, sample_count
from warp_psdr.estimate.passes import STREAM_PRIMAL, Progress, visible
from warp_psdr.estimate.views import count_of_views, each, shape_of_views, whole
from warp_psdr.invalid import warns
from warp_psdr.kernels.aov import CHANNELS
from warp_psdr.kernels.films import give_channel, take_channel
from warp_psdr.kernels.property import PROPERTIES
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import AovIntegrator, PathIntegrator
from warp_psdr.plan.plan import decide
from warp_psdr.render import render
from warp_psdr.scene.aovs import check_type, parse_aovs
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.scene.parameters import check_owner

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


@warns
def render_aov(
    scene: Scene,
    aovs: str | Sequence[str] | Mapping[str, str] | None = None,
    *,
    params: Parameters | None = None,
    sensor: Sensor = 0,
    spp: int | None = None,
    seed: int = 0,
    tape: wp.Tape | None = None,
    progress: Progress | None = None,
) -> dict[str, wp.array]:
    """Render properties of the surfaces that the camera sees, averaged under the pixel filter; 0 where it sees none.

    On a tape, ``mask``, ``depth``, ``position`` and ``sh_normal`` have derivatives by what ``params`` requests, moving
    silhouettes included, as images of ``psdr.AovIntegrator`` have: for losses on silhouettes, depths and normals.
    Numbers of shapes and triangles are averaged too, so they are whole only in pixels that see one: take a narrow box
    filter, or one sample.

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
        params: parameters of the scene, after ``requires_grad``; needed with a tape only.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits.
        tape: a Warp tape to record on, as of ``render``; in a tape's ``with`` block that tape, if ``params`` requests
            something.
        progress: called with the finished fraction.

    Returns:
        A dictionary, name -> ``wp.array2d``, shape (H, W) of the crop window, or (B, H, W) of a list of sensors, of
            float32, vec2 (``uv``) or vec3.

    Raises:
        ValueError: nothing or an unknown type is asked for, an option is out of range, or with a tape a type without
            derivatives.
    """
    check_loaded(scene)
    wanted = _wanted(scene, aovs)
    if params is not None:
        check_owner(scene, params)
        if tape is None and params.requested:
            tape = active_tape()
    if tape is not None:
        options = {"sensor": sensor, "spp": spp, "seed": seed}
        return {name: _differentiable(scene, params, kind, tape, progress, options) for name, kind in wanted.items()}
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


def _differentiable(
    scene: Scene, params: Parameters | None, kind: str, tape: wp.Tape, progress: Progress | None, options: dict
) -> wp.array:
    """Return a property that is recorded on a tape; the channels of a mask or a depth are one."""
    if kind not in PROPERTIES:
        raise ValueError(
            f"aovs: {kind!r} has no derivatives; on a tape take {', '.join(map(repr, PROPERTIES))}, and the others in "
            "a call without params"
        )
    integrator = AovIntegrator(aov=kind)  # type: ignore[arg-type]
    image = render(scene, params, integrator=integrator, tape=tape, progress=progress, **options)
    if kind not in ("mask", "depth"):
        return image
    found = wp.zeros(image.shape, dtype=wp.float32, device=scene.device, requires_grad=True)
    flat = [array.reshape((image.shape[0], image.size // image.shape[0])) for array in (image, found)]
    launch(take_channel, dim=flat[0].shape, inputs=flat[:1], outputs=flat[1:], device=scene.device)

    def backward() -> None:
        adjoints = [array.grad.reshape(flat[0].shape) for array in (found, image)]
        launch(give_channel, dim=flat[0].shape, inputs=adjoints[:1], outputs=adjoints[1:], device=scene.device)

    tape.record_func(backward, [found, image])
    return found
