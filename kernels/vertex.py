"""The records of paths: the configuration that their kernels are compiled for, their states and their vertices."""

from dataclasses import dataclass, replace

import warp as wp

from warp_psdr.kernels.bsdf.record import Slot
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import CAMERA_PERSPECTIVE
from warp_psdr.kernels.structs import Camera


@dataclass(frozen=True)
class MediaConfig:
    """What the media of a scene need compiled."""

    #: Phase functions (PHASE_*) that occur.
    phases: tuple[int, ...]
    #: Some extinction coefficient is a colour.
    chromatic: bool
    #: Some media are ``heterogeneous``.
    grids: bool = False
    #: Some media emit light.
    emissive: bool = False


@dataclass(frozen=True)
class SurfaceConfig:
    """What the surfaces of a scene need compiled."""

    #: Scattering models, keys as ``bsdf.dispatch.ordered`` sorts them; their places are their numbers.
    bsdfs: tuple[str, ...]
    #: Values of the materials and the kinds of their textures, in the order of ``Scene.slots``.
    material: tuple[Slot, ...]
    two_sided: bool
    smooth: bool
    flat: bool
    uv: bool
    tangent: bool
    #: Some texture jumps inside of triangles (``texture/steps.py``).
    steps: bool = False
    #: Numbers of the kinds of shapes without triangles (``primitive/table.py``).
    primitives: tuple[int, ...] = ()


@dataclass(frozen=True)
class LightConfig:
    """What the lights of a scene need compiled."""

    #: Texture kinds of area lights; empty: there are none.
    area: tuple[int, ...]
    #: Other light sources.
    others: tuple[int, ...]
    #: True: there is no other than emitter 0.
    one_light: bool
    hide_emitters: bool
    #: Kinds of shapes without triangles that shine (``primitive/shining.py``).
    shining: tuple[int, ...] = ()


@dataclass(frozen=True)
class RayConfig:
    """What ray queries need compiled, beside the kinds of shapes without triangles (``visibility.py``)."""

    backend: str
    width: int
    #: True: there are area lights, which the camera does not see (``visibility.py``).
    hidden: bool = False


@dataclass(frozen=True)
class PathConfig:
    """What a scene needs compiled; frozen and hashable, one kernel per value.

    A factory that reads one or two of its groups takes these alone, so that its signature says what it may read; what
    traces whole paths takes all.
    """

    surfaces: SurfaceConfig
    lights: LightConfig
    rays: RayConfig
    #: False: ``max_depth`` is 1 and only directly visible light is computed.
    scatter: bool
    sampler: str
    filter: int
    #: Kind of the camera.
    camera: int = CAMERA_PERSPECTIVE
    #: True: what a sample meets is written down (``notes.py``).
    noted: bool = False
    #: True: shadow rays pass surfaces by their null lobes, which keep a path's density (``transmittance.py``).
    through: bool = False
    #: True: only those to point, spot and directional lights do, where vertices move: no path finds their light.
    points_pass: bool = False
    #: True: of the camera's first surface only delta lobes count, for the rest is the light paths' (``light_path.py``).
    delta_first: bool = False
    #: True: of light paths those count that leave lights of no area, and that a mirror or glass turns before a smooth
    #: lobe does: what no path from the camera finds (``light_path.py``).
    caustics: bool = False
    #: Of bidirectional paths (``bidirectional_path.py``): "light" joins light paths to the camera, "all" to its paths
    #: too; empty: none are.
    connections: str = ""
    #: Most vertices of such a path, where all of it is kept.
    most_vertices: int = 0
    #: Participating media, whose paths are those of ``path_media.py``; None: there are none.
    media: MediaConfig | None = None
    #: True: the camera's first vertices are material points, whose images move (``interior/film_antithetic.py``).
    material_first: bool = False
    #: Of a transient film, the kind of its pulse (PULSE_*, ``sensor/time_gate.py``); 0: the film has no time bins.
    pulse: int = 0
    #: Of an image of what the camera sees first, the property that it shows (``property.py``); empty: radiance.
    shown: str = ""

    def unlit(self) -> "PathConfig":
        """Return the same without lights, for paths that bring no radiance."""
        return replace(self, lights=replace(self.lights, area=(), others=()))


@wp.struct
class PathState:
    """What one vertex hands to the next."""

    alive: wp.int32
    depth: wp.int32
    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32
    throughput: wp.vec3
    pdf: wp.float32  # solid angle, of d; 0: no next-event estimate could have found what d hits
    eta: wp.float32  # product of relative refractive indices
    left_face: wp.int32  # face that d left by a smooth lobe, from one; 0: none
    touched_requested: wp.int32  # more than 0: the path has met a shape that matters
    #: At depth 0 what the camera's ray meets, where ``camera_rays.py`` has traced it. Behind null lobes that keep the
    #: density, its ``t`` is the distance from where d was drawn to o.
    seen: RayHit


@wp.func
def path_from(o: wp.vec3, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> PathState:
    """A path that starts with a ray, behind ``depth`` vertices."""
    state = PathState()
    state.alive = 1
    state.depth = depth
    state.o = o
    state.d = d
    state.t_max = t_max
    state.throughput = wp.vec3(1.0, 1.0, 1.0)
    state.eta = 1.0
    return state


@wp.struct
class PathVertex:
    """A path vertex and what was sampled there; enough to recompute every factor without tracing a ray."""

    face: wp.int32  # -1: the ray left the scene
    u: wp.float32
    v: wp.float32
    previous_face: wp.int32  # face that the ray which found it left by a smooth lobe, -1: none
    o: wp.vec3  # where that ray started
    d: wp.vec3  # and its direction
    throughput: wp.vec3  # product of the beta before this vertex
    direct: wp.vec3  # E_n + D_n
    beta: wp.vec3
    e_weight: wp.float32  # MIS weight of the emission hit
    light: wp.int32  # emitter found by next-event estimation, -1: none, or occluded
    light_face: wp.int32
    light_u: wp.float32
    light_v: wp.float32
    light_wi: wp.vec3
    light_weight: wp.float32  # MIS weight / pdf
    lobe: wp.int32
    wo: wp.vec3
    inv_pdf: wp.float32  # 1 / (pdf q)


@wp.func
def film_position(camera: Camera, px: wp.int32, py: wp.int32, offset: wp.vec2) -> wp.vec2:
    """Film coordinates in [0, 1]^2 of a point near the centre of a pixel of the crop window."""
    return wp.vec2(
        (wp.float32(px + camera.crop_x) + 0.5 + offset[0]) / wp.float32(camera.width),
        (wp.float32(py + camera.crop_y) + 0.5 + offset[1]) / wp.float32(camera.height),
    )
