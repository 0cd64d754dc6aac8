"""exp and erfc as arithmetic: LLVM makes vector instructions of loops over them, which it can't with libm's."""

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]  # it has no stubs
from numba import types
from numba.extending import intrinsic

from common.jit import inlined

_LOG2_E = 1.4426950408889634
_LN_2 = 0.6931471805599453
_LOWEST = -700.0  # exp of less is no normal number


def _power_of_2_code(_typing: Any, exponent: Any) -> Any:
    def code(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        is_single = signature.args[0] == types.float32
        bits, bias, fraction = (32, 127, 23) if is_single else (64, 1023, 52)
        word = ir.IntType(bits)
        biased = builder.add(builder.fptosi(arguments[0], word), ir.Constant(word, bias))
        kind = ir.FloatType() if is_single else ir.DoubleType()
        return builder.bitcast(builder.shl(biased, ir.Constant(word, fraction)), kind)

    return exponent(exponent), code


power_of_2: Any = intrinsic(_power_of_2_code)
"""2^k for a whole k, both as float32 (k of -126 to 127) or as float64 (-1022 to 1023)."""


@inlined
def exp(x: float) -> float:
    """Return e^x with a relative error of 1e-8, for x up to 700; at less than -700: e^-700."""
    x = max(x, _LOWEST)
    whole = np.floor(x * _LOG2_E + 0.5)
    r = x - whole * _LN_2
    series = 1.0 + r * (
        1.0 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * (1 / 5040))))))
    )
    result: float = series * power_of_2(whole)
    return result


@inlined
def erfc(x: float) -> float:
    """Return the complementary error function with a relative error of 1.2e-7 (Press et al. 1992, erfcc)."""
    z = abs(x)
    t = 1.0 / (1.0 + 0.5 * z)
    series = 1.00002368 + t * (
        0.37409196
        + t
        * (
            0.09678418
            + t
            * (
                -0.18628806
                + t * (0.27886807 + t * (-1.13520398 + t * (1.48851587 + t * (-0.82215223 + t * 0.17087277))))
            )
        )
    )
    tail = t * exp(-z * z - 1.26551223 + t * series)
    return tail if x >= 0.0 else 2.0 - tail
