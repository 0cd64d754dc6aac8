"""Waiting for a condition, as the tests that have threads and processes do it."""

import time

PATIENCE = 3
"""How much longer than its limit a wait may take: limits are those of a quiet machine."""


def wait_until(condition, timeout_s=20.0, what="it"):
    """Return what ``condition()`` returns once it is true; ``what`` is a text, or a function of the moment."""
    deadline = time.monotonic() + PATIENCE * timeout_s
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"waited {PATIENCE * timeout_s} s for {what() if callable(what) else what}")
        time.sleep(0.02)
    return found
