"""Values of several paths side by side, so that the compiler turns loops over the paths into SIMD.

LLVM's loop vectoriser turns a loop ``while j < W`` whose body consists of Warp functions into SIMD, with the bits of
single paths. The paths' values lie in rows of ``Scene.rows``. They are read and written as ``char32_t``, which tells
the compiler that they do not overlap the scene's floats and integers.

Derivation: ``docs/theory/rays.md#paths-side-by-side``.
"""

import ctypes
import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import native

ROWS = wp.array(dtype=wp.uint32)
#: Rows that ``Scene.rows`` has. It is the host's and holds anything: a local array would be cleared for every pixel,
#: twice, which took a tenth of an image and of a gradient.
ROOM = 1024
#: Rows behind those, for paths that wait (``waiting_lanes.py``).
QUEUE_ROOM = 736


def words(record) -> int:
    """Number of rows that a Warp struct takes."""
    return ctypes.sizeof(record.ctype) // 4


def word_of(record, name: str) -> int:
    """Row of a member of a Warp struct, counted from the record's first."""
    return getattr(record.ctype, name).offset // 4


@functools.cache
def make_record(record, width: int, aside: bool = False):
    """Return ``(get, put)`` of a Warp struct whose members have 4 bytes each.

    ``get(rows, first, j, like) -> record`` reads lane j from the rows ``first`` on (``like`` is any value of the
    struct), ``put(rows, first, j, value)`` writes it. ``aside``: the rows are for nobody else's eyes, and are accessed
    as floats, so that a loop may read rows and write to these wherever they lie.
    """
    count = words(record)
    word = "float" if aside else "char32_t"
    reads = "".join(
        f"const {word} w{i} = data[{i} * $W]; __builtin_memcpy((char*)&r + {4 * i}, &w{i}, 4);\n" for i in range(count)
    )
    writes = "".join(
        f"{word} w{i}; __builtin_memcpy(&w{i}, (const char*)&value + {4 * i}, 4); data[{i} * $W] = w{i};\n"
        for i in range(count)
    )

    def get(rows: ROWS, first: wp.int32, j: wp.int32, like: record) -> record:
        return record()  # Warp takes the type from here; the snippet is what runs

    def put(rows: ROWS, first: wp.int32, j: wp.int32, value: record):
        return

    name = record.key.rsplit(".", 1)[-1].lower() + ("_aside" if aside else "")
    source = f"const {word}* data = (const {word}*)rows.data + first * $W + j;\n__typeof__(like) r;\n"
    target = f"{word}* data = ({word}*)rows.data + first * $W + j;\n"
    return (
        native(f"get_{name}", source + reads + "return r;", width, get),
        native(f"put_{name}", target + writes, width, put),
    )


class Rows(NamedTuple):
    """Where a record lies, and how it is read and written.

    Attributes:
        first: its first row.
        end: the row behind its last.
        get: ``(rows, j) -> record`` of lane j.
        put: ``(rows, j, record)``.
    """

    first: int
    end: int
    get: wp.Function
    put: wp.Function


@functools.cache
def make_rows(record, width: int, first: int) -> Rows:
    """Make the functions for a record of ``width`` lanes from row ``first`` on."""
    get_from, put_to = make_record(record, width)

    @wp.func
    def get(rows: ROWS, j: wp.int32) -> record:
        return get_from(rows, first, j, record())

    @wp.func
    def put(rows: ROWS, j: wp.int32, value: record):
        put_to(rows, first, j, value)

    return Rows(first, first + words(record), get, put)


class SteppedLanes(NamedTuple):
    """Functions that meet a shape with the rays of all lanes, in steps.

    Attributes:
        take: ``(rows, j, ray: Ray, wanted: int)`` gives lane j its ray; ``wanted``: 1 if it is traced.
        closest: ``(scene, tri, rows)`` finds where the rays first meet the shape.
        any: ``(scene, tri, rows)`` finds whether they do.
        hit: ``(scene, tri, rows, j) -> RayHit`` of ``closest``; its ``face`` is 0, or -1 for a miss.
        blocked: ``(rows, j) -> bool`` of ``any``.
        end: the first row that is free.
    """

    take: wp.Function
    closest: wp.Function
    any: wp.Function
    hit: wp.Function
    blocked: wp.Function
    end: int


def stack_rows(width: int, first: int, *records) -> tuple[Rows, ...]:
    """Lay out records of ``width`` lanes from row ``first`` on, one below the other."""
    stacked = []
    for record in records:
        stacked.append(make_rows(record, width, first))
        first = stacked[-1].end
    return tuple(stacked)


