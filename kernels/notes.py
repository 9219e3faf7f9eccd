"""Notes on the vertices of one sample, for ``psdr.trace_sample``: kernels of a ``noted`` configuration write them.

The notes follow the counter in ``Scene.invalid`` (``invalid.py``): their number, then a row each. Other kernels of the
same call pass an array that ends behind the counter, and note nothing. One thread writes at a time.
"""

import functools

import warp as wp

from warp_psdr.kernels.invalid import COUNTER_SIZE
from warp_psdr.kernels.structs import Scene

#: What a row is about: an edge (its number), a point of a triangle, the end x_1 towards the sensor and x_2 towards the
#: source of a boundary segment, a vertex of the walk from x_1 to the camera, and a vertex of any other light path.
NOTE_EDGE, NOTE_POINT, NOTE_SENSOR, NOTE_SOURCE, NOTE_WALK, NOTE_VERTEX = 0, 1, 2, 3, 4, 5
#: Words of a row: what, number, then the bits of u, v and of five vectors.
NOTE_WORDS = 19


@wp.func
def bits(x: wp.float32) -> wp.int64:
    return wp.int64(wp.cast(x, wp.int32))


@wp.func
def note(
    scene: Scene,
    what: wp.int32,
    number: wp.int32,
    u: wp.float32,
    v: wp.float32,
    x: wp.vec3,
    d: wp.vec3,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
):
    """Write a row: an edge's or a triangle's number, where on it, a place, a direction, and up to three values."""
    if scene.invalid.shape[0] > COUNTER_SIZE:
        first = COUNTER_SIZE + 1 + NOTE_WORDS * wp.int32(scene.invalid[COUNTER_SIZE])
        scene.invalid[COUNTER_SIZE] = scene.invalid[COUNTER_SIZE] + wp.int64(1)
        if first + NOTE_WORDS <= scene.invalid.shape[0]:
            scene.invalid[first] = wp.int64(what)
            scene.invalid[first + 1] = wp.int64(number)
            scene.invalid[first + 2] = bits(u)
            scene.invalid[first + 3] = bits(v)
            for i in range(3):
                scene.invalid[first + 4 + i] = bits(x[i])
                scene.invalid[first + 7 + i] = bits(d[i])
                scene.invalid[first + 10 + i] = bits(a[i])
                scene.invalid[first + 13 + i] = bits(b[i])
                scene.invalid[first + 16 + i] = bits(c[i])


@functools.cache
def make_note(noted: bool):
    """Return ``note_place(scene, what, number, u, v, x, d, weight)``: a row, or nothing at all."""

    @wp.func
    def note_place(
        scene: Scene,
        what: wp.int32,
        number: wp.int32,
        u: wp.float32,
        v: wp.float32,
        x: wp.vec3,
        d: wp.vec3,
        weight: wp.vec3,
    ):
        if wp.static(noted):
            none = wp.vec3(0.0, 0.0, 0.0)
            note(scene, what, number, u, v, x, d, weight, none, none)

    return note_place
