"""The live terminal panel: the state of a run, from the heartbeats of its services."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from common.comms.messages import Status

STAGES = {1: "1 catch", 2: "2 hit", 3: "3 aim"}
MOST_SERVICES = 2048
STALE_S = 5.0  # a heartbeat older than this is shown as missing


@dataclass(slots=True)
class View:
    """Everything the panel shows."""

    run: str
    statuses: dict[tuple[str, str], Status] = field(default_factory=dict)
    heard: dict[tuple[str, str], float] = field(default_factory=dict)  # [s] on the panel's clock
    restarts: Mapping[str, int] = field(default_factory=dict)
    minutes: float = 0.0
    frames: int = 0

    def hear(self, status: Status, now: float) -> None:
        """Store a heartbeat; those of more services than a run has are left out."""
        if len(self.statuses) >= MOST_SERVICES and (status.role, status.id) not in self.statuses:
            return
        self.statuses[status.role, status.id] = status
        self.heard[status.role, status.id] = now


def share_done(view: View) -> float:
    """Return how much of the budget is spent, 0..1: the limit with the largest share decides."""
    learner = view.statuses.get(("learner", "0"))
    if learner is None:
        return 0.0
    gauges = learner.gauges
    epochs = gauges.get("epochs", 0.0)  # 0: the curriculum's stages are shares of the frames
    shares = [gauges.get("epoch", 0.0) / epochs if epochs > 0 else 0.0]
    if view.minutes > 0:
        shares.append(gauges.get("seconds", 0.0) / (60.0 * view.minutes))
    if view.frames > 0:
        shares.append(learner.counters.get("frames", 0.0) / view.frames)
    return min(max(shares), 1.0)


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


def _percent(values: Mapping[str, float], name: str) -> str:
    return f"{100 * values[name]:5.1f} %" if name in values else "    -"


def _metres(values: Mapping[str, float], name: str) -> str:
    return f"{values[name]:.2f} m" if name in values else "-"


def _number(values: Mapping[str, float], name: str, form: str) -> str:
    return format(values[name], form) if name in values else "-"


def render(view: View, now: float) -> RenderableType:
    """Return the panel."""
    learner = view.statuses.get(("learner", "0"))
    gauges: Mapping[str, float] = learner.gauges if learner else {}
    counters: Mapping[str, float] = learner.counters if learner else {}
    misfits = gauges.get("misfits", 0.0)
    evaluator = view.statuses.get(("evaluator", "0"))
    measured: Mapping[str, float] = evaluator.gauges if evaluator else {}

    head = Table.grid(padding=(0, 3))
    head.add_row(
        Text(f"stage {STAGES.get(int(gauges.get('stage', 0)), '-')}", style="bold cyan"),
        f"{counters.get('frames', 0) / 1e6:.2f} M frames",
        f"{gauges.get('frames_per_s', 0):,.0f} frames/s",
        f"epoch {gauges.get('epoch', 0):.0f}",
        f"{clock(gauges.get('seconds'))} gone, {clock(time_left_s(view))} left",
    )

    play = Table(box=None, padding=(0, 2), header_style="dim")
    for title in ("", "catch", "return", "error"):
        play.add_column(title, justify="right" if title else "left")
    play.add_row(
        "training, with noise",
        _percent(gauges, "catch_rate"),
        _percent(gauges, "return_rate"),
        _metres(gauges, "target_error"),
    )
    at = f" at {measured['frames'] / 1e6:.1f} M" if "frames" in measured else ""
    play.add_row(
        f"evaluation{at}",
        _percent(measured, "catch_rate"),
        _percent(measured, "return_rate"),
        _metres(measured, "target_error_mean"),
        style="bold",
    )

    learning = Table.grid(padding=(0, 3))
    learning.add_row(
        f"reward {_number(gauges, 'reward', '.1f')}",
        f"lag {_number(gauges, 'lag', '.2f')}",
        f"KL {_number(gauges, 'kl', '.4f')}",
        f"learning rate {_number(gauges, 'learning_rate', '.1e')}",
        f"explained variance {_number(gauges, 'explained_variance', '.2f')}",
    )
    ledger = Table.grid(padding=(0, 3))
    ledger.add_row(
        *(
            f"{name.replace('_', ' ')} {counters.get(name, 0):.0f}"
            for name in ("published", "trained", "in_flight", "refused", "dropped")
        ),
        Text(f"lost {counters.get('lost', 0):.0f}", style="red" if counters.get("lost", 0) else ""),
    )

    processes = Table(box=None, padding=(0, 2), header_style="dim")
    for title in ("process", "state", "doing", "heard", "restarts", "metrics"):
        processes.add_column(title)
    for (role, id_), status in sorted(view.statuses.items()):
        name = f"{role}-{id_}"
        silence = now - view.heard[role, id_]
        style = "red" if silence > STALE_S else ""
        processes.add_row(
            Text(name),  # plain text: a name or state may hold brackets, which would be markup
            Text(status.state),
            _doing(status),
            f"{silence:.0f} s ago",
            str(view.restarts.get(name, 0)),
            _number(status.gauges, "metrics_port", ".0f"),
            style=style,
        )
    bar = ProgressBar(total=1.0, completed=share_done(view), width=60)
    rows: list[RenderableType] = [head, bar, Text(""), play, Text(""), learning, ledger, Text(""), processes]
    if misfits:
        text = f"{misfits:.0f} actors of another contract get no credits: the learner's log names them"
        rows.insert(-2, Text(text, style="red"))
    return Panel(Group(*rows), title=f"Topspin {view.run}", border_style="cyan", padding=(0, 1))


def _doing(status: Status) -> str:
    c, g = status.counters, status.gauges
    if status.role == "actor":
        return f"{c.get('frames', 0) / 1e6:.2f} M frames, policy {g.get('version', -1):.0f}"
    if status.role == "generator":
        valid = 100 * c.get("valid", 0) / max(c.get("drawn", 0), 1)
        return f"{c.get('published', 0):,.0f} rallies, {valid:.0f} % valid"
    if status.role == "evaluator":
        return f"{c.get('evaluations', 0):.0f} evaluations"
    return f"policy {g.get('version', 0):.0f}, queue {g.get('queued', 0):.0f}"
