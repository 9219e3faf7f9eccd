"""Two helpers that Warp 1.19 needs where ``wp.grad`` is used; ``tests/test_autodiff.py`` checks both.

* A function that ``wp.grad`` differentiates may have been built earlier for its value alone. Warp then emits empty
  adjoints for the functions that *it* calls, and their derivatives are silently zero. ``differentiable`` marks the
  whole call tree, so that every adjoint exists whatever the order.
* Warp emits functions that call ``wp.grad`` behind all others. A function that only calls such a function has to be
  moved behind it too: ``_anchor = wp.grad(anchor)(0.0)``, which the compiler removes.
"""

import warp as wp


def differentiable(function: wp.Function) -> wp.Function:
    """Have Warp emit the adjoints of a function and of everything it calls; use above ``@wp.func``."""
    function.adj.force_adjoint_codegen = True
    for callee in function.adj.get_references()[2]:
        if not callee.is_builtin() and not callee.adj.force_adjoint_codegen:
            differentiable(callee)
    return function


@differentiable
@wp.func
def anchor(a: wp.float32) -> wp.float32:
    """Nothing, differentiably."""
    return a
