"""A fuzzer of bytes: damages whole files, lets the library read them, and reports what came of it.

Run as a program, in a process of its own: ``python -m tests.stability.fuzz FOLDER FIRST COUNT SUFFIX...``. The input
that is being read lies in the folder, so a process that died leaves what killed it. Inputs follow from the suffix and
their number alone. The report is a line of JSON behind every suffix.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.stability import corpus

#: What reading a file may end in: messages of the library's own, which name the file.
CLEAR = (ValueError, TypeError, FileNotFoundError)
#: Files that the library reads by itself; the others stand in a scene, and messages name the place.
OWN = ("toml", "json", "npz", "npy", "exr", "png", "jpg")
#: Seconds of this process's own time for one input: a safety net, some hundred times what the slowest takes.
SECONDS = 20.0
#: Numbers at the edges of what formats and arrays hold.
INTEGERS = (0, 1, 2, 3, 4, 127, 128, 255, 256, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**63, 2**64)
NUMBERS = (b"0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e38", b"1e39", b"1e308", b"1e309", b"-0", b"1e-45", b"0x10",
           b"2147483648", b"4294967296", b"1000000000", b"18446744073709551616", b"9" * 400, b"9" * 5000, b"", b"1_0",
           b"\xd9\xa3", b"true", b"1 2 3", b"1e5000")  # fmt: skip
WORDS: dict[str, tuple[bytes, ...]] = {
    "xml": (b"<shape", b"type=\"sphere\"", b"</bsdf>", b"<bsdf type=\"diffuse\"/>", b"<ref id=\"paint\"/>", b"$size",
            b"$", b"&lt;", b"&#0;", b"<!ENTITY x \"y\">", b"../", b"/etc/passwd", b"\0", b"<![CDATA[", b"-->", b"<!--",
            b"resolution", b"to_world", b"type", b"value=\"1e30\"", b"id=\"cam\"", b"mesh", b"envmap", b"a" * 300),
    "ply": (b"element vertex ", b"element face ", b"property list uchar int x\n", b"property double ", b"list", b"int",
            b"end_header\n", b"ascii", b"\n", b"element a 1\n", b"property list int int vertex_index\n", b"uint64"),
    "obj": (b"v ", b"vt ", b"vn ", b"f ", b"/", b"//", b"-", b"\n", b"\\\n", b"#", b"\r", b"l 1 2\n"),
    "gltf": (b"\"uri\":\"../../../../etc/passwd\",", b"\"children\":[0],", b"\"byteStride\":1,", b"null", b"[", b"{",
             b"\"sparse\":{},", b"\"matrix\":[0],", b"data:,", b"true", b"\"count\":"),
    "exr": (b"dataWindow\0box2i\0\x10\0\0\0", b"channels\0chlist\0", b"compression\0", b"tiles\0", b"\xff\xff\xff\x7f"),
    "toml": (b"[", b"]", b"[[", b"=", b"\"", b"'''", b".", b"{", b"}", b"a.", b"1979-05-27", b"nan", b"true", b"\0",
             b"a" * 300, b"initial = \"texture.exr\"", b"allow_outside = [\"..\"]", b"cuda:7"),
    "npz": (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06",
            b"\x93NUMPY", b"'descr': '|O'", b"(10000000000,)", b"<f4", b"("),
}  # fmt: skip
WORDS |= {"glb": WORDS["gltf"], "json": WORDS["toml"], "npy": WORDS["npz"], "neuralsdf": WORDS["npz"]}


def damaged(suffix: str, whole: list[bytes], number: int) -> bytes:
    """Return input ``number`` of a kind: one of the whole files with a few things changed."""
    rng = np.random.default_rng([number, *suffix.encode()])
    data = bytearray(whole[rng.integers(len(whole))])
    for _ in range(int(rng.geometric(0.6))):
        _change(data, whole, WORDS.get(suffix, ()), rng)
    return bytes(data)


def _change(data: bytearray, whole: list[bytes], words: tuple[bytes, ...], rng: np.random.Generator) -> None:
    if not data:
        data += b"\0"
    at = int(rng.integers(len(data)))
    until = min(len(data), at + int(rng.geometric(0.1)))
    kind = rng.integers(9)
    if kind == 0:
        data[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        data[at:until] = rng.bytes(until - at)
    elif kind == 2:
        del data[at:until]
    elif kind == 3:
        data[at:at] = data[at:until] * int(rng.choice([1, 2, 100]))
    elif kind == 4 and rng.random() < 0.3:
        del data[at:]
    elif kind == 5:
        other = whole[rng.integers(len(whole))]
        start = int(rng.integers(len(other)))
        data[at:until] = other[start : start + int(rng.geometric(0.02))]
    elif kind == 6:
        size = int(rng.choice([1, 2, 4, 8]))
        value = INTEGERS[rng.integers(len(INTEGERS))] % 256**size
        data[at : at + size] = value.to_bytes(size, "little" if rng.random() < 0.7 else "big")
    elif kind == 7:
        _replace_number(data, at, NUMBERS[rng.integers(len(NUMBERS))])
    elif words:
        data[at : at if rng.random() < 0.5 else until] = words[rng.integers(len(words))]


def _replace_number(data: bytearray, at: int, text: bytes) -> None:
    """Put ``text`` in the place of the next number behind ``at``."""
    digits = b"0123456789.-+e"
    start = next((i for i in range(at, len(data)) if data[i] in digits), None)
    if start is not None:
        end = next((i for i in range(start, len(data)) if data[i] not in digits), len(data))
        data[start:end] = text


def reader(suffix: str) -> Callable[[Path], Any]:
    """Return what reads files of a kind."""
    import warp_psdr as psdr
    from warp_psdr import image_io
    from warp_psdr.arrays import read_array
    from warp_psdr.fit import checkpoint
    from warp_psdr.fit.config import FitConfig
    from warp_psdr.fit.run import load_problem
    from warp_psdr.scene import describe_dict

    def shape(file: Path) -> Any:
        plugin = {"type": suffix, "filename": file.name}
        return describe_dict({"type": "scene", "a": plugin, "cam": {"type": "perspective"}}, base=file.parent)

    return {
        "xml": psdr.load_file,
        "toml": lambda file: load_problem(FitConfig.from_file(file)),
        "json": lambda file: load_problem(FitConfig.from_file(file)),
        "npz": checkpoint.load,
        "npy": read_array,
        **dict.fromkeys(("exr", "png", "jpg"), image_io.read_image),
    }.get(suffix, shape)


def run(suffix: str, folder: Path, first: int, count: int) -> dict[str, Any]:
    """Read ``count`` inputs and return what came of them."""
    from warp_psdr.scene.errors import SceneError

    whole = corpus.files(folder)
    corpus.write_beside(folder, whole)
    read = reader(suffix)
    clear = CLEAR if suffix in OWN else (SceneError, FileNotFoundError)
    file = folder / f"input.{suffix}"
    for data in whole[suffix]:  # all that is loaded when it is first used, and whole files are read at all
        file.write_bytes(data)
        read(file)

    def late(number: int, frame: Any) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    warnings.simplefilter("error", RuntimeWarning)  # overflow and NaN are found by checks, not by arithmetic
    signal.signal(signal.SIGPROF, late)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcomes: Counter[str] = Counter()
    failures = []
    slowest = (0.0, -1)
    for number in range(first, first + count):
        file.write_bytes(damaged(suffix, whole[suffix], number))
        start = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            read(file)
            outcome = "read"
        except clear as problem:
            outcome = type(problem).__name__
            if suffix not in ("toml", "json") and "input" not in str(problem) and not isinstance(problem, SceneError):
                failures.append((number, f"the message does not name the file: {problem}"))
        except BaseException as problem:
            outcome = type(problem).__name__
            failures.append((number, f"{outcome}: {problem}"[:300]))
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        outcomes[outcome] += 1
        slowest = max(slowest, (time.process_time() - start, number))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "outcomes": dict(outcomes),
        "failures": failures,
        "slowest": slowest,
        "memory": (peak - before) / 1024.0,
    }


if __name__ == "__main__":
    for kind in sys.argv[4:]:
        result = run(kind, Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
        print(f"{kind} {json.dumps(result)}", flush=True)
