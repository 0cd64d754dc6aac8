"""The live terminal panel: the state of a run, from the heartbeats of its services. It fits into 80 columns."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from common.comms.messages import Status
from deploy.history import STAGES, Point, sparkline, stage_starts

MOST_SERVICES = 2048
STALE_S = 5.0  # a heartbeat older than this is shown as missing
ONE_ROW_EACH: Final = 4  # services of a role; more of them share a row
NAMED_SILENT: Final = 3  # services of such a role that are named because they are silent
SPARK_WIDTH: Final = 48  # [columns]
NOT_YET: Final = "-"


@dataclass(slots=True)
class View:
    """Everything the panel shows."""

    run: str
    statuses: dict[tuple[str, str], Status] = field(default_factory=dict)
    heard: dict[tuple[str, str], float] = field(default_factory=dict)  # [s] on the panel's clock
    restarts: Mapping[str, int] = field(default_factory=dict)
    minutes: float = 0.0
    frames: int = 0
    folder: str = ""  # of the run
    metrics_host: str = ""  # address that /metrics are served on
    history: list[Point] = field(default_factory=list)

    def hear(self, status: Status, now: float) -> None:
        """Store a heartbeat; those of more services than a run has are left out."""
        key = status.role, status.id
        if len(self.statuses) >= MOST_SERVICES and key not in self.statuses:
            return
        self.statuses[key] = status
        self.heard[key] = now
        if key == ("learner", "0"):
            self._remember(status)

    def forget(self, role: str, id_: str) -> None:
        """Show a service no longer: it was asked to end."""
        self.statuses.pop((role, id_), None)
        self.heard.pop((role, id_), None)

    def _remember(self, learner: Status) -> None:
        frames, stage = learner.counters.get("frames", 0.0), int(learner.gauges.get("stage", 0))
        while self.history and self.history[-1].frames > frames:  # it went back to a checkpoint
            self.history.pop()
        if frames > (self.history[-1].frames if self.history else 0.0) and stage in STAGES:
            self.history.append(Point(frames, stage, learner.gauges.get("return_rate", math.nan)))


def share_done(view: View) -> float:
    """Return how much of the budget is spent, 0..1: the limit with the largest share decides."""
    learner = view.statuses.get(("learner", "0"))
    if learner is None:
        return 0.0
    gauges = learner.gauges
    limits = (
        (gauges.get("seconds", 0.0), 60.0 * view.minutes),
        (learner.counters.get("frames", 0.0), view.frames),
        (learner.counters.get("frames", 0.0), gauges.get("curriculum_frames", 0.0)),
    )
    return min(max((done / limit for done, limit in limits if limit > 0), default=0.0), 1.0)


def time_left_s(view: View) -> float | None:
    """Return the time left at the pace so far, or None before anything is trained."""
    learner = view.statuses.get(("learner", "0"))
    done = share_done(view)
    if learner is None or done <= 0.0 or learner.gauges.get("seconds", 0.0) <= 0.0:
        return None
    return learner.gauges["seconds"] * (1.0 - done) / done


def clock(seconds: float | None) -> str:
    """Return seconds as h:mm:ss, or dashes."""
    if seconds is None:
        return "-:--"
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def written(values: Mapping[str, float], name: str, form: str, unit: str = "", scale: float = 1.0) -> str:
    """Return a value with its unit; a dash where there is none yet, which a rate without rallies says by nan."""
    value = values.get(name, math.nan)
    return NOT_YET if math.isnan(value) else f"{scale * value:{form}}{unit}"


def millions(frames: float) -> str:
    """Return a number of frames in millions."""
    return f"{frames / 1e6:.2f} M"


def render(view: View, now: float) -> RenderableType:
    """Return the panel. No row wraps: what is too long for the terminal ends with an ellipsis."""
    learner = view.statuses.get(("learner", "0"))
    gauges: Mapping[str, float] = learner.gauges if learner else {}
    counters: Mapping[str, float] = learner.counters if learner else {}
    rows: list[RenderableType] = [
        _head(view, gauges, counters),
        _progress(view, gauges),
        _play(view, gauges),
        *_past(view),
        Text(""),
        _figures(
            ("reward", written(gauges, "reward", ".1f")),
            ("lag", written(gauges, "lag", ".2f")),
            ("KL", written(gauges, "kl", ".4f")),
            ("learning rate", written(gauges, "learning_rate", ".1e")),
            ("explained variance", written(gauges, "explained_variance", ".2f")),
        ),
        _figures(
            *(
                (name.replace("_", " "), f"{counters.get(name, 0):.0f}")
                for name in ("published", "trained", "in_flight", "refused", "dropped", "lost")
            ),
            style="red" if counters.get("lost", 0) else "",
        ),
        Text(""),
        _processes(view, now)
        if view.statuses
        else _line("the services start; the first batch takes some seconds"),
    ]
    if misfits := gauges.get("misfits", 0.0):
        text = f"{misfits:.0f} actors of another contract get no credits: the learner's log names them"
        rows.append(_line(text, style="red"))
    if view.folder:
        rows.append(_places(view))
    return Panel(Group(*rows), title=Text(f"Topspin {view.run}"), border_style="cyan", padding=(0, 1))


def _line(text: str, style: str = "") -> Text:
    return Text(text, style=style, no_wrap=True, overflow="ellipsis")


def _head(view: View, gauges: Mapping[str, float], counters: Mapping[str, float]) -> Text:
    line = _line("")
    line.append(f"stage {STAGES.get(int(gauges.get('stage', 0)), NOT_YET)}", style="bold cyan")
    goal = f" of {millions(view.frames)}" if view.frames else ""
    line.append(
        f"   {millions(counters.get('frames', 0.0))}{goal} frames   {written(gauges, 'frames_per_s', ',.0f')} frames/s"
        f"   epoch {written(gauges, 'epoch', ',.0f')}"
    )
    return line


def _progress(view: View, gauges: Mapping[str, float]) -> Table:
    grid = Table.grid(padding=(0, 3))
    times = f"{clock(gauges.get('seconds'))} gone, {clock(time_left_s(view))} left"
    grid.add_row(ProgressBar(total=1.0, completed=share_done(view), width=44), _line(times))
    return grid


def _play(view: View, gauges: Mapping[str, float]) -> Table:
    evaluator = view.statuses.get(("evaluator", "0"))
    measured: Mapping[str, float] = evaluator.gauges if evaluator else {}
    table = Table(box=None, padding=(0, 2), header_style="dim", pad_edge=False)
    for title in ("", "catch", "return", "error"):
        table.add_column(title, justify="right" if title else "left", no_wrap=True, min_width=7)

    def add(name: str, values: Mapping[str, float], error: str, style: str = "") -> None:
        rates = (written(values, rate, ".1f", " %", 100.0) for rate in ("catch_rate", "return_rate"))
        table.add_row(name, *rates, written(values, error, ".2f", " m"), style=style)

    at = f" at {millions(measured['frames'])}" if "frames" in measured else ""
    add("training, with noise", gauges, "target_error")
    add(f"evaluation{at}", measured, "target_error_mean", style="bold")
    return table


def _past(view: View) -> list[Text]:
    """Return the sparkline of the return rate and the stages so far; empty before anything is trained."""
    if not view.history:
        return []
    line = sparkline(view.history, SPARK_WIDTH)
    starts = (
        f"{STAGES[stage]} from {millions(start) if start else '0'}"
        for stage, start in stage_starts(view.history)
        if stage in STAGES
    )
    stages = _line("stages  " + "   ".join(starts))
    if not line:
        return [stages]
    return [_line(f"return  {line}  0 to {millions(view.history[-1].frames)}"), stages]


def _figures(*figures: tuple[str, str], style: str = "") -> Table:
    table = Table(box=None, padding=(0, 2), header_style="dim", pad_edge=False)
    for name, _ in figures:
        table.add_column(name, justify="right", no_wrap=True)
    *others, last = (value for _, value in figures)
    table.add_row(*others, Text(last, style=style))
    return table


def _places(view: View) -> Table:
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(no_wrap=True, overflow="ellipsis")
    grid.add_row("run folder", Text(view.folder))
    grid.add_row("TensorBoard", Text(f"tensorboard --logdir {view.folder}/tb"))
    learner = view.statuses.get(("learner", "0"))
    if learner and (port := learner.gauges.get("metrics_port")):
        address = f"http://{view.metrics_host}:{port:.0f}/metrics"
        grid.add_row("metrics", Text(f"{address}, all in {view.folder}/targets.json"))
    return grid


def _processes(view: View, now: float) -> Table:
    table = Table(box=None, padding=(0, 1), header_style="dim", pad_edge=False, collapse_padding=True)
    for title in ("process", "state", "doing", "silent", "restarts", "metrics"):
        table.add_column(title, no_wrap=True, overflow="ellipsis")
    of_role: dict[str, list[str]] = {}
    for role, id_ in sorted(view.statuses):
        of_role.setdefault(role, []).append(id_)
    for role, ids in of_role.items():
        named = ids
        if len(ids) > ONE_ROW_EACH:
            _add_row(table, view, now, f"{role} × {len(ids)}", [(role, id_) for id_ in ids])
            named = [id_ for id_ in ids if now - view.heard[role, id_] > STALE_S][:NAMED_SILENT]
        for id_ in named:
            _add_row(table, view, now, f"{role}-{id_}", [(role, id_)])
    return table


def _add_row(table: Table, view: View, now: float, name: str, keys: Sequence[tuple[str, str]]) -> None:
    """Add the row of one service, or of all of a role."""
    statuses = [view.statuses[key] for key in keys]
    silence = max(now - view.heard[key] for key in keys)
    state, count = Counter(status.state for status in statuses).most_common(1)[0]
    ports = [written(status.gauges, "metrics_port", ".0f") for status in statuses]
    table.add_row(
        Text(name),  # plain text: a name or state may hold brackets, which would be markup
        Text(state if len(statuses) == 1 else f"{count} {state}"),
        _doing(statuses),
        f"{silence:.0f} s",
        str(sum(view.restarts.get(f"{role}-{id_}", 0) for role, id_ in keys)),
        ports[0] if len(ports) == 1 else f"{min(ports)} …",
        style="red" if silence > STALE_S else "",
    )


def _doing(statuses: Sequence[Status]) -> str:
    def total(name: str) -> float:
        return sum(status.counters.get(name, 0.0) for status in statuses)

    role, gauges = statuses[0].role, [status.gauges for status in statuses]
    version = _latest(gauges, "version")
    if role == "actor":
        return f"{millions(total('frames'))} frames, policy {version}"
    if role == "generator":
        valid = 100.0 * total("valid") / max(total("drawn"), 1.0)
        return f"{millions(total('published'))} rallies, {valid:.0f} % valid"
    if role == "evaluator":
        return f"{total('evaluations'):.0f} evaluations"
    return f"policy {version}, queue {_latest(gauges, 'queued')}"


def _latest(gauges: Iterable[Mapping[str, float]], name: str) -> str:
    """Return the highest value of a gauge that has one; a dash before there is one."""
    found = max((values.get(name, -1.0) for values in gauges), default=-1.0)
    return f"{found:.0f}" if found >= 0.0 else NOT_YET
