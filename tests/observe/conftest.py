import numpy as np
import pytest

import warp_psdr as psdr

from .board import TRUE, node


@pytest.fixture(scope="module")
def photo():
    """What a camera of exposure .7 wrote of the board, with noise."""
    image = psdr.render(psdr.load_dict(node(TRUE)), spp=256, seed=99).numpy()
    noisy = 0.7 * image + 0.004 * np.random.default_rng(0).normal(size=image.shape)
    return np.round(255 * psdr.image_io.linear_to_srgb(noisy)).astype(np.uint8)
