"""Start Warp without its greeting, and find the device that a user names."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warp_psdr.quiet import quiet

#: What Warp's library writes to the process's standard error where there is no NVIDIA driver.
NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
_STDERR = 2


def start_warp() -> None:
    """Initialise Warp without its greeting; a program that calls ``wp.init()`` itself gets to see it.

    Warp's line that there is no NVIDIA driver is left out, too: who asks for CUDA gets an error (``device_named``).
    """
    if wp._src.context.runtime is not None:  # Warp 1.19 has no public name for it
        return
    with quiet(), _without_line(NO_DRIVER):
        wp.init()


def device_named(device: str | wp.Device | None) -> wp.Device:
    """Return a Warp device.

    Args:
        device: "cpu", "cuda:0", ...; None: Warp's current one.

    Raises:
        ValueError: this machine has no such device.
    """
    start_warp()
    try:
        return wp.get_device(device)
    except ValueError as error:
        there = ", ".join(f"'{d.alias}'" for d in wp.get_devices())
        why = "" if wp.get_cuda_device_count() else "; Warp finds no GPU with an NVIDIA driver here"
        raise ValueError(f"device: got {device!r}, this machine has {there}{why}") from error


@contextmanager
def _without_line(part: bytes) -> Iterator[None]:
    """Leave lines with ``part`` out of what native code writes to standard error meanwhile."""
    try:
        sys.stderr.flush()
        kept = os.dup(_STDERR)
    except (AttributeError, OSError, ValueError):  # a program without standard error
        yield
        return
    with tempfile.TemporaryFile() as lines:
        os.dup2(lines.fileno(), _STDERR)
        try:
            yield
        finally:
            os.dup2(kept, _STDERR)
            lines.seek(0)
            for line in lines:
                if part not in line:
                    os.write(kept, line)
            os.close(kept)
