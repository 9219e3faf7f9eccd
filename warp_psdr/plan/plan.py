"""The plan: what a scene, the requested parameters and the integrator call for, and nothing else.

Every decision becomes a compile-time constant of the kernels. What the plan leaves out costs neither run time nor
compile time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, has_delta_lobes, has_null_lobes, models_of
from warp_psdr.kernels.bsdf.mask import explored
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.vertex import LightConfig, PathConfig, RayConfig, SurfaceConfig
from warp_psdr.options import interior
from warp_psdr.options.boundary import Connecting, FilmEdges, Method, PathSpace
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.plan import choice, guiding, long_chains, media, needs, primitives, properties, sheets, steps, transient
from warp_psdr.plan.boundary import choose, edge_of_light, refuse_own_shape, sliding_heights
from warp_psdr.plan.integrator import Integrator, integrator_of
from warp_psdr.plan.light import (
    NOT_FOLLOWED,
    followed_by_camera,
    joined,
    passes,
    shadow_rays_pass,
)
from warp_psdr.plan.motion import motion
from warp_psdr.plan.record import Plan, Plans
from warp_psdr.plan.words import CAMERA_NAMES, EMITTER_NAMES, TEXTURE_NAMES
from warp_psdr.rows import reparametrised
from warp_psdr.rows.table import row_of
from warp_psdr.scene import frames
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.layout import (
    CAMERA,
    LIGHT_POSE,
    LIGHT_RADIANCE,
    MATERIAL,
    MEDIUM,
    NORMALS,
    POSITIONS,
    RADIANCE,
    SHAPE_GRID,
    SHAPE_POSE,
    TEXCOORDS,
    TO_UV,
)
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.scene.parameters import check_owner, parameter_of
from warp_psdr.topology import contacts
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.kinds.tube_overlaps import tube_overlaps

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: What gradients leave out under normal and bump maps.
FLIPPED = "derivatives leave out the jump where a normal turns away from the viewer, and is flipped or black"
HOLD_STILL = "hold the shape and the camera still before it, or use a normal map"
#: Edges in which light ends, and the parameters besides the pose that move them.
EDGES = {
    "spot": ("the hard edge of the cone (beam_width reaches cutoff_angle)", ("cutoff_angle", "beam_width")),
    "projector": ("the edge of the projected image", ("x_fov",)),
}
#: Shapes that a line of the plan names.
NAMED = 3


def plan(
    scene: Scene,
    params: Parameters | None = None,
    *,
    integrator: Integrator | None = None,
    sensor: Sensor = 0,
    names: list[str] | None = None,
) -> Plan | Plans:
    """Decide what is compiled and estimated, and say why.

    Args:
        scene: a loaded scene.
        params: its parameters; those that ``requires_grad`` was asked for are differentiated.
        integrator: as of ``render``; default: the one that the scene file names.
        sensor: which camera (its filter is compiled in), by its number or its id; of a ``batch`` all its cameras;
            several in a list.
        names: what is differentiated, instead of ``params``' requests.

    Returns:
        The plan; of several sensors the ``Plans`` of each.

    Raises:
        KeyError: the scene has no parameter of such a name.
        ValueError: the methods named by the integrator cannot differentiate what is requested.
    """
    check_loaded(scene)
    views = scene.description.views(sensor)
    if views.several:
        each = ((scene.description.sensors[n].path, n) for n in views.sensors)
        return Plans({p: _told(scene, params, integrator, n, names) for p, n in each})
    return _told(scene, params, integrator, views.sensors[0], names)


def _told(
    scene: Scene, params: Parameters | None, integrator: Integrator | None, sensor: int, names: list[str] | None
) -> Plan:
    """Return the plan of one sensor, with lines on shapes in contact and on frames of a tape."""
    decided = decide(scene, params, integrator=integrator, sensor=sensor, names=names)
    moving = motion(scene, _named(scene, params, names)).shapes if decided.boundary else frozenset()
    return replace(decided, lines=(*decided.lines, *contacts.describe(scene, moving), *frames.describe(scene)))


def decide(
    scene: Scene,
    params: Parameters | None = None,
    *,
    integrator: Integrator | None = None,
    sensor: int | str = 0,
    names: list[str] | None = None,
) -> Plan:
    """Return the ``plan`` without what is only told, the shapes in contact: a search over the scene's triangles."""
    integrator = integrator_of(scene, integrator)
    automatic = integrator.interior == "auto"
    method = choice.named(integrator)
    integrator = replace(integrator, interior=method)
    sensor = scene.description.camera_number(sensor)
    names = _named(scene, params, names)
    lines: list[tuple[str, str, str]] = []
    config = _config(scene, integrator, sensor, lines)
    if config.rays.hidden:
        scene.hide_lights()
    wanted = _wanted(scene, config, names, lines) if names else None
    by_camera = followed_by_camera(config, wanted, integrator)
    if by_camera is not None:
        decided = decide(scene, params, integrator=by_camera, sensor=sensor, names=names)
        return replace(decided, lines=(NOT_FOLLOWED, *decided.lines))
    lines += media.describe(scene, config, wanted)
    properties.refuse(scene, config, names, sensor)
    needed = needs.needs(scene, config, wanted)
    needs.refuse(method, needed, names)
    reason = media.beside_motion(scene, config, wanted) or transient.refused(config, integrator, wanted)
    if reason:
        raise ValueError(f"derivatives by {', '.join(names)}: {reason}")
    refuse_own_shape(scene, sensor, names)
    if not names:
        lines.append(("derivatives", "none", "no parameter is requested"))
    if wanted is not None:
        reason = "" if config.shown else sliding_heights(scene, config, names, wanted.geometry)
        if reason:
            raise ValueError(f"{reason}, and the slopes of a bump map jump at its texels: {HOLD_STILL}")
        if any(model.framed for model in models_of(config.surfaces.bsdfs)):
            lines.append(("turned normals", "as they are seen", FLIPPED))
    moving = tuple(_discontinuities(scene, config, names))
    if wanted is not None:
        asked = [slot.name for slot, w in zip(config.surfaces.material, wanted.material, strict=True) if w]
        if any(name.rsplit("_", 1)[-1] == "opacity" for name in asked):
            config = replace(
                config, surfaces=replace(config.surfaces, bsdfs=tuple(map(explored, config.surfaces.bsdfs)))
            )
    passed = config.through
    if passed and media.weighs(config) and wanted is not None and (wanted.geometry or moving):
        # What moves sees null lobes as other delta lobes, whose crossings are path vertices of their own. To lights of
        # no area, which no path hits, shadow rays pass them.
        config = replace(config, through=False, points_pass=sheets.passes(scene, config, integrator, method, names))
        wanted = replace(wanted, shapes=wanted.shapes or config.points_pass)
    if has_null_lobes(config.surfaces.bsdfs):
        ends = "vertices move" if passed else "caustics=False leaves out light of lights of no area behind them"
        said = ("pass surfaces", "by their null lobes") if config.through else ("end at surfaces", ends)
        if config.points_pass:
            said = "pass surfaces", "those of lights of no area, by their null lobes; paths find all other lights"
        lines.append(("shadow rays", *said))
    still = wanted is None or not (wanted.geometry or wanted.lights or moving)
    if still and not config.shown and config.surfaces.smooth and scene.shades_flat:
        config = replace(config, surfaces=replace(config.surfaces, smooth=False, flat=True))
        lines.append(("interpolated normals", "not read", "they are those of the triangles"))
    if (
        wanted is not None
        and isinstance(method, interior.Replay)
        and method.flow == "normal"
        and config.surfaces.primitives
    ):
        primitives.refuse_flow(scene, config)
        kinds = (*config.surfaces.primitives, c.NORMAL_FLOW)
        config = replace(config, surfaces=replace(config.surfaces, primitives=kinds))
        lines.append(("vertices", "flow along normals", "of smooth grids and networks"))
    if isinstance(method, interior.FilmAntithetic) and wanted is not None:
        config = replace(config, material_first=True)
    term, told = _boundary(scene, config, integrator, names, moving, sensor)
    row = kept = None
    offered: tuple[str, ...] = ()
    more: list[tuple[str, str, str]] = []
    if wanted is not None:
        row = row_of(method, term)
        kept = row.keep(method, integrator.max_depth, integrator.rr_depth)
        kept = replace(kept, warp=reparametrised.compiled(term))
        reason = row.refuse(config, wanted) or row.refuse_in(method, scene, names, sensor)
        if reason:
            raise ValueError(reason)
        if automatic and choice.is_on(scene) and not config.pulse:
            offered = choice.offered(config, wanted, term is not None)
        if offered:
            known = choice.known(scene, names, integrator.max_depth)
            more = choice.describe(scene, config, wanted, names, offered, known)
            if known.method is not None:
                row = row_of(known.method, term)
                kept = row.keep(known.method, integrator.max_depth, integrator.rr_depth)
        block = f", K = {kept.block}" if kept.block else ""
        lines.append(("interior", f"{row.label}{block}", "; ".join(filter(None, (kept.reason, kept.bias)))))
    lines += more + told
    shapes = _shapes(scene, names) if config.media is None else None
    if kept is not None and kept.block and kept.warp is None and shapes is not None:
        met = ", ".join(scene.description.shapes[i].path for i in sorted(shapes)[:NAMED])
        met += f" and {len(shapes) - NAMED} more" if len(shapes) > NAMED else ""
        lines.append(("swept", "paths that meet what is requested", met))
    light = None
    if isinstance(method, interior.FROM_LIGHTS):
        light = passes(scene, config, wanted, method, integrator, names)
        config = light.paths
        lines.append(light.line)
    else:
        light, by_glass = joined(scene, config, wanted, integrator, automatic, names, moving, needed)
        lines += by_glass
    return Plan(
        config,
        wanted,
        integrator.max_depth,
        integrator.rr_depth,
        row,
        kept,
        moving,
        tuple(lines),
        term,
        shapes,
        light,
        offered,
        transient.times_of(scene, sensor),
    )