@functools.cache
def make_number(width: int):
    """Return ``(get, put)`` of one random number in [0, 1) and lane: ``get(rows, row, j)``, ``put(rows, row, j, u)``.

    The absolute value, which changes nothing, is arithmetic: without any, two numbers that become a ``vec2`` are moved
    as one integer of 8 bytes, which no loop over lanes may hold.
    """

    def get(rows: ROWS, row: wp.int32, j: wp.int32) -> wp.float32:
        return wp.float32(0.0)

    def put(rows: ROWS, row: wp.int32, j: wp.int32, u: wp.float32):
        return

    source = "const char32_t w = ((const char32_t*)rows.data)[row * $W + j];\n"
    return (
        native("get_number", source + "return __builtin_fabsf(__builtin_bit_cast(float, w));", width, get),
        native("put_number", "((char32_t*)rows.data)[row * $W + j] = __builtin_bit_cast(char32_t, u);", width, put),
    )


def stride_of(count: int) -> int:
    """Number of words by which records of ``count`` words lie apart where they are fetched: a multiple of four."""
    return -(-count // 4) * 4


@functools.cache
def make_fetch(dtype: type, width: int, count: int):
    """Return ``fetch(records, rows, index, first)``: records of ``count`` words of an array in lanes.

    The words of record n, the number in row ``index``, in the rows ``first`` on; n < 0 counts as 0. In the array of
    ``dtype`` a record starts every ``stride_of(count)`` words. Four words of a record are loaded at once and transposed
    between lanes, in registers: of records in many words that is a fraction of the time of gathers, which load every
    word by itself.
    """

    def fetch(records: wp.array(dtype=dtype), rows: ROWS, index: wp.int32, first: wp.int32):
        return

    snippet = """
    typedef float f4 __attribute__((ext_vector_type(4), aligned(4), may_alias));
    typedef float vf __attribute__((ext_vector_type($W), aligned(4), may_alias));
    struct Fetch {
        static inline __attribute__((always_inline)) f4 four(const float* from) { return *(const f4*)from; }
        static inline __attribute__((always_inline)) vf join(const float* const* from, int word) {
            // Four words of every fourth lane.
            const f4 a = four(from[0] + word);
#if $W == 4
            return a;
#else
            const auto low = __builtin_shufflevector(a, four(from[4] + word), 0, 1, 2, 3, 4, 5, 6, 7);
#if $W == 8
            return low;
#else
            const f4 c = four(from[8] + word);
            const auto high = __builtin_shufflevector(c, four(from[12] + word), 0, 1, 2, 3, 4, 5, 6, 7);
            return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
#endif
#endif
        }
    };
    const char32_t* numbers = (const char32_t*)rows.data + index * $W;
    const float* from[$W];
    for (int j = 0; j < $W; ++j)
        from[j] = (const float*)records.data + ((int)numbers[j] < 0 ? 0 : (int)numbers[j]) * (size_t)$STRIDE;
    float* to = (float*)rows.data + first * $W;
    #pragma clang loop unroll(full)
    for (int word = 0; word < $COUNT; word += 4) {
        // Blocks of four lanes, each transposed by itself.
        const vf a = Fetch::join(from, word), b = Fetch::join(from + 1, word);
        const vf c = Fetch::join(from + 2, word), d = Fetch::join(from + 3, word);
        const vf p = __builtin_shufflevector(a, b, $LOW), q = __builtin_shufflevector(c, d, $LOW);
        const vf r = __builtin_shufflevector(a, b, $HIGH), s = __builtin_shufflevector(c, d, $HIGH);
        *(vf*)(to + word * $W) = __builtin_shufflevector(p, q, $FIRST);
        if (word + 1 < $COUNT)
            *(vf*)(to + (word + 1) * $W) = __builtin_shufflevector(p, q, $SECOND);
        if (word + 2 < $COUNT)
            *(vf*)(to + (word + 2) * $W) = __builtin_shufflevector(r, s, $FIRST);
        if (word + 3 < $COUNT)
            *(vf*)(to + (word + 3) * $W) = __builtin_shufflevector(r, s, $SECOND);
    }
    """
    # Within each block of four, from two vectors: words 0 and 1 of both in turns, and so on.
    orders = {"LOW": (0, width, 1, width + 1), "HIGH": (2, width + 2, 3, width + 3)}
    orders |= {"FIRST": (0, 1, width, width + 1), "SECOND": (2, 3, width + 2, width + 3)}
    for key, order in orders.items():
        lanes = ", ".join(str(block + lane) for block in range(0, width, 4) for lane in order)
        snippet = snippet.replace(f"${key}", lanes)
    snippet = snippet.replace("$COUNT", str(count)).replace("$STRIDE", str(stride_of(count)))
    return native(f"fetch_{count}", snippet, width, fetch)
