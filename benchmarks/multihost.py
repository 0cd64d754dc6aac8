"""A run on several hosts: a router and the learner on one, actors on others; hosts are lost and come back.

    python -m benchmarks.multihost --json
    python -m benchmarks.multihost --learners 2 --json    # a group of learners by torchrun, each on a host of its own

Hosts are network namespaces on one machine, with addresses and cables of their own and no common folder. Each service
is started as the files of `deploy/cluster` start it: by `deploy.topology`, with a settings file of its host. Then the
cable of the first actor host is cut, the second one loses its power, and the learner is killed. Each comes back. In a
group the host of the last learner loses its power, too: torchrun's agents end after a minute, are started again as
systemd would do it, and all learners go on from the checkpoint. The
histories of all services are checked afterwards, as by `benchmarks.chaos`.
"""

import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Final

import psutil
import tomli_w
from pydantic import Field

from benchmarks.chaos.check import NOT_ACCOUNTED, RULES, check, kept_epochs, learners_of, names
from benchmarks.chaos.tail import Tail
from benchmarks.hosts import Host, local_network
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError, StoppedError
from common.service.log import set_up_logging
from common.service.process import DONE
from deploy.topology import role

log = logging.getLogger(__name__)

RUN: Final = "multihost"
PORT: Final = 7447
MEETING_PORT: Final = 29400  # where torchrun's agents meet
ROOT: Final = Path(__file__).parents[1]
MAX_LAG: Final = 2
START_S: Final = 180.0  # kernels may have to be compiled
BACK_S: Final = 60.0
# torchrun counts a dead agent for 15 s. If a group meets within them, the others wait a minute for it, and end
GROUP_BACK_S: Final = 240.0
END_S: Final = 30.0
ENVS: Final = 32
HORIZON: Final = 16


class MultihostConfig(BenchmarkConfig):
    """Train across hosts, lose one after the other, and check that every rollout is accounted for.

    Needs Linux, and the right to make network namespaces.
    """

    actor_hosts: int = Field(2, ge=2, le=16, description="hosts with actors")
    actors: int = Field(2, ge=1, le=16, description="actors of each")
    learners: int = Field(1, ge=1, le=8, description="that train together, each on a host of its own")
    seconds: float = Field(
        20.0, gt=0, description="time of training before each loss", json_schema_extra={"unit": "s"}
    )
    outage_s: float = Field(
        15.0, gt=0, description="how long a host is away", json_schema_extra={"unit": "s"}
    )