def _boundary(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str], moving: tuple[str, ...], sensor: int
) -> tuple[Method | None, list[tuple[str, str, str]]]:
    """Return the method of the boundary term, if there is any to estimate, and what the plan says of it."""
    if not names:
        return None, []
    if not moving:
        return None, [("boundary term", "not run", "no requested parameter moves a discontinuity")]
    method = choice.named(integrator)
    row = row_of(method, None)
    whole = row.whole
    if whole and row.whole_in(scene, names, sensor):
        if isinstance(integrator.boundary, Method):
            beside = f"boundary.{type(integrator.boundary).__name__}() beside "
            name = type(method).__name__
            raise ValueError(f"{beside}interior.{name}(), whose derivative is whole without it; leave boundary out")
        if row.film(method, config):
            return FilmEdges(), [("boundary term", "of the film alone", whole)]
        return None, [("boundary term", "none", whole)]
    if integrator.boundary is None:
        return None, [("boundary term", "left out", "boundary=None was said, although " + "; ".join(moving))]
    term = choose(scene, config, integrator, names, moving, sensor)
    reparametrised.prepare(scene, term)
    lines = [("boundary term", term.label, "; ".join(moving))]
    moves = motion(scene, names)
    over = tube_overlaps(scene, sensor) if moves.camera or moves.shapes else None
    lines += [over.tell(scene)] if over is not None else []
    repeated = guiding.automatic(scene, moves, sensor, integrator.max_depth)
    learns = repeated.on and not config.pulse
    if integrator.boundary == "auto" and learns and isinstance(term, Connecting):
        if isinstance(term, PathSpace) and repeated.method is not None:
            term = replace(term, guiding=repeated.method)
        lines.append(("guiding", "none" if repeated.method is None else "by itself", repeated.said))
    if isinstance(term, Connecting) and term.guiding is not None:
        lines.append(("guiding", term.guiding.label, guiding.describe(scene, term.guiding)))
    lines += reparametrised.describe(term)
    if config.media is not None:
        lines.append(
            ("boundary term", "in media: volume vertices ride as fractions of rays", "interfaces are no edges")
        )
    if has_chain_lobes(config.surfaces.bsdfs, config.media is not None):
        searched = "through mirrors and glass: line search"
        lines.append(("boundary term", searched, "no edge can be connected to the camera"))
        lines += long_chains.describe(scene, sensor, integrator.max_depth)
    return term, lines


