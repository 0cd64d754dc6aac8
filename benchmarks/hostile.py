"""What a hostile peer can do to a run: attacks on a real one, and everything that a role may not say.

    python -m benchmarks.hostile --json           # with TLS: the peer owns the certificate of an actor
    python -m benchmarks.hostile --json --open    # without

A run of real processes trains. A process of its own attacks it, one attack after the other, and another one asks the
learner all the time, to see how long it answers nothing. An attack stops training if no epoch follows it within
90 s, or if a process of the run dies. Then the next attack meets a new run.
"""

import dataclasses
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event
from typing import Any, Final

from pydantic import Field

from benchmarks.attacker import NAME, Attacker, open_session
from benchmarks.attacks import ATTACKS
from benchmarks.role_trials import allowed, try_all
from benchmarks.settings import BenchmarkConfig, print_figures, run
from benchmarks.victim import EPOCHS, Victim, beside
from common.comms.codec import decode
from common.comms.keys import Keys
from common.comms.messages import PolicySnapshot
from common.comms.roles import OPERATOR_NAME, Rights, rights_of
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.policy.config import NetworkConfig
from common.service.process import DONE
from common.service.run_folder import LATEST, RUNS, RunFolder
from deploy.config import DeployConfig
from deploy.prepare import free_endpoint
from services.actor.config import ActorOptions
from services.learner.config import CurriculumConfig, LearnerOptions, PPOConfig
from topspin.certs import CertsConfig, write

GOES_ON_S: Final = 90.0  # longest wait for an epoch after an attack
SEND_S: Final = 60.0  # longest time to send an attack
HOLD_S: Final = 1.0  # time that an attack stands
ASK_S: Final = 5.0
MIB: Final = 2**20
TRIED_NAMES: Final = ("learner-0", "actor-0", "generator-0", "evaluator-0", OPERATOR_NAME)


class HostileConfig(BenchmarkConfig):
    """Attack a run that trains: does it go on, what does it cost, and is what a role may not say dropped?"""

    open_hub: bool = Field(
        False, alias="open", description="without TLS: the peer may forge what others say; no roles are tried"
    )
    only: str = Field("", description="attacks whose name contains this; empty: all")
    keep: bool = Field(False, description="keep the run folders")


@dataclass(frozen=True, slots=True)
class Effect:
    """What one attack did to the run."""

    name: str
    stopped: bool
    memory_mib: float  # growth of the learner's memory
    stall_s: float  # longest time for an answer of the learner
    quiet_s: float  # the same before the attack: what the machine's other work costs
    epochs: int  # trained while the attack stood


def attack(name: str, link: ZenohConfig, run_name: str, line: "Connection[Any, Any]") -> None:
    """Attack, say so, and stand until this process is ended."""
    keys = Keys(run_name)
    session = open_session(link, NAME if link.tls else "")
    policy = None
    for reply in session.get(keys.policy(), timeout=ASK_S):
        if reply.ok is not None:
            policy = decode(reply.ok.payload.to_bytes(), PolicySnapshot)
    if policy is None:
        raise ReportedError("the learner did not answer")
    line.send("ready")
    line.recv()
    ATTACKS[name].send(attacker := Attacker(session, link, keys, policy))
    line.send("sent")
    line.recv()
    attacker.kept.clear()


def suffer(victim: Victim, name: str) -> Effect:
    """Return the effect of one attack on a run."""
    with beside(attack, name, victim.link, victim.name) as line:
        victim.wait(lambda: line.has_word, 60.0, f"a link for {name!r}")
        line.hear()
        quiet = victim.stall_s()
        epochs, memory, deaths = victim.epochs(), victim.memory(), victim.deaths()
        seen = [memory]

        def is_sent() -> bool:
            seen.append(victim.memory())
            return line.has_word

        def holds() -> bool:
            seen.append(victim.memory())
            return False

        line.tell()
        victim.comes(is_sent, SEND_S)  # one that takes longer is as good an attack
        if hang_s := ATTACKS[name].hang_s:
            os.kill(line.pid, signal.SIGSTOP)
        victim.comes(holds, HOLD_S + hang_s)
    after = victim.epochs()
    victim.comes(lambda: victim.epochs() >= after + EPOCHS or victim.deaths() > deaths, GOES_ON_S)
    stopped = victim.epochs() < after + EPOCHS or victim.deaths() > deaths
    growth = round((max(seen) - memory) / MIB, 1)
    return Effect(name, stopped, growth, round(victim.stall_s(), 3), round(quiet, 3), after - epochs)


