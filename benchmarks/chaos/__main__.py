"""`python -m benchmarks.chaos`: break a run on purpose, and check that every promise held."""

import logging
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import Any, Final

from pydantic import Field

from benchmarks.chaos.check import NOT_ACCOUNTED, RULES, Result, check
from benchmarks.chaos.faults import make
from benchmarks.chaos.schedule import KINDS, Fault, schedule
from benchmarks.chaos.site import MAX_LAG, Site
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import StoppedError
from common.service.log import set_up_logging
from common.service.process import DONE

log = logging.getLogger(__name__)

PATIENCE_S: Final = 60.0  # for an epoch after a fault that ended the learner
SHOWN: Final = 20
MOST_FAULTS: Final = 10_000


class ChaosConfig(BenchmarkConfig):
    """Break a real run of many processes by a seeded schedule of faults; check the histories that they wrote.

    Needs Linux. Faults that need privileges (a full disk, a cut cable) are left out without them, with the reason.
    """

    minutes: float = Field(
        10.0, gt=0, description="duration of the schedule", json_schema_extra={"unit": "min"}
    )
    faults: int = Field(0, ge=0, description="number of faults; 0: as many as the time allows")
    seed: int = Field(0, ge=0, description="of the schedule: the same seed makes the same faults")
    kinds: tuple[str, ...] = Field((), description="kinds of fault; empty: all")
    keep: bool = Field(False, description="keep the folder with histories and logs also if all is well")


@dataclass(slots=True)
class Happened:
    """A fault that was made. Times are of the monotonic clock [s]."""

    fault: Fault
    began: float
    lifted: float
    ended: str


def break_it(site: Site, config: ChaosConfig, faults: list[Fault], stop: Event) -> list[Happened]:
    """Make the faults one after the other, until the time is over."""
    done: list[Happened] = []
    deadline = time.monotonic() + 60.0 * config.minutes
    for fault in faults:
        if time.monotonic() > deadline:
            break
        began = time.monotonic()
        made = make(site, fault)
        wait(site, fault.seconds, stop)
        made.lift()
        lifted = time.monotonic()
        done.append(Happened(fault, began, lifted, made.ended))
        log.info(
            "fault=%d kind=%s ended=%s seconds=%.1f left_min=%.1f",
            fault.number + 1,
            fault.kind.name,
            made.ended or "-",
            lifted - began,
            max(0.0, deadline - lifted) / 60.0,
        )
        if fault.kind.stops_learner:
            site.wait_for(partial(has_trained, site, lifted), PATIENCE_S, f"an epoch after {fault.kind.name}")
        wait(site, fault.pause, stop)
    return done


def has_trained(site: Site, since: float) -> bool:
    """Return whether an epoch was trained after ``since`` [s]."""
    return site.last_epoch() > since


def wait(site: Site, seconds: float, stop: Event) -> None:
    """Wait, while outside actors that end are started again."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if stop.wait(min(left, 0.2)):
            raise StoppedError
        site.keep_up()


def stalls(result: Result, done: list[Happened], last: float) -> float:
    """Return the longest time without an epoch while the learner was sound [s].

    It is not sound from a fault that stops it until its next life is ready.
    """
    unsound = []
    for happened in done:
        if happened.fault.kind.stops_learner:
            ready = min((start for start in result.starts if start > happened.began), default=last)
            unsound.append((happened.began, ready))
    longest = 0.0
    times = [*result.epoch_times, last]
    for before, after in pairwise(times):
        cut = sum(max(0.0, min(after, end) - max(before, begin)) for begin, end in unsound)
        longest = max(longest, after - before - cut)
    return longest


def recoveries(result: Result, done: list[Happened]) -> dict[str, float]:
    """Return the longest time from the end of a fault to the next epoch [s], by kind."""
    longest: dict[str, float] = {}
    for happened in done:
        after = [when for when in result.epoch_times if when > happened.lifted]
        if after:
            name = happened.fault.kind.name
            longest[name] = round(max(longest.get(name, 0.0), after[0] - happened.lifted), 2)
    return longest


def figures(config: ChaosConfig, site: Site, done: list[Happened], last: float) -> dict[str, Any]:
    """Return what is printed."""
    ended = Counter(happened.ended for happened in done if happened.ended)
    actors = {
        name.removeprefix("actor-"): count for name, count in ended.items() if name.startswith("actor-")
    }
    result = check(site.history, MAX_LAG, actors, ended["learner-0"])
    for violation in result.violations[:SHOWN]:
        log.error("%s: %s (%s)", violation.rule, violation.text, RULES[violation.rule])
    recovered = recoveries(result, done)
    return {
        "faults": len(done),
        "fault_kinds": len({happened.fault.kind.name for happened in done}),
        "unaccounted": result.count_of(*NOT_ACCOUNTED),
        "trained_twice": result.count_of("trained_twice"),
        "violations": len(result.violations),
        "violations_by_rule": dict(Counter(violation.rule for violation in result.violations)),
        "stalled_s_max": round(stalls(result, done, last), 2),
        "recovery_s_max": max(recovered.values(), default=0.0),
        "recovery_s": recovered,
        "skipped": site.skipped,
        **result.counts,
        "outside_restarts": sum(outsider.restarts for outsider in site.outsiders.values()),
        "seed": config.seed,
        "minutes": config.minutes,
    }


def main(config: ChaosConfig, stop: Event) -> int:
    """Break, check, and print; the status is 1 if something did not hold."""
    set_up_logging("info", "chaos")
    site = Site(Path(tempfile.mkdtemp(prefix="topspin-chaos-")))
    is_well = False
    try:
        log.info("building the run folder=%s", site.folder)
        site.build(config.seed)
        kinds = [
            kind
            for kind in KINDS
            if kind.name not in site.skipped and (not config.kinds or kind.name in config.kinds)
        ]
        for name, reason in site.skipped.items():
            log.warning("left out kind=%s reason=%s", name, reason)
        done = break_it(site, config, schedule(config.seed, kinds, config.faults or MOST_FAULTS), stop)
        last = time.monotonic()
        site.end()
        result = figures(config, site, done, last)
        is_well = result["violations"] == 0
        print_figures(result, config.json_line)
    finally:
        site.tear_down()
        if is_well and not config.keep:
            shutil.rmtree(site.folder, ignore_errors=True)
        else:
            log.warning("histories and logs are in folder=%s", site.folder)
    return DONE if is_well else 1


if __name__ == "__main__":
    sys.exit(run("chaos", ChaosConfig, main))