def _named(scene: Scene, params: Parameters | None, names: list[str] | None) -> list[str]:
    if params is not None:
        check_owner(scene, params)
    if isinstance(names, str):
        raise TypeError(f"names: got {names!r}, expected a list of names")
    if names is not None:
        for name in names:
            parameter_of(scene, name)
        return names
    return params.requested if params is not None else []


def _config(scene: Scene, integrator: PathIntegrator, sensor: int, lines: list) -> PathConfig:
    b = scene.builder
    camera = scene.camera(sensor)
    if integrator.shown:
        lines.append(("image", integrator.shown, "what the camera sees first; no light is traced"))
    among_media = bool(b.media) and not integrator.shown
    scatter = integrator.max_depth != 1 or among_media  # surfaces that are not there are met at depth 1 too
    models = (b.models if scatter else ()) or ("diffuse",)
    kinds = {e.kind for e in b.emitters}
    lights = tuple(sorted(kinds - {c.EMITTER_AREA}))
    material = b.material if scatter else ()
    area = tuple(sorted(b.radiance_kinds))
    uv = any(c.READ_TEXCOORDS & set(kinds) for kinds in (*(slot.kinds for slot in material), area))
    bitmap = any(c.TEXTURE_BITMAP in kinds for kinds in (*(slot.kinds for slot in material), area))
    reader = f"a {'bitmap' if bitmap else 'checkerboard'} reads them"
    sampler: str = integrator.sampler
    if sampler == "auto":
        sampler = scene.description.sensors[sensor].sampler
    if sampler == "default":
        sampler = "sobol"
    lines.append(("materials", ", ".join(models), "no dispatch" if len(models) == 1 else "in use"))
    used = [f"{slot.name}: {' or '.join(TEXTURE_NAMES[k] for k in slot.kinds)}" for slot in material if slot.kinds]
    lines.append(("material values", ", ".join(used) or "none", "texture kinds in use"))
    lines.append(("two-sided", "yes" if b.two_sided else "no", "some material is" if b.two_sided else "no material is"))
    meshes = [s for i, s in enumerate(b.shapes) if i not in b.primitives]
    smooth = any(s.smooth for s in meshes)
    flat = any(not s.smooth for s in meshes) or not meshes
    normals = "interpolated and flat" if smooth and flat else "interpolated" if smooth else "flat"
    lines.append(("normals", normals, f"{len(b.shapes)} shapes, {scene.face_count} triangles"))
    lines += primitives.describe(scene)
    lines.append(("texture coordinates", "yes" if uv else "no", reader if uv else "no bitmap is in use"))
    dp_du = "normals are turned" if any(model.framed for model in models_of(models)) else "two roughnesses"
    lines.append(("anisotropy", "yes" if b.anisotropic else "no", dp_du if b.anisotropic else "isotropic"))
    lines.append(
        ("lights", ", ".join(EMITTER_NAMES[k] for k in sorted(kinds)) or "none", f"{len(b.emitters)} in the scene")
    )
    depth = integrator.max_depth
    reason = (
        "no limit" if depth < 0 else "emission only, no scattering code" if depth == 1 else f"at most {depth} vertices"
    )
    lines.append(("depth", str(depth), reason))
    kind = CAMERA_NAMES[camera.kind]
    reason = "two random numbers a sample for the lens" if kind == "thinlens" else "no lens"
    lines.append(("camera", kind, reason + ", rays by Newton's method" * (camera.kind in c.DISTORTED_CAMERAS)))
    times = transient.times_of(scene, sensor)
    lines += transient.describe(times)
    lines.append(("sampler", sampler, "Owen-scrambled, padded pairs" if sampler == "sobol" else "hashed counters"))
    lines.append(("ray queries", scene.accelerator.backend, f"{scene.accelerator.width} lanes"))
    surfaces = SurfaceConfig(
        bsdfs=models,
        material=material,
        two_sided=bool(b.two_sided),
        smooth=smooth,
        flat=flat,
        uv=uv,
        tangent=bool(b.anisotropic) and scatter,
        steps=bool(b.stepped),
        primitives=primitives.kinds(scene),
    )
    lit = LightConfig(
        area=area,
        others=lights,
        one_light=len(b.emitters) == 1,
        hide_emitters=integrator.hide_emitters,
        shining=primitives.shining(scene),
    )
    hidden = integrator.hide_emitters and bool(area)
    return PathConfig(
        surfaces=surfaces,
        lights=lit,
        rays=RayConfig(scene.accelerator.backend, scene.accelerator.width, hidden),
        scatter=scatter,
        sampler=sampler,
        filter=camera.filter,
        camera=camera.kind,
        through=scatter and shadow_rays_pass(scene, integrator, models, lights),
        media=None if integrator.shown else b.media_config,
        pulse=transient.pulse_of(times),
        shown=integrator.shown,
    )


