"""What of the materials no texture varies: a record of each, which paths side by side fetch as a whole.

They lie in ``structs.Scene.baked``: of every scattering record the last members of an ``Interaction``, which are its
model, its slots, and its values, 0 where these vary over a surface or where its model has none. A constant has the same
place among the scene's values for good, and what is there is copied before every launch, whatever changed it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.bsdf.model import GRADIENT
from warp_psdr.kernels.bsdf.record import make_material_record
from warp_psdr.kernels.constants import TEXTURE_CONSTANT
from warp_psdr.kernels.interaction import make_interaction_record
from warp_psdr.kernels.lanes.lanes import stride_of, word_of
from warp_psdr.kernels.lanes.place_lanes import baked_words

if TYPE_CHECKING:
    from warp_psdr.scene.build import Builder


class BakedMaterials:
    """The records of a scene.

    Args:
        builder: Of the scene.
        values: All of its values, flat float32; they stay where they are.
        used: Whether paths are traced side by side; else there are no records.
    """

    def __init__(self, builder: Builder, values: wp.array, *, used: bool):
        self._values = values.numpy() if used else np.zeros(0, np.float32)  # on the CPU a view
        words, places, offsets = _laid_out(builder, values.ptr) if used else (np.zeros(1, np.uint32), [], [])
        self._records = wp.array(words, dtype=wp.uint32, device=values.device)
        self._words = self._records.numpy().view(np.float32) if used else self._values
        self._places, self._offsets = np.array(places, np.intp), np.array(offsets, np.intp)

    def current(self) -> wp.array:
        """Return the records with the values that the scene has now."""
        self._words[self._places] = self._values[self._offsets]
        return self._records


def _laid_out(builder: Builder, address: int) -> tuple[np.ndarray, list[int], list[int]]:
    """Return the records without their values, and where each value goes and comes from; ``address``: of all values."""
    material = make_material_record(tuple((value.name, value.type) for value in builder.values))
    interaction = make_interaction_record(material)
    stride, first = stride_of(baked_words(interaction)), word_of(interaction, "model")
    slots, members = word_of(interaction, "slots") - first, word_of(interaction, "material") - first
    words = np.zeros(stride * max(len(builder.bsdfs), 1), np.uint32)
    places: list[int] = []
    offsets: list[int] = []
    for start, (record, textures) in enumerate(zip(builder.bsdfs, builder.bsdf_textures, strict=True)):
        start *= stride
        words[start], words[start + slots] = record.model, record.slots
        for value in builder.values:
            place = start + members + word_of(material, value.name)
            texture = builder.textures[textures[value.name]] if value.name in textures else None
            if value.size:  # elsewhere an address that can be read
                table = address + 4 * (texture.offset if texture else 0)
                words[place], words[place + 1] = table & 0xFFFFFFFF, table >> 32
            elif texture is not None and texture.kind == TEXTURE_CONSTANT and value.source != GRADIENT:
                count = 3 if value.color else 1
                places += range(place, place + count)
                offsets += [texture.offset + (i if texture.channels == 3 else 0) for i in range(count)]
    return words, places, offsets
