"""Trainings that a study needs: each is made once, goes on where it was stopped, and leaves what its table needs.

A training is the run runs/NAME. Of one that ended, settings, curve and the measures of its last policy are copied to
benchmarks/results/runs/NAME, which a clone of the repository has. Whatever is in either folder is not trained again,
and measures under other conditions than the training's own (``examined``) are not made again.
"""

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple

from common.errors import ReportedError
from common.service.config import to_tables
from common.service.config_sources import read_toml
from common.service.run_folder import RunFolder
from common.service.whole_file import write_whole
from deploy.config import SECTION, settings
from topspin.report.groups import experiment

KEPT: Final = Path(__file__).parent / "results" / "runs"
LOOK_S: Final = 1.0
# Enough points for a curve; more often costs up to 7 % of the frames
CURVE: Final = ("--evaluator.interval-s", "120")
BY_NAME: Final = ("seed", "frames")  # settings that make no other experiment, but other figures


class Wanted(NamedTuple):
    """One training of a study."""

    name: str  # of its run
    flags: tuple[str, ...]  # of ``topspin train``


def is_measured(folder: RunFolder) -> bool:
    """Return whether a run has trained to its end: one that was stopped leaves a summary without rates."""
    return "return_rate" in _final(folder)


def _final(folder: RunFolder) -> dict[str, Any]:
    """Return a run's summary with the measures of its last policy; {} if it has not ended."""
    found: dict[str, Any] = (
        json.loads(folder.final.read_text(encoding="utf-8")) if folder.final.is_file() else {}
    )
    return found


def made(wanted: Wanted) -> RunFolder | None:
    """Return the folder of a training that has ended, or None.

    Raises:
        ReportedError: The run of its name is another training.
    """
    for folder in (RunFolder.of(wanted.name), RunFolder(KEPT / wanted.name)):
        if is_measured(folder):
            check(wanted, folder)
            return folder
    return None


def check(wanted: Wanted, folder: RunFolder) -> None:
    """Raise ReportedError if a run is not the wanted training: it has other settings, another seed or other frames."""
    asked = settings(("--run", "wanted", *wanted.flags), "trainings")
    own, theirs = read_toml(folder.config), to_tables(asked, SECTION)
    other = differences(experiment(own), experiment(theirs))
    other += [f"{name} {own.get(name)}" for name in BY_NAME if own.get(name) != theirs.get(name)]
    if is_measured(folder) and (balls := _final(folder).get("rallies")) != asked.final_rallies:
        other.append(f"final_rallies {balls}")
    if other:
        raise ReportedError(
            f"{folder.root} is not the training that is wanted: it has {', '.join(other)}; choose another --run"
        )


def differences(own: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """Return the settings that differ, with the values of ``own``."""
    return [
        f"{path} {_text(own.get(path, 'unset'))}"
        for path in sorted(own.keys() | theirs.keys())
        if own.get(path) != theirs.get(path)
    ]


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, list) else str(value) if value != "" else "empty"


def make(wanted: Iterable[Wanted], stop: Event, trains: bool = True) -> list[str]:
    """Train what is missing, one after the other, and return in words what failed.

    Args:
        wanted: The trainings.
        stop: Ends them.
        trains: False: only say which runs are other trainings than their names promise.
    """
    faults = []
    for one in wanted:
        if stop.is_set():
            break
        fault = ""
        try:
            if trains:
                fault = _train(one, stop)
            else:
                made(one)  # raises if it is another training
        except ReportedError as error:  # the others are made all the same
            fault = str(error)
        if fault:
            print(fault, file=sys.stderr, flush=True)
            faults.append(fault)
    return faults


def finished(wanted: Iterable[Wanted]) -> list[RunFolder]:
    """Return the folders of the trainings that have ended, without runs that are other trainings."""
    found = []
    for one in wanted:
        with suppress(ReportedError):  # ``make`` has said so
            if folder := made(one):
                found.append(folder)
    return found


def examined(folder: RunFolder, name: str, flags: Sequence[str]) -> dict[str, Any]:
    """Return the measures of a run's last policy under other conditions; they are kept as report/NAME.json.

    Args:
        folder: Of a run that has ended, or what is kept of it.
        name: Of the conditions.
        flags: Of ``topspin evaluate``.

    Raises:
        ReportedError: Only a copy without its policy is here and was not measured, or the evaluation failed.
    """
    file = folder.report / f"{name}.json"
    if not file.is_file():
        if not folder.latest_policy.is_dir():
            raise ReportedError(f"{folder.root} has neither {file.name} nor its policy; train it again")
        measures = evaluated(folder.latest_policy, flags)
        text = json.dumps({key: value for key, value in measures.items() if not isinstance(value, dict)})
        for report in (folder.report, RunFolder(KEPT / folder.root.name).report):
            if report.is_dir():
                write_whole(report / file.name, text + "\n")
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found


def evaluated(policy: Path, flags: Sequence[str]) -> dict[str, Any]:
    """Return what ``topspin evaluate`` measures.

    Raises:
        ReportedError: It failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", "topspin", "evaluate", "--policy", str(policy), *flags, "--json"],
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,  # a Ctrl-C ends the benchmark, which then waits for it
    )
    if done.returncode:
        raise ReportedError(f"measuring {policy} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _train(wanted: Wanted, stop: Event) -> str:
    """Train a run to its end, or go on with it, and return why it failed, or ""."""
    folder = RunFolder.of(wanted.name)
    if made(wanted) is None:
        is_there = folder.config.is_file()
        if is_there:
            check(wanted, folder)
        flags = ["--resume"] if is_there else [*CURVE, *wanted.flags]
        print(f"training {wanted.name}: {' '.join(wanted.flags)}", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "topspin", "train", "--run", wanted.name, "--panel", "off", *flags]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        ) as training:
            while training.poll() is None and not stop.is_set():
                stop.wait(LOOK_S)
            if training.poll() is None:
                training.send_signal(signal.SIGINT)  # it saves, and goes on from there next time
            status = training.wait()
        if stop.is_set():
            return ""
        if status:
            return f"training {wanted.name} ended with {status}: see {folder.logs}"
    if is_measured(folder):
        keep(folder)
    return ""


def keep(folder: RunFolder, to: Path = KEPT) -> None:
    """Copy what a study's table needs of a run that has ended."""
    copy = RunFolder(to / folder.root.name)
    for file in (folder.config, folder.final, folder.evaluations):
        if file.is_file():
            target = copy.root / file.relative_to(folder.root)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
