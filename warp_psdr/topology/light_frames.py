"""Lines of projected images across which light jumps: frames that are not black, and borders of nearest texels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.path_space.light_frame import FrameLines
from warp_psdr.scene.lights.light_sampling import cumulative

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Emitter
    from warp_psdr.scene.scene import Scene

#: Most lines of a scene.
MOST = 1 << 21
#: Where an image without steps is read beside its frame, in units of its size.
BESIDE = 1.0e-6
#: Whole sides of an image, (u, v) of both ends, and the way out of it.
SIDES = (
    ((0.0, 0.0, 0.0, 1.0), (-1.0, 0.0)),
    ((1.0, 0.0, 1.0, 1.0), (1.0, 0.0)),
    ((0.0, 0.0, 1.0, 0.0), (0.0, -1.0)),
    ((0.0, 1.0, 1.0, 1.0), (0.0, 1.0)),
)


def has_hard_frame(scene: Scene, e: Emitter) -> bool:
    """Whether the image of a projector jumps at its frame, or within it: not if its outermost texels are black.

    A bilinear look-up on the frame, half a texel outside of their centres, mixes those of two opposite sides at most.
    """
    t = scene.builder.textures[e.texture]
    if t.kind != c.TEXTURE_BITMAP or t.filter != c.FILTER_BILINEAR or slides(scene, e):
        return True
    texels = _texels(scene, e)
    return any(bool(side.any()) for side in (texels[0], texels[-1], texels[:, 0], texels[:, -1]))


def hard_frames(scene: Scene) -> bool:
    """Whether any projector's image jumps."""
    return any(e.kind == c.EMITTER_PROJECTOR and has_hard_frame(scene, e) for e in scene.builder.emitters)


def slides(scene: Scene, e: Emitter) -> bool:
    """Whether the image of a projector is read through a ``to_uv``."""
    t = scene.builder.textures[e.texture]
    if t.kind != c.TEXTURE_BITMAP:
        return False
    matrix = scene.values.numpy()[t.to_uv : t.to_uv + 9].reshape(3, 3)
    return not np.array_equal(matrix, np.eye(3))


def unknown_steps(scene: Scene, e: Emitter, mirrors: bool) -> str:
    """Say which steps a projector's image has that are not known, and what to do; empty: none.

    ``mirrors``: there are smooth mirrors, glass or masks, behind which frames are found.
    """
    t = scene.builder.textures[e.texture]
    if t.kind != c.TEXTURE_BITMAP or t.filter == c.FILTER_BILINEAR:
        return ""
    if slides(scene, e):
        return "a projector reads a 'nearest' image through to_uv, and light jumps at its texels; use 'bilinear'"
    if mirrors:
        return (
            "the 'nearest' texels of a projector's image are not known beside smooth mirrors, glass or masks; use "
            "'bilinear'"
        )
    if 2 * t.width * t.height > MOST:
        return f"a projector's 'nearest' image has more than {MOST:,} borders of texels; use 'bilinear'"
    return ""


def frame_lines(scene: Scene) -> FrameLines | None:
    """Return the lines, drawn by their length at distance 1 and by the jump across them; None: there are none."""
    flat = scene.values.numpy()
    found = []
    for number, e in enumerate(scene.builder.emitters):
        if e.kind != c.EMITTER_PROJECTOR or not has_hard_frame(scene, e):
            continue
        t = scene.builder.textures[e.texture]
        nearest = t.kind == c.TEXTURE_BITMAP and t.filter != c.FILTER_BILINEAR
        ends, across, jump = _borders(_texels(scene, e)) if nearest else _frame()
        aspect = max(t.width, 1) / max(t.height, 1)
        width = 2.0 * math.tan(0.5 * math.radians(float(flat[e.cutoff])))
        size = np.abs(ends[:, 2:] - ends[:, :2]) @ np.array([width, width / aspect])
        weight = jump * size * float(flat[e.scale])
        keep = weight > 0.0
        count = np.full(int(keep.sum()), number, np.int32)
        found.append((weight[keep], count, ends[keep], across[keep]))
    if not any(len(part[0]) for part in found):
        return None
    weight, emitter, ends, across = (np.concatenate([part[k] for part in found]) for k in range(4))
    lines = FrameLines()
    lines.cdf = wp.array(cumulative(weight), dtype=wp.float32, device=scene.device)
    lines.emitter = wp.array(emitter, dtype=wp.int32, device=scene.device)
    lines.ends = wp.array(np.ascontiguousarray(ends, np.float32), dtype=wp.vec4, device=scene.device)
    lines.across = wp.array(np.ascontiguousarray(across, np.float32), dtype=wp.vec2, device=scene.device)
    return lines


def _texels(scene: Scene, e: Emitter) -> np.ndarray:
    """Return the texels of a projector's bitmap, (H, W, channels)."""
    t = scene.builder.textures[e.texture]
    values = scene.values.numpy()[t.offset : t.offset + t.height * t.width * t.channels]
    return values.reshape(t.height, t.width, t.channels)


def _frame() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frame of an image without steps: ends, across, and ones, for it may be lit."""
    ends, out = (np.array([side[k] for side in SIDES]) for k in range(2))
    return ends, BESIDE * out, np.ones(len(SIDES))


def _borders(texels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the borders of texels, of a frame too: ends, across (half a texel), and the mean jump."""
    height, width, _channels = texels.shape
    beyond = np.pad(texels, ((1, 1), (1, 1), (0, 0))).astype(np.float64)
    upright = np.abs(np.diff(beyond[1:-1], axis=1)).mean(axis=2)  # (H, W + 1), at u = j / W
    level = np.abs(np.diff(beyond[:, 1:-1], axis=0)).mean(axis=2)  # (H + 1, W), at v = i / H
    i, j = np.indices(upright.shape)
    first = np.stack([j / width, i / height, j / width, (i + 1) / height], axis=-1).reshape(-1, 4)
    i, j = np.indices(level.shape)
    second = np.stack([j / width, i / height, (j + 1) / width, i / height], axis=-1).reshape(-1, 4)
    across = np.repeat([[0.5 / width, 0.0], [0.0, 0.5 / height]], [len(first), len(second)], axis=0)
    return np.concatenate([first, second]), across, np.concatenate([upright.ravel(), level.ravel()])
