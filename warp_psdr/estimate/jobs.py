"""Jobs of launches: ranges of samples as the kernels take them (``kernels/jobs.py``)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from warp_psdr.kernels.jobs import PixelJob, SampleJob


@dataclass(frozen=True)
class PixelSamples:
    """Samples of every pixel of a pass; ``job`` makes those of one launch.

    Attributes:
        samples: of each pixel.
        seed: of the pass.
        max_depth: most path vertices, -1: no limit.
        rr_depth: vertex from which on Russian roulette ends paths.
        scale: of what a sample gives.
        first_sample: number of the first.
        margin: by which the raster exceeds the image on each side, pixels.
        first_film_row: of the image, of a film that holds a band of its rows.
        adjoint: (H, W) of vec3, where the pass reads it.
    """

    samples: int
    seed: int
    max_depth: int
    rr_depth: int
    scale: float = 1.0
    first_sample: int = 0
    margin: int = 0
    first_film_row: int = 0
    adjoint: wp.array | None = None

    def job(self, pixels: wp.array) -> PixelJob:
        """Return a record for the pixels of a list; a launch sets ``first_pixel`` and ``pixel_count``."""
        job = PixelJob()
        job.pixels = pixels
        job.margin = self.margin
        job.first_film_row = self.first_film_row
        job.first_sample = self.first_sample
        job.samples = self.samples
        job.scale = self.scale
        job.seed = self.seed
        job.max_depth = self.max_depth
        job.rr_depth = self.rr_depth
        if self.adjoint is not None:
            job.image_adjoint = self.adjoint
        return job


def sample_job(first: int, samples: int, seed: int, max_depth: int, rr_depth: int, adjoint: wp.array) -> SampleJob:
    """Return the record of the samples of a boundary term from ``first`` on, of ``samples`` in all."""
    job = SampleJob()
    job.first = first
    job.samples = samples
    job.seed = seed
    job.max_depth = max_depth
    job.rr_depth = rr_depth
    job.image_adjoint = adjoint
    return job
