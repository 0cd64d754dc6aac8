"""Which fault comes when: a function of a seed, so that a schedule that found something can be run again."""

import random
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault.

    Args:
        name: As it is printed.
        what: What is done.
        seconds: Shortest and longest time until it is lifted [s]; 0: it is over at once.
        ends: The service that it ends: its name in the history, or "".
        stops_learner: Whether no epoch can be trained until it is lifted.
    """

    name: str
    what: str
    seconds: tuple[float, float] = (0.0, 0.0)
    ends: str = ""
    stops_learner: bool = False


KINDS = (
    Kind("kill_actor", "SIGKILL to an actor", ends="actor"),
    Kind("kill_generator", "SIGKILL to the generator"),
    Kind("kill_evaluator", "SIGKILL to the evaluator"),
    Kind("kill_learner", "SIGKILL to the learner", ends="learner", stops_learner=True),
    Kind("stop_actor", "SIGSTOP to an actor until the watchdog ends it", ends="actor"),
    Kind("stop_generator", "SIGSTOP to the generator until the watchdog ends it"),
    Kind("stop_evaluator", "SIGSTOP to the evaluator until the watchdog ends it"),
    Kind("stop_learner", "SIGSTOP to the learner until the watchdog ends it", ends="learner", stops_learner=True),
    Kind("pause_remote", "SIGSTOP to an actor of another host, longer than every time-out, then SIGCONT", (14, 18)),
    Kind("disk_full", "no space is left in the run folder, checkpoints included", (4, 8)),
    Kind("damaged_checkpoint", "bytes of the newest checkpoint change; learner killed", (0, 0), "learner", True),
    Kind("link_cut", "the cable of another host is out: a network namespace's interface is down", (5, 9)),
    Kind("slow_link", "64 KiB/s and 200 ms between an actor and the hub", (5, 9)),
    Kind("router_kill", "SIGKILL to the router between an actor and the hub", (1, 3)),
    Kind("wrong_contract", "an actor of another network takes part", (6, 9)),
    Kind("second_learner", "a second learner of the run at the hub", (5, 8)),
    Kind("clock_jump", "the wall clock of every process jumps by up to two hours, back or forth", (1, 3)),
    Kind("hung_reader", "a client asks for 100 policies and hangs", (4, 7)),
    Kind("garbage", "a client floods every key of the run with bytes that are no messages", (3, 6)),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a schedule."""

    number: int
    kind: Kind
    seconds: float  # until it is lifted
    pause: float  # [s] before the next one
    dice: float  # [-] 0..1: decides what the kind leaves open, such as which actor


def schedule(seed: int, kinds: Sequence[Kind], count: int) -> list[Fault]:
    """Return ``count`` faults. Every kind comes once before any comes twice, each time in another order."""
    dice = random.Random(seed)
    faults: list[Fault] = []
    while len(faults) < count:
        for kind in dice.sample(list(kinds), len(kinds)):
            seconds, pause = dice.uniform(*kind.seconds), dice.uniform(0.5, 3.0)
            faults.append(Fault(len(faults), kind, seconds, pause, dice.random()))
    return faults[:count]