def _wanted(scene: Scene, config: PathConfig, names: list[str], lines: list) -> GradientRequest:
    def has(*uses: str) -> bool:
        return scene.has_use(names, *uses)

    lights = []
    if has(LIGHT_RADIANCE):
        lights.append("radiance")
    if has(LIGHT_POSE):
        lights.append("pose")
    wanted = GradientRequest(
        material=tuple(has(MATERIAL + slot.name) for slot in config.surfaces.material),
        to_uv=has(TO_UV),
        shapes=has(POSITIONS, NORMALS, SHAPE_GRID, SHAPE_POSE),
        texcoords=has(TEXCOORDS),
        radiance=has(RADIANCE),
        lights=tuple(lights),
        camera=has(CAMERA),
        bends=bool(_bending(scene, names)),
        media=tuple(kind for kind in media.PARAMETERS if has(MEDIUM + kind)),
    )
    lines.append(("differentiated", ", ".join(names), "requested"))
    on = [slot.name for slot, w in zip(config.surfaces.material, wanted.material, strict=True) if w]
    lines.append(("material derivatives", ", ".join(on) or "none", "values that hold a requested parameter"))
    geometry = (
        "positions, normals and chains through mirrors and glass are differentiated"
        if wanted.geometry
        else "no requested parameter moves a path vertex"
    )
    lines.append(("moving vertices", "yes" if wanted.geometry else "no", geometry))
    return wanted