def deploy_config(tls: str, number: int) -> DeployConfig:
    """Return the settings of a small run that trains for long."""
    return DeployConfig(
        run=time.strftime(f"hostile-%Y%m%d-%H%M%S-{number}"),
        tls=tls,
        evaluate=False,
        panel="off",
        network=NetworkConfig(units=(32, 16)),
        actor=ActorOptions(envs=32, horizon=16),
        learner=LearnerOptions(
            ppo=PPOConfig(minibatch=256, refit_frames=1),
            curriculum=CurriculumConfig(stage_1=10**9),
        ),
    )


def certificates(folder: Path) -> str:
    """Make the certificates of the run, of the hostile actor and of the one that asks; return their folder."""
    out = folder / "certs"
    write(CertsConfig(out=str(out), actors=2))
    write(CertsConfig(out=str(out), add=(NAME,)))
    return str(out)


def attacked(names: list[str], tls: str, keep: bool, stop: Event) -> list[Effect]:
    """Return the effect of each attack."""
    effects: list[Effect] = []
    runs = 0
    while len(effects) < len(names):
        with ExitStack() as stack:
            config = deploy_config(tls, runs)
            if not keep:
                stack.callback(shutil.rmtree, RunFolder.of(config.run).root, ignore_errors=True)
            runs += 1
            victim = Victim(config, stop, stack)
            for name in names[len(effects) :]:
                effects.append(effect := suffer(victim, name))
                print(
                    f"{len(effects):3}/{len(names)} {name:32} {'STOPPED' if effect.stopped else 'goes on'} "
                    f"epochs {effect.epochs:4} memory {effect.memory_mib:7.1f} MiB stall {effect.stall_s:.3f} s "
                    f"(before {effect.quiet_s:.3f} s)",
                    file=sys.stderr,
                    flush=True,
                )
                if effect.stopped:
                    break
    if not keep and (RUNS / LATEST).is_symlink() and not (RUNS / LATEST).exists():
        (RUNS / LATEST).unlink()
    return effects


def roles(folder: Path) -> tuple[int, int, list[str]]:
    """Return how many messages that a role may not say were tried, how many were dropped, and which were not."""
    out, keys = folder / "roles", Keys("roles")
    write(CertsConfig(out=str(out)))
    link = ZenohConfig(endpoint=free_endpoint("tls"), tls=str(out))
    hub = open_zenoh(link.model_copy(update={"mode": "hub"}), name="learner-0", run=keys.run)
    write(CertsConfig(out=str(out), add=(NAME,)))  # the hub does not know it
    tried_count, passed_names = 0, []
    for name in (*TRIED_NAMES, NAME):
        rights = Rights() if name == NAME else rights_of(name, keys)
        tried, passed = try_all(
            hub,
            partial(open_session, link, name),
            partial(open_zenoh, link, name=name),
            *(keys, name.partition("-")[2], rights),
        )
        forbidden = {trial for trial in tried if not allowed(rights, trial)}
        tried_count += len(forbidden)
        passed_names += [f"{name} {verb} {key}" for verb, key in sorted(forbidden & passed)]
    hub.close()
    return tried_count, tried_count - len(passed_names), passed_names


def main(config: HostileConfig, stop: Event) -> int:
    """Attack and print."""
    names = [name for name in ATTACKS if config.only in name]
    folder = Path(tempfile.mkdtemp(prefix="topspin-hostile-"))
    try:
        tls = "" if config.open_hub else certificates(folder)
        effects = attacked(names, tls, config.keep, stop)
        tried, denied, passed = (0, 0, []) if config.open_hub else roles(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    figures = {
        "attacks": len(effects),
        "stopped_training": sum(effect.stopped for effect in effects),
        "memory_mib_max": max(effect.memory_mib for effect in effects),
        "learner_stall_s_max": max(effect.stall_s for effect in effects),
        "quiet_stall_s_max": max(effect.quiet_s for effect in effects),
        "roles_tried": tried,
        "roles_denied": denied,
        "tls": not config.open_hub,
        "stopped_by": [effect.name for effect in effects if effect.stopped],
        "roles_passed": passed,
        "by_attack": [dataclasses.asdict(effect) for effect in effects],
    }
    shown = {name: value for name, value in figures.items() if name != "by_attack"}
    print_figures(shown, as_json=False)
    if config.json_line:
        print(json.dumps(figures))
    return DONE


if __name__ == "__main__":
    sys.exit(run("hostile", HostileConfig, main))
