"""A phase function by a table of values over the cosine (Mitsuba's ``tabphase``).

The n values lie at equal distances h = 2 / (n - 1) from mu = -1 to mu = 1, with straight lines between them. mu is the
cosine between the direction of flight and the new one, and f_p = v(mu) / (2 pi I), I the integral of v. The derivative
by a value includes that of I. The table is the record of a texture of ``width`` n; ``second`` is the flat offset of its
integrals from -1 on, which follow edits of the values.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import INV_TWO_PI
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Texture


@wp.struct
class Entry:
    """A place in a table: between value i and the next, at the fraction f."""

    i: wp.int32
    f: wp.float32


@wp.func
def entry_at(table: Texture, mu: wp.float32) -> Entry:
    x = 0.5 * wp.float32(table.width - 1) * (wp.clamp(mu, -1.0, 1.0) + 1.0)
    r = Entry()
    r.i = wp.clamp(wp.int32(x), 0, table.width - 2)
    r.f = wp.clamp(x - wp.float32(r.i), 0.0, 1.0)
    return r


@wp.func
def table_integral(scene: Scene, table: Texture) -> wp.float32:
    """I."""
    return load_float(scene.values, table.second + table.width - 1)


@wp.func
def tabphase_eval(scene: Scene, number: wp.int32, mu: wp.float32) -> wp.float32:
    """Value and density, 1/sr; ``number``: of the table's record."""
    table = texture_record(scene, number)
    entry = entry_at(table, mu)
    v = wp.lerp(
        load_float(scene.values, table.offset + entry.i), load_float(scene.values, table.offset + entry.i + 1), entry.f
    )
    return INV_TWO_PI * v / table_integral(scene, table)


@wp.func
def tabphase_by_cosine(scene: Scene, number: wp.int32, mu: wp.float32) -> wp.float32:
    """The derivative by mu, 1/sr."""
    table = texture_record(scene, number)
    i = table.offset + entry_at(table, mu).i
    rise = load_float(scene.values, i + 1) - load_float(scene.values, i)
    return 0.5 * wp.float32(table.width - 1) * INV_TWO_PI * rise / table_integral(scene, table)


@wp.func
def tabphase_cosine(scene: Scene, number: wp.int32, u: wp.float32) -> wp.float32:
    """Cosine of a direction that is drawn by u."""
    table = texture_record(scene, number)
    x = u * table_integral(scene, table)
    low = wp.int32(0)
    high = table.width - 1
    while high - low > 1:
        middle = (low + high) // 2
        if load_float(scene.values, table.second + middle) <= x:
            low = middle
        else:
            high = middle
    h = 2.0 / wp.float32(table.width - 1)
    v0 = load_float(scene.values, table.offset + low)
    v1 = load_float(scene.values, table.offset + low + 1)
    rest = wp.max(x - load_float(scene.values, table.second + low), 0.0)
    # v0 s + (v1 - v0) s^2 / (2 h) = rest; nothing cancels.
    root = wp.sqrt(wp.max(v0 * v0 + 2.0 * (v1 - v0) * rest / h, 0.0))
    s = wp.min(2.0 * rest / wp.max(v0 + root, 1.0e-30), h)
    return wp.clamp(-1.0 + h * wp.float32(low) + s, -1.0, 1.0)


@functools.cache
def make_table_sink(role: str):
    """Return ``accumulate_table(scene, target, number, mu, w) -> float32``: ``w`` is the adjoint of the value at mu."""
    sink = make_sink(role)

    @wp.func
    def accumulate_table(
        scene: Scene, target: wp.array(dtype=wp.float32), number: wp.int32, mu: wp.float32, w: wp.float32
    ) -> wp.float32:
        table = texture_record(scene, number)
        entry = entry_at(table, mu)
        integral = table_integral(scene, table)
        a = INV_TWO_PI * w / integral
        total = sink(target, table.offset + entry.i, a * (1.0 - entry.f))
        total += sink(target, table.offset + entry.i + 1, a * entry.f)
        # - f_p dI / I, dI the integral of each value's tent.
        share = -w * tabphase_eval(scene, number, mu) / integral * (2.0 / wp.float32(table.width - 1))
        for i in range(table.width):
            end = i == 0 or i == table.width - 1
            total += sink(target, table.offset + i, wp.where(end, 0.5 * share, share))
        return total

    return accumulate_table
