"""The report's plots; each group has the same colour in all."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.evaluation.breakdown import BREAKDOWNS
from common.task.states import Outcome
from topspin.report.collect import Curve
from topspin.report.court_figures import courts, landings
from topspin.report.results import GroupResult, Results
from topspin.report.style import DPI, FEWEST, INK, PALETTE, Array, Drawing, add_legend, chunks, style

STAGE_NAMES: Final = {2: "hit", 3: "aim"}
TITLES: Final = {
    "target_error_mean": ("landing error", "mean distance to the target [m]"),
    "catch_rate": ("caught", "share of rallies [%]"),
    "over_rate": ("returned over the net", "share of rallies [%]"),
    "return_rate": ("returned to the opponent's court", "share of rallies [%]"),
}


def draw(found: Results, folder: Path) -> list[Drawing]:
    """Return the plots that have values, written to ``folder`` as PNG and SVG."""
    colours = {one.label: PALETTE[k % len(PALETTE)] for k, one in enumerate(found.groups)}
    drawings = []
    with style():
        for drawing, figure in _figures(found, colours):
            figure.savefig(folder / f"{drawing.name}.png", dpi=DPI)
            figure.savefig(folder / f"{drawing.name}.svg", metadata={"Date": None})
            drawings.append(drawing)
    return drawings


def _figures(found: Results, colours: dict[str, str]) -> Iterator[tuple[Drawing, Figure]]:
    curved = [one for one in found.groups if one.curves]
    if curved:
        caption = (
            "The deterministic policy on fixed rallies that are not in training, while it trains. "
            "Thin: each seed; thick and shaded: mean, lowest and highest, up to the end of the shortest seed; dotted: "
            "start of a stage."
        )
        yield Drawing("curves_frames", "Training, by frames", caption), curves(curved, colours, by_time=False)
        yield Drawing("curves_minutes", "Training, by time", caption), curves(curved, colours, by_time=True)
    played = [one for one in found.groups if one.played is not None]
    if not played:
        return
    for suffix, some in chunks(played):
        yield (
            Drawing(
                f"landings{suffix}",
                "Where balls land",
                f"{_place(some, 0)}: landings on the opponent's court from above (the net on the left), coloured by "
                f"their distance to the target. {_place(some, 1)}: landings relative to the target, with circles of "
                "0.2 and 0.3 m and the share within; the cross is the mean.",
            ),
            landings(some, colours),
        )
    for suffix, some in chunks(played):
        yield (
            Drawing(
                f"courts{suffix}",
                "By place on the table",
                "Seen from above, the robot on the left. In this order: share returned and landing error by where the "
                f"ball bounced on the robot's court; share returned by target. Cells of under {FEWEST} rallies are "
                "empty.",
            ),
            courts(some, colours),
        )
    yield (
        Drawing(
            "outcomes", "How balls are lost", "Share of all rallies by how they ended, returns left out."
        ),
        lost(played, colours),
    )
    yield (
        Drawing(
            "rates",
            "Which balls are returned",
            "Filled: returned; hollow: caught; with 95 % intervals of the returned.",
        ),
        rates(played, colours),
    )
    yield (
        Drawing(
            "errors",
            "Which balls are aimed well",
            "Mean landing error of returned balls, with 95 % intervals.",
        ),
        errors(played, colours),
    )
    if any(one.survival for one in played):
        yield (
            Drawing(
                "rounds",
                "Ball after ball",
                "After a return the robot continues from its pose. Left: of the balls that are played as the "
                "k-th of an episode, the share returned, with 95 % intervals; right: episodes still in play.",
            ),
            rounds([one for one in played if one.survival], colours),
        )


def _place(groups: Sequence[GroupResult], kind: int) -> str:
    """Return where ``panels`` puts the first or the second kind of plot."""
    return (("Left", "Right") if len(groups) == 1 else ("Above", "Below"))[kind]


def _axis_of(curve: Curve, by_time: bool) -> Array:
    return curve.minutes if by_time else curve.frames / 1e6


def _unit_of(name: str) -> float:
    return 1.0 if name == "target_error_mean" else 100.0


def curves(groups: Sequence[GroupResult], colours: dict[str, str], by_time: bool) -> Figure:
    """Return the training curves of each group: mean and band over the seeds, a thin line per seed."""
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for ax, (name, (title, unit)) in zip(axes, TITLES.items(), strict=True):
        for one in groups:
            _curve(ax, one, name, colours[one.label], by_time)
        ax.set_title(title, loc="left")
        ax.set_ylabel(unit)
        ax.set_ylim(bottom=0)
        if name != "target_error_mean":
            ax.set_ylim(0, 101)
        ax.set_xlim(left=0)
    _stage_marks(list(axes), groups, colours, by_time)
    for ax in axes[2:]:
        ax.set_xlabel("training time [min]" if by_time else "training frames [millions]")
    add_legend(figure, axes[0])
    return figure


def _curve(ax: Axes, one: GroupResult, name: str, colour: str, by_time: bool) -> None:
    seeds = []
    for curve in one.curves:
        x, y = _axis_of(curve, by_time), curve.values[name] * _unit_of(name)
        known = np.isfinite(y)
        if known.any():
            seeds.append((x[known], y[known]))
    if not seeds:
        ax.plot([], [], color=colour, label=one.label)
        return
    if len(seeds) == 1:
        ax.plot(*seeds[0], _style(seeds[0][0]), color=colour, linewidth=1.8, label=one.label)
        return
    for x, y in seeds:
        ax.plot(x, y, _style(x), color=colour, linewidth=0.7, alpha=0.45)
    start, end = max(x[0] for x, _ in seeds), min(x[-1] for x, _ in seeds)
    grid = np.linspace(start, max(start, end), 200)
    values = np.array([np.interp(grid, x, y) for x, y in seeds])
    ax.fill_between(grid, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, linewidth=0)
    ax.plot(grid, values.mean(axis=0), color=colour, linewidth=1.8, label=one.label)


def _style(x: Array) -> str:
    """Return how a curve is drawn: a line, or a point where it has only one, such as that of a first look."""
    return "-" if len(x) > 1 else "o"


def _stage_marks(
    axes: Sequence[Axes], groups: Sequence[GroupResult], colours: dict[str, str], by_time: bool
) -> None:
    """Mark the start of each stage, each place once; groups with the same place share a grey mark."""
    marks: dict[float, list[tuple[int, str]]] = {}
    for one in groups:
        training = next((r.run.training for r in one.runs if r.run.training is not None), None)
        if training is None:
            continue
        for stage, frames in training.stage_changes():
            x = np.interp(frames, training.frames, training.seconds) / 60 if by_time else frames / 1e6
            marks.setdefault(round(float(x), 1), []).append((stage, colours[one.label]))
    for k, (x, found) in enumerate(sorted(marks.items())):
        stage, colour = found[0]
        colour = colour if len(found) == 1 else "#777777"
        for ax in axes:
            ax.axvline(x, color=colour, linewidth=0.9, linestyle=(0, (1, 2)), zorder=0.5)
        # names only in the first panel, at its bottom, where no curve is
        axes[0].annotate(
            STAGE_NAMES.get(stage, str(stage)),
            (x, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(2, 3 + 9 * (k % 2)),  # so that names of short stages do not overlap
            textcoords="offset points",
            fontsize=7.5,
            color=colour,
        )


# ---- the table from above


def lost(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return bars of the outcomes of rallies that aren't returned."""
    shares = {
        one.label: {
            name: 100 * count / one.pooled["rallies"]
            for name, count in one.pooled["outcomes"].items()
            if name != Outcome.RETURNED.name.lower()
        }
        for one in groups
    }
    names = sorted(
        {name for found in shares.values() for name in found},
        key=lambda name: max(found.get(name, 0.0) for found in shares.values()),
    )
    height = 0.8 / len(groups)
    figure = Figure(figsize=(8, 1.0 + max(1, len(names)) * (0.14 + 0.15 * len(groups))), layout="constrained")
    ax = figure.subplots()
    largest = max((share for found in shares.values() for share in found.values()), default=1.0)
    for k, one in enumerate(groups):
        values = [shares[one.label].get(name, 0.0) for name in names]
        where = np.arange(len(names)) + 0.4 - (k + 0.5) * height
        ax.barh(where, values, 0.86 * height, color=colours[one.label], label=one.label)
        for y, value in zip(where, values, strict=True):
            ax.text(value + 0.006 * largest, y, f"{value:.1f}", va="center", fontsize=8)
    ax.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xlim(0, largest * 1.08)
    ax.set_xlabel("share of all rallies [%]")
    add_legend(figure, ax)
    return figure


