"""The number of one life of a run's learner. It depends on no clock.

A generation is how many learners the run has had, then 20 random bits. So a restarted learner is newer than all before
it, and two learners that were started from copies of one folder differ.
"""

import secrets
from pathlib import Path
from typing import Final

from common.service.whole_file import write_whole

NOISE_BITS: Final = 20
HIGHEST: Final = 2**62 - 1  # that a message holds


def following(earlier: int, noise: int) -> int:
    """Return the generation after ``earlier`` (0: none), with ``noise`` of 20 bits."""
    return min(((earlier >> NOISE_BITS) + 1) << NOISE_BITS | noise, HIGHEST)


def next_generation(file: Path, in_checkpoint: int) -> int:
    """Return the generation of a learner that starts now, and record it in the run folder's ``file``."""
    try:
        recorded = int(file.read_text(encoding="ascii"))
    except (OSError, ValueError):  # a new run, or a damaged file
        recorded = 0
    found = following(max(recorded, in_checkpoint), secrets.randbits(NOISE_BITS))
    write_whole(file, f"{found}\n")
    return found


def yields(own: int, other: int, age_s: float, settling_s: float) -> bool:
    """Return whether a learner must end because of another learner's token.

    A learner that starts waits for the tokens of others first, so the older one stays. Of two that start at the same
    time, the lower generation ends.

    Args:
        own: Its generation.
        other: The other's.
        age_s: Time since its own token stands [s].
        settling_s: Longest time that a token takes to arrive [s].
    """
    return age_s < settling_s and own < other