@dataclass(slots=True)
class Site:
    """All processes, by name.

    Args:
        folder: With a folder of each host, and the histories.
        hosts: The first has router, learner, evaluator and generator.
        actors: Of each host of ``actor_hosts``.
        learners: Those after the first have the next hosts.
    """

    folder: Path
    hosts: list[Host]
    actors: int
    learners: int = 1
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    agents_again: int = 0  # how often an agent of torchrun was started again
    _learners: list[Tail] = field(default_factory=list)
    _commands: dict[str, tuple[Host, tuple[str, ...]]] = field(default_factory=dict)

    @property
    def history(self) -> Path:
        """The folder of the histories."""
        return self.folder / "history"

    @property
    def actor_hosts(self) -> list[Host]:
        """The hosts with actors."""
        return self.hosts[self.learners :]

    def build(self) -> None:
        """Write the settings of each host, and start everything."""
        self.history.mkdir()
        head, others = self.hosts[0], self.actor_hosts
        settings = {
            "run": RUN,
            "actors": self.actors * len(others),
            "endpoint": f"tcp/{head.address}:{PORT}",
            "metrics_host": "0.0.0.0",
            "network": {"units": [32, 16]},
            "learner": {
                "history": str(self.history),
                "checkpoint_interval_s": 3.0,
                "intake": {"max_lag": MAX_LAG},
                "ppo": {"minibatch": 256, "refit_frames": 1},
                "curriculum": {"stage_1": 150_000, "stage_2": 150_000, "stage_3": 10**12},
            },
            "actor": {"history": str(self.history), "envs": ENVS, "horizon": HORIZON},
            "evaluator": {"rallies": 20, "envs": 10, "interval_s": 2.0},
        }
        for host in self.hosts:
            work = self.folder / host.namespace
            work.mkdir()
            (work / "config.toml").write_text(tomli_w.dumps(settings))
        self.start("router", head, ("deploy.router", "--endpoint", f"tcp/0.0.0.0:{PORT}", "--run", RUN))
        learner = self.arguments("learner", 0, "--auto-resume", "--mode", "client")
        for rank, host in enumerate(self.hosts[: self.learners]):
            self.start(
                f"learner-{rank}", host, self.in_group(host, learner) if self.learners > 1 else learner
            )
        for name in ("evaluator", "generator"):
            self.start(f"{name}-0", head, self.arguments(name, 0))
        numbers = iter(range(self.actors * len(others)))
        for host in others:
            for _ in range(self.actors):
                number = next(numbers)
                self.start(f"actor-{number}", host, self.arguments("actor", number))

    def arguments(self, name: str, number: int, *more: str) -> tuple[str, ...]:
        """Return module and flags of a service."""
        return role(name).arguments(str(number), "config.toml", "0", *more)

    def in_group(self, host: Host, learner: tuple[str, ...]) -> tuple[str, ...]:
        """Return module and flags of torchrun's agent on a host, which starts its learner again and again."""
        return (
            *("torch.distributed.run", "--nnodes", str(self.learners), "--nproc-per-node", "1"),
            *(
                "--rdzv-backend",
                "c10d",
                "--rdzv-id",
                RUN,
                "--max-restarts",
                "100",
                "--local-addr",
                host.address,
            ),
            *("--rdzv-endpoint", f"{self.hosts[0].address}:{MEETING_PORT}"),
            *("--rdzv-conf", f"is_host={int(host is self.hosts[0])}", "-m", "--", *learner),
        )

    def start(self, name: str, host: Host, arguments: tuple[str, ...]) -> None:
        """Start a process on a host; it ends when this one does."""
        self._commands[name] = (host, arguments)
        with (self.folder / f"{name}.log").open("ab") as output:
            self.processes[name] = subprocess.Popen(
                [*host.inside, sys.executable, "-m", "deploy.child", *arguments],
                cwd=self.folder / host.namespace,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ
                | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "eth0"},
            )

    def names_on(self, host: Host) -> list[str]:
        """Return the processes of a host."""
        return [name for name, (place, _) in self._commands.items() if place is host]

    def kill(self, names: Iterable[str]) -> None:
        """Let processes, and what they have started, end at once, as without power."""
        for name in names:
            for child in psutil.Process(self.processes[name].pid).children(recursive=True):
                child.kill()
            self.processes[name].kill()
            self._collect(name, END_S)

    def kill_learner(self) -> None:
        """Let the learner that leads end at once; torchrun's agent, if it has one, stays."""
        if self.learners == 1:
            self.kill(["learner-0"])
            return
        for child in psutil.Process(self.processes["learner-0"].pid).children():
            child.kill()

    def start_learner_again(self) -> None:
        """Start the learner again, unless torchrun's agent does it."""
        if self.learners == 1:
            self.start_again(["learner-0"])

    def start_again(self, names: Iterable[str]) -> None:
        """Start processes as before."""
        for name in names:
            self.start(name, *self._commands[name])

    def end(self) -> None:
        """Stop in order: those that play, the learner, the router."""
        learners = [f"learner-{rank}" for rank in range(self.learners)]
        workers = [name for name in self.processes if name not in {*learners, "router"}]
        for group in (workers, learners, ["router"]):
            for name in group:
                self.processes[name].terminate()
            for name in group:
                self._collect(name, END_S)

    def tear_down(self) -> None:
        """End whatever is left."""
        for name, process in self.processes.items():
            if process.poll() is None:
                self.kill([name])

    def check_alive(self) -> None:
        """Raise ReportedError if a process has ended by itself; torchrun's agents are started again."""
        for name, process in list(self.processes.items()):
            if process.poll() is not None and self.learners > 1 and name.startswith("learner-"):
                log.info("started again name=%s status=%d", name, process.returncode)
                self.agents_again += 1
                self.start_again([name])
            elif process.poll() is not None:
                raise ReportedError(
                    f"{name} ended with status {process.returncode}: {self.folder / name}.log"
                )

    def epochs(self) -> list[dict[str, Any]]:
        """Return what the learners' histories have of each epoch, of all lives."""
        if not self._learners:
            self._learners = [Tail(self.history / f"learner-{rank}.jsonl") for rank in range(self.learners)]
        events = (event for tail in self._learners for event in tail.events())
        return [event for event in events if event["event"] == "trained"]

    def _collect(self, name: str, timeout_s: float) -> None:
        process = self.processes[name]
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout_s)
        if process.stdin is not None:
            process.stdin.close()


def wait(site: Site, stop: Event, seconds: float) -> None:
    """Let the run go on for a while."""
    if stop.wait(seconds):
        raise StoppedError
    site.check_alive()


