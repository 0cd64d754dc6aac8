"""Kernels on layers' outputs in float32 or bfloat16: ELU into its place, ELU's gradient, observations into their place.

numba has no bfloat16, so such an array comes as its bits (uint16): the upper half of a float32. A kernel reads either
kind, computes in float32, and rounds to the nearest even, as torch does. Torch's own ELU costs 3 times as much and
writes a new array, which a concatenation then copies.
"""

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]  # it has no stubs
from numba import types
from numba.extending import intrinsic

from common.jit import kernel
from common.physics.exponential import power_of_2

# (2^r - 1)/r on [-1/2, 1/2], highest power first: Cephes' exp2f
_C5, _C4, _C3, _C2, _C1, _C0 = (
    np.float32(c)
    for c in (1.5353362e-4, 1.3398874e-3, 9.6184374e-3, 5.5503325e-2, 2.4022648e-1, 6.9314720e-1)
)
_LOG2_E = np.float32(1.4426950408889634)
_LOWEST = np.float32(-87.0)  # exp of less is no normal float32
_0, _HALF, _1 = np.float32(0.0), np.float32(0.5), np.float32(1.0)


def _as_float32_code(_typing: Any, value: Any) -> Any:
    """Return a float32 of a float32, or of the bits of a bfloat16."""

    def code(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if signature.args[0] == types.float32:
            return arguments[0]
        word = ir.IntType(32)
        shifted = builder.shl(builder.zext(arguments[0], word), ir.Constant(word, 16))
        return builder.bitcast(shifted, ir.FloatType())

    return types.float32(value), code


def _rounded_code(_typing: Any, value: Any, like: Any) -> Any:
    """Return a float32 in the form of ``like``: float32, or the bits of a bfloat16, rounded to the nearest even."""

    def code(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if signature.args[1] == types.float32:
            return arguments[0]
        word = ir.IntType(32)
        bits = builder.bitcast(arguments[0], word)
        odd = builder.and_(builder.lshr(bits, ir.Constant(word, 16)), ir.Constant(word, 1))
        bits = builder.add(builder.add(bits, ir.Constant(word, 0x7FFF)), odd)
        return builder.trunc(builder.lshr(bits, ir.Constant(word, 16)), ir.IntType(16))

    return like(value, like), code


def _fma_code(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c of float32s, rounded once."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float32(types.float32, types.float32, types.float32), code


_as_float32: Any = intrinsic(_as_float32_code)
_rounded: Any = intrinsic(_rounded_code)
_fma: Any = intrinsic(
    _fma_code
)  # one instruction on every CPU since 2013; written out, so that bits do not depend on it


@kernel
def elu(inputs: Any, outputs: Any, width: int) -> None:
    """Write ELU of the first ``width`` columns of ``inputs`` (N, ...) into those of ``outputs`` (N or more, ...)."""
    for i in range(len(inputs)):
        source, target = inputs[i], outputs[i]
        for j in range(width):
            x = _as_float32(source[j])
            scaled = max(min(x, _0), _LOWEST) * _LOG2_E
            whole = np.floor(scaled + _HALF)
            r, power = scaled - whole, power_of_2(whole)
            rest = _fma(_fma(_fma(_fma(_fma(_C5, r, _C4), r, _C3), r, _C2), r, _C1), r, _C0)
            y = _fma(rest * r, power, power - _1)  # exp(x) - 1, without loss of digits near 0
            target[j] = _rounded(x if x > _0 else y, source[j])


@kernel
def elu_gradient(outputs: Any, gradient: Any, width: int) -> None:
    """Multiply the first ``width`` columns of ``gradient`` (N, ...) by ELU's slope, given those of its outputs."""
    for i in range(len(gradient)):
        y, g = outputs[i], gradient[i]
        for j in range(width):
            slope = _as_float32(g[j])
            g[j] = _rounded(_fma(min(_as_float32(y[j]), _0), slope, slope), g[j])


@kernel
def place(source: Any, width: int, target: Any, offset: int) -> None:
    """Copy the first ``width`` columns of ``source`` (N, ...) to the columns of ``target`` from ``offset`` on."""
    for i in range(len(source)):
        row, out = source[i], target[i][offset:]
        for j in range(width):
            out[j] = row[j]
