"""What a pool has done, sent and received."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Traffic:
    """What a pool has sent and received.

    Attributes:
        jobs: that were done.
        sent: bytes of data, at least: Dask may copy it from worker to worker.
        received: bytes of results.
        lost: times that a job was sent again since its process was lost.
        seconds: that the jobs ran, all processes together.
    """

    jobs: int = 0
    sent: int = 0
    received: int = 0
    lost: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Report:
    """What a pool has done; ``str`` is a table.

    Attributes:
        processes: of the pool.
        jobs: that were done.
        sent: bytes of scenes, values, adjoints and targets.
        received: bytes of images and gradients.
        lost: times that jobs were sent again since a process was lost.
        seconds: that the jobs ran, all processes together.
    """

    processes: int
    jobs: int
    sent: int
    received: int
    lost: int
    seconds: float

    def __str__(self) -> str:
        rows = (
            ("processes", f"{self.processes}"),
            ("jobs", f"{self.jobs}, {self.seconds:.1f} s together"),
            ("sent", f"{self.sent / 1e6:.2f} MB"),
            ("received", f"{self.received / 1e6:.2f} MB"),
            ("sent again", f"{self.lost}"),
        )
        return "\n".join(f"{name:<10} {value}" for name, value in rows)
