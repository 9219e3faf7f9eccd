"""Functions that are generated: each is compiled as its own names say."""

import numpy as np
import warp as wp

from warp_psdr.kernels.generated import make_generated

TEXT = "def weigh(x: wp.float32) -> wp.float32:\n    return f0(x) + 10.0 * f1(x) + 100.0 * f2(x)\n"


@wp.func
def once(x: wp.float32) -> wp.float32:
    return x


@wp.func
def twice(x: wp.float32) -> wp.float32:
    return 2.0 * x


def weighed(f0: wp.Function, f1: wp.Function, f2: wp.Function) -> float:
    weigh = make_generated(TEXT, f0=f0, f1=f1, f2=f2)

    @wp.kernel(module="unique", enable_backward=False)
    def weigh_one(out: wp.array(dtype=wp.float32)):
        out[0] = weigh(1.0)

    out = wp.zeros(1, dtype=wp.float32, device="cpu")
    wp.launch(weigh_one, dim=1, inputs=[out], device="cpu")
    return float(out.numpy()[0])


def test_who_is_called_where_tells_functions_of_one_text_apart() -> None:
    found = [weighed(once, twice, once), weighed(once, once, twice), weighed(once, twice, twice)]
    np.testing.assert_array_equal(found, [121.0, 211.0, 221.0])
