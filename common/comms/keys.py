"""Every key the services use, and how a key expression matches a key.

topspin/v1/<run>/policy                          latest policy: put as a hint, late joiners ask for it
topspin/v1/<run>/stage                           stage changes: put as a hint, upon which an actor asks for the
                                                 policy, which says its stage; all of them for whoever asks
topspin/v1/<run>/rollout                         rollouts: requests to the learner, the verdict is the reply
topspin/v1/<run>/rally/<shard>                   valid rallies: put in batches, or asked for by index
topspin/v1/<run>/ctl/<role>/<id>                 commands to one service; actors' reports to the learner
topspin/v1/<run>/alive/<role>/<id>/<incarnation> liveliness tokens
topspin/v1/<run>/status/<role>/<id>              heartbeats with cumulative counters
"""

import re
from dataclasses import dataclass
from typing import Final

PREFIX: Final = "topspin/v1"
ROLES: Final = ("generator", "actor", "learner", "evaluator")

# Neither wildcards (* $ # ?), separators (/) nor Zenoh's verbatim mark (@) can stand in a part.
_PART: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class KeyPartError(ValueError):
    """A run, role, id or number that can't stand in a key."""


@dataclass(frozen=True, slots=True)
class Member:
    """One life of one service, as its liveliness token names it."""

    role: str
    id: str
    incarnation: int


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one run. Raises KeyPartError for a name that can't stand in a key."""

    run: str

    def __post_init__(self) -> None:
        _part("run", self.run)

    def policy(self) -> str:
        """Return the key of the latest policy."""
        return f"{PREFIX}/{self.run}/policy"

    def stage(self) -> str:
        """Return the key of stage changes."""
        return f"{PREFIX}/{self.run}/stage"

    def rollout(self) -> str:
        """Return the key that rollouts are sent to."""
        return f"{PREFIX}/{self.run}/rollout"

    def rally(self, shard: int) -> str:
        """Return the key of the valid rallies of one shard (0, 1, ...)."""
        return f"{PREFIX}/{self.run}/rally/{_number('shard', shard)}"

    def ctl(self, role: str, id_: str) -> str:
        """Return the key of requests to one service."""
        return f"{PREFIX}/{self.run}/ctl/{_role(role)}/{_part('id', id_)}"

    def alive(self, role: str, id_: str, incarnation: int) -> str:
        """Return the key of the liveliness token of one life of a service."""
        life = _number("incarnation", incarnation)
        return f"{PREFIX}/{self.run}/alive/{_role(role)}/{_part('id', id_)}/{life}"

    def every_alive(self) -> str:
        """Return the expression that matches all liveliness tokens of the run."""
        return f"{PREFIX}/{self.run}/alive/**"

    def status(self, role: str, id_: str) -> str:
        """Return the key of one service's heartbeats."""
        return f"{PREFIX}/{self.run}/status/{_role(role)}/{_part('id', id_)}"

    def every_status(self) -> str:
        """Return the expression that matches all heartbeats of the run."""
        return f"{PREFIX}/{self.run}/status/**"

    def member(self, alive_key: str) -> Member:
        """Return who a liveliness key of this run belongs to."""
        head, _, rest = alive_key.partition(f"{PREFIX}/{self.run}/alive/")
        parts = rest.split("/")
        if head or len(parts) != 3 or not parts[2].isdigit():
            raise KeyPartError(
                f"key {alive_key!r} is not {PREFIX}/{self.run}/alive/<role>/<id>/<incarnation>"
            )
        return Member(role=_role(parts[0]), id=_part("id", parts[1]), incarnation=int(parts[2]))


def matches(key_expr: str, key: str) -> bool:
    """Return whether ``key`` is one of ``key_expr``: ``*`` stands for one chunk, ``**`` for any number."""
    return _chunks_match(key_expr.split("/"), key.split("/"))


def _chunks_match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_chunks_match(pattern[1:], chunks[skipped:]) for skipped in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _chunks_match(pattern[1:], chunks[1:])


def _part(name: str, value: str) -> str:
    if _PART.fullmatch(value) is None:
        raise KeyPartError(
            f"{name} {value!r} can't stand in a key; allowed: 1 to 64 letters, digits, '.', '_', '-', "
            "the first a letter or a digit"
        )
    return value


def _role(value: str) -> str:
    if value not in ROLES:
        raise KeyPartError(f"unknown role {value!r}; allowed: {', '.join(ROLES)}")
    return value


def _number(name: str, value: int) -> int:
    if value < 0:
        raise KeyPartError(f"{name} {value} can't stand in a key; allowed: 0 and above")
    return value