def wait_for(site: Site, stop: Event, condition: Callable[[], bool], timeout_s: float, what: str) -> float:
    """Wait until ``condition()`` is true; return how long that took [s]."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > timeout_s:
            raise ReportedError(f"waited {timeout_s:.0f} s for {what}: see {site.folder}")
        wait(site, stop, 0.1)
    return time.monotonic() - began


def all_train(site: Site, actors: Iterable[str], since: float) -> bool:
    """Return whether a rollout of each of these actors was trained after ``since`` [s]."""
    trained = {name[0] for epoch in site.epochs() if epoch["t"] > since for name in names(epoch["rollouts"])}
    return {actor.removeprefix("actor-") for actor in actors} <= trained


def lose_and_regain(
    site: Site, config: MultihostConfig, stop: Event
) -> tuple[dict[str, float], Counter[str]]:
    """Lose a link, a host and the learner; return the seconds until all train again, and what was killed how often."""
    cut, dark = site.actor_hosts[:2]
    everybody = [name for name in site.processes if name.startswith("actor-")]
    losses: tuple[tuple[str, list[str], Callable[[], None], Callable[[], None]], ...] = (
        ("cable", site.names_on(cut), lambda: cut.set_cable(False), lambda: cut.set_cable(True)),
        (
            "power",
            site.names_on(dark),
            lambda: site.kill(site.names_on(dark)),
            lambda: site.start_again(site.names_on(dark)),
        ),
        ("learner", everybody, site.kill_learner, site.start_learner_again),
    )
    killed = Counter([*site.names_on(dark), "learner"])
    if site.learners > 1:
        last = site.hosts[site.learners - 1]
        names = site.names_on(last)
        losses += (("learner's host", everybody, lambda: site.kill(names), lambda: site.start_again(names)),)
        killed["learner"] += 1
    back = {}
    for name, actors, lose, regain in losses:
        wait(site, stop, config.seconds)
        log.info("lost what=%s for_s=%.0f", name, config.outage_s)
        lose()
        if stop.wait(config.outage_s):
            raise StoppedError
        regain()
        since = time.monotonic()
        trains = partial(all_train, site, actors, since)
        patience_s = BACK_S if site.learners == 1 else GROUP_BACK_S
        wait_for(site, stop, trains, patience_s, f"{', '.join(actors)} to train again")
        back[name] = round(time.monotonic() - since, 2)
        log.info("back what=%s after_s=%.2f", name, back[name])
    wait(site, stop, config.seconds)
    return back, killed


def figures(site: Site, back: dict[str, float], killed: Counter[str], seconds: float) -> dict[str, Any]:
    """Return what is printed."""
    ended = {
        name.removeprefix("actor-"): count for name, count in killed.items() if name.startswith("actor-")
    }
    result = check(site.history, MAX_LAG, ended, killed["learner"])
    for violation in result.violations:
        log.error("%s: %s (%s)", violation.rule, violation.text, RULES[violation.rule])
    epochs = kept_epochs(learners_of(site.history))
    rollouts = Counter(name[0] for epoch in epochs for name in names(epoch["rollouts"]))
    frames = sum(rollouts.values()) * ENVS * HORIZON
    by_host = {
        host.address: sum(rollouts[name.removeprefix("actor-")] for name in site.names_on(host))
        for host in site.actor_hosts
    }
    return {
        "hosts": len(site.hosts),
        "learners": site.learners,
        "actors": len(site.actor_hosts) * site.actors,
        "frames": frames,
        "frames_per_s": round(frames / seconds),
        "rollouts_trained_by_host": by_host,
        "unaccounted": result.count_of(*NOT_ACCOUNTED),
        "trained_twice": result.count_of("trained_twice"),
        "violations": len(result.violations),
        "agents_started_again": site.agents_again,
        "back_s": back,
        **result.counts,
    }


def main(config: MultihostConfig, stop: Event) -> int:
    """Train, lose, regain, check and print; the status is 1 if something did not hold."""
    set_up_logging("info", "multihost")
    folder = Path(tempfile.mkdtemp(prefix="topspin-multihost-"))
    is_well = False
    with ExitStack() as stack:
        learner_hosts = [f"learner{rank}" for rank in range(1, config.learners)]
        actor_hosts = [f"host{number}" for number in range(config.actor_hosts)]
        hosts = stack.enter_context(local_network(["head", *learner_hosts, *actor_hosts]))
        site = Site(folder, hosts, config.actors, config.learners)
        stack.callback(site.tear_down)
        site.build()
        everybody = [name for name in site.processes if name.startswith("actor-")]
        took = wait_for(site, stop, lambda: all_train(site, everybody, 0.0), START_S, "all actors to train")
        log.info("all hosts train after_s=%.1f folder=%s", took, folder)
        began = time.monotonic()
        back, killed = lose_and_regain(site, config, stop)
        seconds = time.monotonic() - began + took
        site.end()
        result = figures(site, back, killed, seconds)
        is_well = result["violations"] == 0
        print_figures(result, config.json_line)
    if is_well:
        shutil.rmtree(folder)
    else:
        log.warning("histories and logs are in folder=%s", folder)
    return DONE if is_well else 1


if __name__ == "__main__":
    sys.exit(run("multihost", MultihostConfig, main))