KINDS_SHOWN: Final = ("speed", "spin", "spin_kind", "arrival_y", "arrival_height", "target")


def _by_kind(
    groups: Sequence[GroupResult],
    colours: dict[str, str],
    label: str,
    line: Callable[[Axes, Array, list[dict[str, Any]], GroupResult, str], None],
    marks: Sequence[str] = (),
) -> Figure:
    """Return a panel for each breakdown; ``marks`` names filled and hollow dots."""
    figure = Figure(figsize=(10.5, 6.6), layout="constrained")
    axes = figure.subplots(2, 3, sharey=True)
    for ax, key in zip(axes.ravel(), KINDS_SHOWN, strict=True):
        kind = BREAKDOWNS[key]
        names = [name for name in kind.bins if any(e["bin"] == name for one in groups for e in one.by[key])]
        for k, one in enumerate(groups):
            entries = {entry["bin"]: entry for entry in one.by[key]}
            own = [name for name in names if name in entries]
            shift = 0.14 * (k - (len(groups) - 1) / 2)
            at = np.array([names.index(name) for name in own], np.float64) + shift
            line(ax, at, [entries[name] for name in own], one, colours[one.label])
        ax.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor", fontsize=8)
        ax.set_xlim(-0.6, len(names) - 0.4)
        ax.set_title(kind.title, loc="left", fontsize=9)
        ax.grid(axis="x", visible=False)
    for ax in axes[:, 0]:
        ax.set_ylabel(label)
    for name, face in zip(marks, (INK, "white"), strict=False):
        axes[0, 0].plot([], [], "o", color=INK, markersize=4, markerfacecolor=face, label=name)
    add_legend(figure, axes[0, 0])
    return figure


