"""Topspin: trains a table-tennis robot to return spinning balls.

Importing this package registers ``topspin/Rally-v0`` for Gymnasium. It offers

    topspin.load_policy("default")      a policy of the box, or of a folder
    topspin.Observer, topspin.BallSample    what a policy observes, from what a robot measures
"""

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.rally.observer import BallSample
    from topspin.observer import Observer
    from topspin.policy import load_policy

__all__ = ["BallSample", "Observer", "load_policy"]


def _is_the_command() -> bool:
    """Return whether this process is the `topspin` command, which has no use for Gymnasium: it loads for 0.15 s."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1 :][:1] if "-m" in words else []
    return module == ["topspin"] or [os.path.basename(path) for path in sys.argv[:1]] == ["topspin"]


if not _is_the_command():
    from topspin.gym_ids import register_envs

    register_envs()


def __getattr__(name: str) -> Any:  # torch takes seconds to import: only when it is needed
    if name == "load_policy":
        from topspin.policy import load_policy  # noqa: PLC0415

        return load_policy
    if name == "BallSample":
        from common.rally.observer import BallSample  # noqa: PLC0415

        return BallSample
    if name == "Observer":
        from topspin.observer import Observer  # noqa: PLC0415

        return Observer
    raise AttributeError(f"module 'topspin' has no attribute {name!r}")
