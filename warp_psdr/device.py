"""Kernel launches of the library's own, which a user's tape must not record."""

from __future__ import annotations

import warp as wp


def launch(kernel: wp.Kernel, dim, inputs: list, outputs: list, device) -> None:
    """Launch a kernel without recording it on the tape that may be active."""
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_tape=False)