def _with_intervals(ax: Axes, at: Array, values: Array, bounds: Array, colour: str, label: str) -> None:
    """Draw values (n,) at ``at`` (n,) as dots with their intervals (2, n)."""
    ax.errorbar(
        at, values, np.abs(bounds - values), color=colour, fmt="o", markersize=4, linewidth=1.1, label=label
    )


def rates(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return caught and returned shares by kind of ball."""

    def line(ax: Axes, at: Array, entries: list[dict[str, Any]], one: GroupResult, colour: str) -> None:
        returned = np.array([100 * entry["return_rate"] for entry in entries])
        bounds = np.array([entry["return_rate_ci"] for entry in entries]).reshape(-1, 2).T * 100
        _with_intervals(ax, at, returned, bounds, colour, one.label)
        caught = [100 * entry["catch_rate"] for entry in entries]
        ax.plot(at, caught, "o", color=colour, markersize=4, markerfacecolor="white", markeredgewidth=0.9)

    figure = _by_kind(groups, colours, "share of rallies [%]", line, ("returned", "caught"))
    figure.axes[0].set_ylim(0, 102)
    return figure


def errors(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return the mean landing error by kind of ball."""

    def line(ax: Axes, at: Array, entries: list[dict[str, Any]], one: GroupResult, colour: str) -> None:
        landed = [k for k, entry in enumerate(entries) if entry["target_error_mean_ci"] is not None]
        far = np.array([entries[k]["target_error_mean"] for k in landed])
        bounds = np.array([entries[k]["target_error_mean_ci"] for k in landed]).reshape(-1, 2).T
        _with_intervals(ax, at[landed], far, bounds, colour, one.label)

    figure = _by_kind(groups, colours, "mean landing error [m]", line)
    means = [e["target_error_mean"] or 0.0 for one in groups for key in KINDS_SHOWN for e in one.by[key]]
    figure.axes[0].set_ylim(0, 1.2 * max(means, default=0.0) or 1.0)
    return figure


def rounds(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return return rates and survival of episodes that continue after a return."""
    figure = Figure(figsize=(8.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    last = 1
    for k, one in enumerate(groups):
        entries = one.survival["by_round"]
        number = np.array([entry["round"] for entry in entries], np.float64)
        last = max(last, len(entries))
        rate = np.array([100 * entry["return_rate"] for entry in entries])
        bounds = np.array([entry["return_rate_ci"] for entry in entries]).reshape(-1, 2).T * 100
        shift = 0.06 * (k - (len(groups) - 1) / 2)
        left.errorbar(
            number + shift,
            rate,
            np.abs(bounds - rate),
            color=colours[one.label],
            fmt="o-",
            markersize=4,
            label=one.label,
        )
        survived = [100.0] + [100 * entry["survival"] for entry in entries]
        right.plot(np.arange(len(survived)), survived, "o-", markersize=4, color=colours[one.label])
    left.set_xticks(range(1, last + 1))
    left.set_xlabel("ball of the episode")
    left.set_ylabel("returned, of those played [%]")
    right.set_xticks(range(last + 1))
    right.set_xlabel("balls returned in a row")
    right.set_ylabel("episodes that get there [%]")
    for ax in (left, right):
        ax.set_ylim(0, 102)
    add_legend(figure, left)
    return figure
