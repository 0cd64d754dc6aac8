"""All keys of the services, and the matching of key expressions with keys.

topspin/v3/<run>/policy                          latest policy: put as a hint; late joiners request it
topspin/v3/<run>/stage                           stage changes: put as a hint; an actor then requests the policy,
                                                 which contains its stage. A request returns all changes
topspin/v3/<run>/rollout/<rank>/<actor>          rollouts of one actor: requests to its learner; the reply is the
                                                 verdict
topspin/v3/<run>/report/<rank>/<actor>           reports of one actor: requests to its learner; the reply is a
                                                 verdict with new credits
topspin/v3/<run>/join                            requests of actors that have no number yet; the reply is a place
topspin/v3/<run>/rally/<shard>                   valid rallies: put in batches, or requested by index
topspin/v3/<run>/ctl/<role>/<id>                 commands to one service
topspin/v3/<run>/alive/<role>/<id>/<incarnation> liveliness tokens
topspin/v3/<run>/status/<role>/<id>              heartbeats with cumulative counters

A key names its sender wherever a certificate can stand for it (`common.comms.roles`). Receivers refuse a message that
names another one.
"""

import re
import zlib
from dataclasses import dataclass
from typing import Final

from common.comms.budgets import ID_PATTERN, one_line
from common.errors import ConfigError

PREFIX: Final = "topspin/v3"
ROLES: Final = ("generator", "actor", "learner", "evaluator")

# A part contains no wildcard (* $ # ?), no separator (/) and not Zenoh's verbatim mark (@).
_PART: Final = re.compile(ID_PATTERN)
_LAST_NUMBER: Final = re.compile(r"[0-9]+$")
LONGEST_NUMBER: Final = 19  # digits of an incarnation: it fits into 64 bits


class KeyPartError(ConfigError):
    """A run, role, id or number that is not allowed in a key."""


@dataclass(frozen=True, slots=True)
class Member:
    """One incarnation of one service, as named by its liveliness token."""

    role: str
    id: str
    incarnation: int


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one run. Raises KeyPartError for a name that is not allowed in a key."""

    run: str

    def __post_init__(self) -> None:
        _part("run", self.run)

    def policy(self) -> str:
        """Return the key of the latest policy."""
        return f"{PREFIX}/{self.run}/policy"

    def stage(self) -> str:
        """Return the key of stage changes."""
        return f"{PREFIX}/{self.run}/stage"

    def join(self) -> str:
        """Return the key on which an actor asks for its number and its settings."""
        return f"{PREFIX}/{self.run}/join"

    def rollout(self, actor: str, rank: int = 0) -> str:
        """Return the key for the rollouts of one actor to a learner of this rank."""
        return f"{PREFIX}/{self.run}/rollout/{_number('rank', rank)}/{_part('id', actor)}"

    def every_rollout(self, rank: int = 0) -> str:
        """Return the expression that matches the rollouts of all actors to a learner of this rank."""
        return f"{PREFIX}/{self.run}/rollout/{_number('rank', rank)}/*"

    def rollouts_to_any(self, actor: str) -> str:
        """Return the expression that matches the rollouts of one actor to any learner."""
        return f"{PREFIX}/{self.run}/rollout/*/{_part('id', actor)}"

    def report(self, actor: str, rank: int = 0) -> str:
        """Return the key for the reports of one actor to a learner of this rank."""
        return f"{PREFIX}/{self.run}/report/{_number('rank', rank)}/{_part('id', actor)}"

    def every_report(self, rank: int = 0) -> str:
        """Return the expression that matches the reports of all actors to a learner of this rank."""
        return f"{PREFIX}/{self.run}/report/{_number('rank', rank)}/*"

    def reports_to_any(self, actor: str) -> str:
        """Return the expression that matches the reports of one actor to any learner."""
        return f"{PREFIX}/{self.run}/report/*/{_part('id', actor)}"

    def rally(self, shard: int) -> str:
        """Return the key of the valid rallies of one shard (0, 1, ...)."""
        return f"{PREFIX}/{self.run}/rally/{_number('shard', shard)}"

    def every_rally(self) -> str:
        """Return the expression that matches the valid rallies of all shards."""
        return f"{PREFIX}/{self.run}/rally/*"

    def ctl(self, role: str, id_: str) -> str:
        """Return the key of commands to one service."""
        return f"{PREFIX}/{self.run}/ctl/{_role(role)}/{_part('id', id_)}"

    def every_ctl(self) -> str:
        """Return the expression that matches the commands to all services."""
        return f"{PREFIX}/{self.run}/ctl/*/*"

    def alive(self, role: str, id_: str, incarnation: int) -> str:
        """Return the key of the liveliness token of one incarnation of a service."""
        number = _number("incarnation", incarnation)
        return f"{PREFIX}/{self.run}/alive/{_role(role)}/{_part('id', id_)}/{number}"

    def every_alive(self) -> str:
        """Return the expression that matches all liveliness tokens of the run."""
        return f"{PREFIX}/{self.run}/alive/**"

    def every_life_of(self, role: str, id_: str) -> str:
        """Return the expression that matches the liveliness tokens of one service."""
        return f"{PREFIX}/{self.run}/alive/{_role(role)}/{_part('id', id_)}/*"

    def everything(self) -> str:
        """Return the expression that matches all keys of the run."""
        return f"{PREFIX}/{self.run}/**"

    def status(self, role: str, id_: str) -> str:
        """Return the key of one service's heartbeats."""
        return f"{PREFIX}/{self.run}/status/{_role(role)}/{_part('id', id_)}"

    def every_status(self) -> str:
        """Return the expression that matches all heartbeats of the run."""
        return f"{PREFIX}/{self.run}/status/**"

    def sender(self, key: str) -> str:
        """Return the id in the last part of a key: who sends on it."""
        return _part("id", key.rpartition("/")[2])

    def member(self, alive_key: str) -> Member:
        """Return the owner of a liveliness key of this run."""
        head, _, rest = alive_key.partition(f"{PREFIX}/{self.run}/alive/")
        parts = rest.split("/")
        if head or len(parts) != 3 or not parts[2].isdigit() or len(parts[2]) > LONGEST_NUMBER:
            raise KeyPartError(
                f"key {one_line(alive_key, 200)!r} is not {PREFIX}/{self.run}/alive/<role>/<id>/<incarnation>"
            )
        return Member(role=_role(parts[0]), id=_part("id", parts[1]), incarnation=int(parts[2]))


def rank_of(actor: str, ranks: int) -> int:
    """Return the rank of the learner that an actor sends its rollouts to, of a group with so many ranks.

    Actors that are numbered one after another are divided evenly.
    """
    number = _LAST_NUMBER.search(actor)
    return (int(number[0]) if number else zlib.crc32(actor.encode())) % ranks


def matches(key_expr: str, key: str) -> bool:
    """Return whether ``key_expr`` matches ``key``: ``*`` matches one chunk, ``**`` any number of chunks."""
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
