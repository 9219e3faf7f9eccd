"""Record and sweep in the plan: the part of a path that is kept, and the kernels beside those of other methods."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.forward import make_forward_kernel
from warp_psdr.kernels.interior.media_motion_replay import make_media_motion_kernel
from warp_psdr.kernels.interior.media_replay import make_media_replay_kernel
from warp_psdr.kernels.interior.property import make_property_kernel
from warp_psdr.kernels.interior.replay import make_replay_kernel
from warp_psdr.kernels.interior.time_gated import make_time_gated_kernel
from warp_psdr.kernels.medium.coefficients import POSE
from warp_psdr.options import interior
from warp_psdr.plan.motion import moves_in_media

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.rows.reparametrised import RotationOptions, WarpedOptions, WarpOptions

#: Vertices after which a path without depth limit is cut, counted from where Russian roulette begins: it survives with
#: probability 0.95 at most, so fewer than one path in 10^11 is that long.
UNBOUNDED_VERTICES = 507
#: Most vertices of a path whose vertices are kept.
MOST_VERTICES = 4096
#: Paths of at most so many vertices have a kernel of their own, which keeps no more.
SHORT = 4
#: Most vertices of a path that is kept as a whole whatever its length.
MOST_KEPT = 64


@dataclass(frozen=True)
class Kept:
    """What of a path is kept while it is differentiated.

    Attributes:
        block: path vertices at a time; 0: none.
        blocks: most blocks of a path.
        reason: of these numbers, for the plan.
        bias: what the method leaves out by design; empty: nothing.
        candidates: of a method that draws for derivatives; 0: it does not.
        linear: whether the light that arrives at vertices is not estimated.
        attached: what moves with a parameter; None: the method leaves no choice.
        mirrored: whether film points are mirrored.
        sees_edges: whether path vertices sample edges.
        warp: of a boundary method whose rays move; None: they stay.
        branches: what is drawn for, where several methods stand side by side; None: one stands alone.
    """

    block: int
    blocks: int
    reason: str
    bias: str = ""
    candidates: int = 0
    linear: bool = False
    attached: interior.Attached | None = None
    mirrored: bool = False
    sees_edges: bool = False
    warp: WarpOptions | WarpedOptions | RotationOptions | None = None
    branches: interior.Branches | None = None

    @property
    def longest(self) -> int:
        """Most vertices of a path that the records hold; 0: any number."""
        return self.block * self.blocks


def keep_blocks(method: interior.Method, max_depth: int, rr_depth: int) -> Kept:
    """Return what record and sweep keeps of a path."""
    assert isinstance(method, (interior.Replay, *interior.FROM_LIGHTS, interior.DifferentialRatioTracking))
    if max_depth < 0:
        max_depth = rr_depth + UNBOUNDED_VERTICES
        if max_depth > MOST_VERTICES:
            raise ValueError(
                f"rr_depth: paths without a depth limit that Russian roulette ends from vertex {rr_depth} on are too "
                "long to be differentiated; give max_depth, or an rr_depth of at most "
                f"{MOST_VERTICES - UNBOUNDED_VERTICES}"
            )
    if max_depth > MOST_VERTICES:
        raise ValueError(
            f"max_depth: got {max_depth}, expected at most {MOST_VERTICES} for derivatives; -1 leaves the end of paths "
            "to Russian roulette"
        )
    # Few kernel variants: the default keeps 4 or 8 vertices, whatever the depth.
    block = min(method.block, SHORT) if max_depth <= SHORT else method.block
    blocks = -(-max_depth // block)
    blocks = 1 << (blocks - 1).bit_length()
    whole = "the whole path fits, one trace"
    return Kept(block, blocks, whole if blocks == 1 else f"longer paths are replayed in at most {blocks} blocks")


def moved_request(wanted: GradientRequest) -> GradientRequest:
    """Return what of a request moves in media; points of a medium ride on the boxes of its grids."""
    return GradientRequest(
        material=(False,) * len(wanted.material),
        shapes=wanted.shapes or POSE in wanted.media,
        texcoords=wanted.texcoords,
        lights=tuple(kind for kind in wanted.lights if kind == "pose"),
        camera=wanted.camera,
        media=tuple(kind for kind in wanted.media if kind == POSE),
    )


def make_replay(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    """Return the kernel of record and sweep."""
    if config.shown:
        return make_property_kernel(config, wanted, role)
    if config.media is not None and moves_in_media(wanted):
        moved = moved_request(wanted)
        if wanted.bends:
            # What turns rays weighs them, too: material values are all differentiated with it.
            moved = replace(moved, material=wanted.material, bends=True)
        return make_media_motion_kernel(config, moved, role, kept.block, kept.longest)
    if config.media is not None:
        return make_media_replay_kernel(config, wanted, role, kept.block, kept.longest)
    if role == "forward":
        return make_forward_kernel(config, wanted)
    if config.pulse:
        return make_time_gated_kernel(config, wanted, kept.longest)
    return make_replay_kernel(config, wanted, kept.block, kept.blocks)


def replay_kernels(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernel of record and sweep; where things move in media, that of what moves nothing, too."""
    return [make_replay(config, wanted, role, kept), *beside_motion(config, wanted, role, kept)]


def beside_motion(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernel of what moves nothing beside what moves in media, if there is any."""
    if config.media is None or not moves_in_media(wanted):
        return []
    lights = tuple(kind for kind in wanted.lights if kind != "pose")
    of_media = tuple(kind for kind in wanted.media if kind != POSE)
    material = (False,) * len(wanted.material) if wanted.bends else wanted.material
    rest = replace(wanted, shapes=False, texcoords=False, camera=False, lights=lights, media=of_media)
    rest = replace(rest, material=material, bends=False)
    return replayed(config, rest, role, kept)


def replayed(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> list[wp.Kernel]:
    """Return the kernel of record and sweep, if anything is requested."""
    return [make_replay(config, wanted, role, kept)] if is_asked(wanted) else []


def is_asked(wanted: GradientRequest) -> bool:
    """Whether anything is requested."""
    return wanted != GradientRequest(material=(False,) * len(wanted.material), paired=wanted.paired)


def without(wanted: GradientRequest, own: tuple[bool, ...]) -> GradientRequest:
    """Return what is requested but for a method's own material values."""
    return replace(wanted, material=tuple(w and not o for w, o in zip(wanted.material, own, strict=True)))
