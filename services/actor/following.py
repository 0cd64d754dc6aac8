"""Which learner an actor follows, as a value.

A learner counts while its liveliness token stands. Its generation is a name and no rank: an actor stays with the
learner whose policy it plays as long as that token stands, whatever another one claims, and takes the policy of the
next one afterwards.
"""

from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Following:
    """The learners whose tokens stand, and the one whose policy the actor plays."""

    standing: frozenset[int] = frozenset()  # generations
    followed: int | None = None

    @property
    def is_led(self) -> bool:
        """Whether the followed learner lives."""
        return self.followed in self.standing


def noted(following: Following, generation: int, is_alive: bool) -> Following:
    """Return the state after a learner's token appeared or ended."""
    change = {generation}
    standing = following.standing | change if is_alive else following.standing - change
    return replace(following, standing=standing)


def adopted(following: Following, generation: int) -> Following:
    """Return the state after a policy of this learner was taken."""
    return replace(following, followed=generation)


def objection(following: Following, generation: int) -> str:
    """Return why a policy or verdict of this learner is not taken, or ""."""
    if generation not in following.standing:
        return f"generation {generation} has no live learner"
    if following.is_led and generation != following.followed:
        return (
            f"generation {generation} is not that of the followed learner, {following.followed}, which lives"
        )
    return ""


def no_learner(run: str, has_tls: bool) -> str:
    """Return what an actor waits for while its run has no learner."""
    unknown = ", or the hub does not know this certificate" if has_tls else ""
    return f"a learner: run {run!r} has none at the hub{unknown}"
