"""One entry for a program that is no Python: begin a rally, observe it, play a control step.

These are the kernels of training and evaluation, compiled once more. Nothing of the rally is written twice.
"""

from itertools import count
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from common.env.rally_env import draw_robot
from common.rally.observe import observe
from common.rally.step import launch_rallies, play_step
from topspin.web.values import COLUMNS, Values, expression

BEGIN, OBSERVE, PLAY = range(3)
"""What the entry does: a new rally from ``launch`` and ``seed``; ``obs``; a step with ``motion`` and ``actions``."""


@intrinsic
def pointer(_: Any, address: types.Type) -> Any:
    """Return an integer as a pointer, for ``numba.carray``."""

    def code(_: Any, builder: ir.IRBuilder, __: Any, values: list[ir.Value]) -> ir.Value:
        return builder.inttoptr(values[0], ir.IntType(8).as_pointer())

    return types.voidptr(address), code


@numba.njit(error_model="numpy", forceinline=True)  # it is compiled into the entry alone: no cache
def do(what: int, values: Values) -> None:
    """Begin, observe or play."""
    if what == BEGIN:
        launch_rallies(values.rallies, values.rows, values.launch, values.seed, values.profile)
        draw_robot(values.seed, values.profile, 0.0, values.spread, values.gains, values.offset)
    elif what == OBSERVE:
        observe(
            values.rallies,
            values.rows,
            values.joint_pos,
            values.joint_vel,
            values.rules.chain,
            values.flags,
            values.obs,
        )
    else:
        play_step(values.rallies, values.motion, values.actions, values.rules, values.profile, values.step)


def entry_ir(values: Values) -> str:
    """Return LLVM's text of a function (what, address of a block), compiled for this machine's processor.

    Args:
        values: Any task's: types and numbers of axes are the same for all.
    """
    rows = count()
    call = f"do(what, {expression(values, rows)})"
    table = f"carray(pointer(address), ({next(rows)}, {COLUMNS}), int64)"
    names: dict[str, Any] = {kind.__name__: kind for kind in _kinds(values)}
    names |= {name: getattr(np, name) for name in ("float32", "float64", "int64", "uint64", "bool")}
    names |= {"carray": carray, "pointer": pointer, "do": do}
    exec(f"def entry(what, address):\n    table = {table}\n    {call}\n", names)
    compiled = numba.cfunc(types.void(types.int64, types.int64), error_model="numpy")(names["entry"])
    text: str = compiled.inspect_llvm()
    return text


def _kinds(value: Any) -> set[type]:
    """Return the named tuples of nested tuples."""
    found = {type(value)} if hasattr(value, "_fields") else set()
    return found.union(*(_kinds(part) for part in value)) if isinstance(value, tuple) else set()