def _shapes(scene: Scene, names: list[str]) -> frozenset[int] | None:
    """Return the shapes, none of them a light, on which alone the named parameters act; None: on more than that."""
    found: set[int] = set()
    for name in names:
        parameter = scene.parameters[name]
        if parameter.uses <= {POSITIONS, NORMALS, TEXCOORDS, SHAPE_GRID, SHAPE_POSE}:
            found.update(parameter.owners)
        elif all(use.startswith(MATERIAL) for use in parameter.uses):
            users = [
                i for i, shape in enumerate(scene.description.shapes) for bsdf in shape.bsdf.sides if bsdf.reads(name)
            ]
            if not users:  # an attribute of a mesh
                return None
            found.update(users)
        else:
            return None
    lights = any(scene.description.shapes[i].emitter is not None for i in found)
    return frozenset(found) if names and not lights else None


def _bending(scene: Scene, names: list[str]) -> dict[str, str]:
    """Requested parameters that turn rays at smooth surfaces, and what is seen there: indices, normal and bump maps."""
    found = {}
    for shape in scene.description.shapes:
        for bsdf in shape.bsdf.sides:
            for value in model_of(bsdf).turned_by:
                seen = "through the interface" if value.endswith("ior") else "in a surface with turned normals"
                for t in bsdf.textures[value].leaves:
                    name = f"{shape.path}.{t.attribute}" if t.kind == "mesh_attribute" else t.parameter
                    found |= {held: seen for held in (name, t.scale_parameter) if held in names}
    return found


def _discontinuities(scene: Scene, config: PathConfig, names: list[str]) -> list[str]:
    """Say which requested parameters move a discontinuity of the integrand, and which one."""
    reasons = []
    delta = has_delta_lobes(config.surfaces.bsdfs)
    lights = _moving_lights(scene)
    for name in names:
        uses = scene.parameters[name].uses
        if media.moves_media_alone(scene, name):
            if media.hides(scene):
                reasons.append(f"{name} moves points of a medium past what hides light from them")
            continue
        if uses & {POSITIONS, SHAPE_GRID, SHAPE_POSE}:
            reasons.append(f"{name} moves silhouettes and shadows")
        elif CAMERA in uses and (scene.face_count or config.surfaces.primitives):
            reasons.append(f"{name} moves the silhouettes that the camera sees")
        elif name in lights:
            reasons.append(f"{name} moves {lights[name]}")
        elif NORMALS in uses and delta:
            reasons.append(f"{name} moves what is seen in smooth mirrors and glass")
        elif NORMALS in uses and config.scatter and any(_bent(scene, shape) for shape in scene.parameters[name].owners):
            reasons.append(f"{name} moves the curves where interpolated normals turn away")
        elif steps.slides(scene, name):
            reasons.append(f"{name} slides a texture with steps")
    reasons += [f"{name} moves what is seen {where}" for name, where in _bending(scene, names).items()]
    return reasons


def _bent(scene: Scene, shape: int) -> bool:
    """Whether the interpolated normals of a shape differ from those of its triangles."""
    return bool(interpolated_faces(scene)[scene.builder.face_shape == shape].any())


def _moving_lights(scene: Scene) -> dict[str, str]:
    """Parameters that move the light of a light source, and which discontinuity they move."""
    found: dict[str, str] = {}
    if scene.face_count == 0 and not scene.builder.primitives:
        return found
    for e, record in zip(scene.description.emitters, scene.builder.emitters, strict=True):
        if e.kind in ("point", "spot", "projector", "directional"):
            pose = "sun_direction" if e.sky is not None else "to_world" if e.position is None else "position"
            edge = EDGES[e.kind][0] if edge_of_light(scene, record) else ""
            found[f"{e.path}.{pose}"] = f"hard shadows and {edge}" if edge else "hard shadows"
            if edge:
                found |= {f"{e.path}.{name}": edge for name in EDGES[e.kind][1]}
    return found
