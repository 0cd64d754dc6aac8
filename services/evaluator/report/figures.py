"""The report's plots; one colour for each group throughout. The only file that imports matplotlib."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from common.physics.constants import TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from common.rally.trajectory import Outcome
from services.evaluator.breakdown import BREAKDOWNS, on_grid
from services.evaluator.measures import WITHIN_M, Played
from services.evaluator.report.collect import Curve
from services.evaluator.report.results import GroupResult, Results

Array = npt.NDArray[np.float64]

# Okabe and Ito's colours, which the colour-blind can tell apart, the strong ones first
PALETTE: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7A5195", "#5C5C5C")
INK, FAINT = "#333333", "#D9D9D9"
STYLE: Final[Any] = {  # Any: matplotlib 3.11 types the keys, 3.10 doesn't
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.edgecolor": "#8A8A8A",
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "svg.hashsalt": "topspin",  # equal numbers give equal files
}
DPI: Final = 150
PANELS: Final = 4  # groups side by side in one figure
FEWEST: Final = 5  # rallies a cell of a heat map needs, or it stays empty
MOST_POINTS: Final = 2500  # of a scatter plot: more only blot
RATE_COLOURS, ERROR_COLOURS = "viridis", "magma_r"
LARGEST_ERROR: Final = 0.8  # [m] end of the error's colours
STAGE_NAMES: Final = {2: "hit", 3: "aim"}
TITLES: Final = {
    "target_error_mean": ("landing error", "mean distance to the target [m]"),
    "catch_rate": ("caught", "share of rallies [%]"),
    "over_rate": ("returned over the net", "share of rallies [%]"),
    "return_rate": ("returned to the opponent's court", "share of rallies [%]"),
}


@dataclass(frozen=True, slots=True)
class Drawing:
    """A plot in the report's folder."""

    name: str  # of its files, without .png and .svg
    title: str
    caption: str


def draw(found: Results, folder: Path) -> list[Drawing]:
    """Return the plots there are values for, written to ``folder`` as PNG and SVG."""
    colours = {one.label: PALETTE[k % len(PALETTE)] for k, one in enumerate(found.groups)}
    drawings = []
    with style():
        for drawing, figure in _figures(found, colours):
            figure.savefig(folder / f"{drawing.name}.png", dpi=DPI)
            figure.savefig(folder / f"{drawing.name}.svg", metadata={"Date": None})
            drawings.append(drawing)
    return drawings


@contextmanager
def style() -> Iterator[None]:
    """Draw in the report's style."""
    with mpl.rc_context(STYLE):
        yield


def _figures(found: Results, colours: dict[str, str]) -> Iterator[tuple[Drawing, Figure]]:
    curved = [one for one in found.groups if one.curves]
    if curved:
        caption = (
            "The deterministic policy on fixed rallies that nobody trains on, while it trains. "
            "Thin: each seed; thick and shaded: mean, lowest and highest, as far as all seeds go; dotted: where a "
            "stage begins."
        )
        yield Drawing("curves_frames", "Training, by frames", caption), curves(curved, colours, by_time=False)
        yield Drawing("curves_minutes", "Training, by time", caption), curves(curved, colours, by_time=True)
    played = [one for one in found.groups if one.played is not None]
    if not played:
        return
    for suffix, some in _chunks(played):
        yield (
            Drawing(
                f"landings{suffix}",
                "Where balls land",
                "Above: landings on the opponent's court from above (the net on the left), coloured by their "
                "distance to the target. Below: landings relative to the target, with circles of 0.2 and 0.3 m "
                "and the share within; the cross is the mean.",
            ),
            landings(some, colours),
        )
    for suffix, some in _chunks(played):
        yield (
            Drawing(
                f"courts{suffix}",
                "By place on the table",
                "Seen from above, the robot on the left. Rows: share returned and landing error by where the ball "
                f"bounced on the robot's court; share returned by target. Cells of under {FEWEST} rallies are empty.",
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
                "The robot goes on over a return as it stands. Left: of the balls that come to be played as the "
                "k-th of an episode, the share returned, with 95 % intervals; right: episodes still in play.",
            ),
            rounds([one for one in played if one.survival], colours),
        )


def _chunks(groups: Sequence[GroupResult]) -> Iterator[tuple[str, Sequence[GroupResult]]]:
    """Return the groups by so many as stand side by side, with a suffix for each figure's name."""
    for k in range(0, len(groups), PANELS):
        yield f"_{k // PANELS + 1}" if len(groups) > PANELS else "", groups[k : k + PANELS]


def _legend(figure: Figure, axes: Axes) -> None:
    """Put one legend for the whole figure below it, in as many columns as there is room for."""
    handles, labels = axes.get_legend_handles_labels()
    widths = [0.6 + 0.075 * len(label) for label in labels]  # inches, about
    columns = next(
        n
        for n in range(len(labels), 0, -1)
        if n == 1 or sum(max(widths[k::n]) for k in range(n)) < figure.get_figwidth()
    )
    # matplotlib fills columns, people read rows
    order = [k for column in range(columns) for k in range(column, len(labels), columns)]
    figure.legend(
        [handles[k] for k in order], [labels[k] for k in order], loc="outside lower center", ncols=columns
    )


def _panels(kinds: int, groups: int, width: float, height: float) -> tuple[Figure, npt.NDArray[Any]]:
    """Return axes [kind, group]: a column for each group, or side by side where there is but one."""
    if groups == 1:
        figure = Figure(figsize=(kinds * (width + 0.6), height + 0.2), layout="constrained")
        return figure, figure.subplots(1, kinds, squeeze=False).T
    figure = Figure(figsize=(groups * width + 0.9, kinds * height), layout="constrained")
    return figure, figure.subplots(kinds, groups, squeeze=False)


def _titled(ax: Axes, label: str, colour: str) -> None:
    ax.set_title(fill(label, 32), loc="left", color=colour)


def _number(value: float, _: object = None) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".").replace("-", "\N{MINUS SIGN}")


# ---- training curves


def _axis_of(curve: Curve, by_time: bool) -> Array:
    return curve.minutes if by_time else curve.frames / 1e6


def _unit_of(name: str) -> float:
    return 1.0 if name == "target_error_mean" else 100.0


def curves(groups: Sequence[GroupResult], colours: dict[str, str], by_time: bool) -> Figure:
    """Return the training curves of each group: mean and band over the seeds, a thin line a seed."""
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
    _legend(figure, axes[0])
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
        ax.plot(*seeds[0], color=colour, linewidth=1.8, label=one.label)
        return
    for x, y in seeds:
        ax.plot(x, y, color=colour, linewidth=0.7, alpha=0.45)
    start, end = max(x[0] for x, _ in seeds), min(x[-1] for x, _ in seeds)
    grid = np.linspace(start, max(start, end), 200)
    values = np.array([np.interp(grid, x, y) for x, y in seeds])
    ax.fill_between(grid, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, linewidth=0)
    ax.plot(grid, values.mean(axis=0), color=colour, linewidth=1.8, label=one.label)


def _stage_marks(
    axes: Sequence[Axes], groups: Sequence[GroupResult], colours: dict[str, str], by_time: bool
) -> None:
    """Mark where stages begin, each place once; groups that change at the same one share a grey mark."""
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
        # named in the first panel alone, at its bottom: no error is that small
        axes[0].annotate(
            STAGE_NAMES.get(stage, str(stage)),
            (x, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(2, 3 + 9 * (k % 2)),  # short stages' names would lie on each other
            textcoords="offset points",
            fontsize=7.5,
            color=colour,
        )


# ---- the table from above


def _court(ax: Axes, robots: bool) -> None:
    """Draw a court from above: the robot is on the left, y to its left is up."""
    left = -TABLE_HALF_LENGTH if robots else 0.0
    ax.add_patch(
        Rectangle(
            (left, -TABLE_HALF_WIDTH),
            TABLE_HALF_LENGTH,
            2 * TABLE_HALF_WIDTH,
            fill=False,
            edgecolor=INK,
            linewidth=1,
        )
    )
    ax.plot([left, left + TABLE_HALF_LENGTH], [0, 0], color=INK, linewidth=0.4, alpha=0.5)
    ax.plot([0, 0], [-0.915, 0.915], color=INK, linewidth=2.5, solid_capstyle="butt")  # net
    ax.set_xlim(left - 0.06, left + TABLE_HALF_LENGTH + 0.06)
    ax.set_ylim(-0.95, 0.95)
    ax.set_aspect("equal")
    ax.grid(False)
    for side in ax.spines.values():
        side.set_visible(False)
    ax.set_xticks([left, left + TABLE_HALF_LENGTH / 2, left + TABLE_HALF_LENGTH])
    ax.set_yticks([-TABLE_HALF_WIDTH, 0, TABLE_HALF_WIDTH])
    ax.tick_params(length=0, labelsize=8)
    ax.xaxis.set_major_formatter(_number)
    ax.yaxis.set_major_formatter(_number)


def _landed(played: Played) -> Played:
    return played.of(played.outcomes == Outcome.RETURNED)


def landings(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return where balls land, on the court and relative to their targets."""
    figure, axes = _panels(2, len(groups), 3.2, 3.5)
    shades = Normalize(0, LARGEST_ERROR)
    for column, one in enumerate(groups):
        if one.played is None:
            continue
        landed = _landed(one.played)
        thin = max(1, math.ceil(len(landed.seeds) / MOST_POINTS))
        top, bottom = axes[0, column], axes[1, column]
        _court(top, robots=False)
        top.scatter(
            landed.landings[::thin, 0],
            landed.landings[::thin, 1], c=landed.landing_errors[::thin], cmap=ERROR_COLOURS, norm=shades,
            s=5, linewidths=0, rasterized=True,
        )  # fmt: skip
        _titled(top, one.label, colours[one.label])
        top.set_xlabel("x [m]")
        _error_vectors(bottom, landed, thin, colours[one.label])
    axes[0, 0].set_ylabel("y [m]")
    axes[1, 0].set_ylabel("to the left of the target [m]")
    bar = figure.colorbar(
        ScalarMappable(shades, ERROR_COLOURS), ax=axes[0].tolist(), shrink=0.8, extend="max", pad=0.02
    )
    bar.set_label("landing error [m]")
    bar.outline.set_visible(False)
    return figure


def _error_vectors(ax: Axes, landed: Played, thin: int, colour: str) -> None:
    offsets = landed.landings - landed.targets
    ax.scatter(
        offsets[::thin, 0], offsets[::thin, 1], color=colour, s=4, alpha=0.3, linewidths=0, rasterized=True
    )
    for limit in WITHIN_M:
        ax.add_patch(Circle((0, 0), limit, fill=False, edgecolor=INK, linewidth=0.9))
    if len(offsets):
        shares = [float((landed.landing_errors < limit).mean()) for limit in WITHIN_M]
        text = "\n".join(
            f"{100 * share:.0f} % within {limit:g} m" for share, limit in zip(shares, WITHIN_M, strict=True)
        )
        ax.text(0.03, 0.97, text, transform=ax.transAxes, va="top", fontsize=8)
        ax.plot(*offsets.mean(axis=0), marker="+", color=INK, markersize=9, markeredgewidth=1.5)
    ax.set_xlim(-1.25, 1.25)
    ax.set_ylim(-1.25, 1.25)
    ax.set_aspect("equal")
    ax.set_xlabel("beyond the target [m]")


def _lowest_rate(groups: Sequence[GroupResult]) -> int:
    """Return where the colours of shares begin [%]: good policies are told apart in the upper half."""
    lowest = min((one.pooled["return_rate"] for one in groups), default=0.0)
    return 50 if lowest > 0.65 else 0


CELLS: Final = (8, 9)  # of a court's heat map, along x and y: 0.17 m each


def courts(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return heat maps: share returned and landing error by bounce, share returned by target."""
    figure, axes = _panels(3, len(groups), 3.1, 3.1)
    rate, error = Normalize(_lowest_rate(groups), 100), Normalize(0, LARGEST_ERROR)
    across = np.linspace(-TABLE_HALF_WIDTH, TABLE_HALF_WIDTH, CELLS[1] + 1)
    own, theirs = (
        (np.linspace(x, x + TABLE_HALF_LENGTH, CELLS[0] + 1), across) for x in (-TABLE_HALF_LENGTH, 0.0)
    )
    for column, one in enumerate(groups):
        if one.played is None:
            continue
        played, landed = one.played, _landed(one.played)
        returned = 100.0 * (played.outcomes == Outcome.RETURNED)
        _heat(axes[0, column], played.bounces, returned, own, rate, RATE_COLOURS)
        far = landed.landing_errors.astype(np.float64)
        _heat(axes[1, column], landed.bounces, far, own, error, ERROR_COLOURS)
        _heat(axes[2, column], played.targets, returned, theirs, rate, RATE_COLOURS)
        _titled(axes[0, column], one.label, colours[one.label])
        axes[0, column].set_xlabel("bounce x [m]")
        axes[1, column].set_xlabel("bounce x [m]")
        axes[2, column].set_xlabel("target x [m]")
    below = "min" if rate.vmin else "neither"
    for row, (name, shades, ramp, beyond) in enumerate(
        (
            ("returned [%]", rate, RATE_COLOURS, below),
            ("landing error [m]", error, ERROR_COLOURS, "max"),
            ("returned [%]", rate, RATE_COLOURS, below),
        )
    ):
        axes[row, 0].set_ylabel("y [m]")
        bar = figure.colorbar(
            ScalarMappable(shades, ramp), ax=axes[row].tolist(), shrink=0.8, pad=0.02, extend=beyond
        )
        bar.set_label(name)
        bar.outline.set_visible(False)
    return figure


def _heat(
    ax: Axes, points: Array, values: Array, edges: tuple[Array, Array], shades: Normalize, colours: str
) -> None:
    mean, count = on_grid(points, values, edges)
    shown = np.ma.masked_where(count < FEWEST, np.nan_to_num(mean))
    _court(ax, robots=bool(edges[0][0] < 0))
    ax.pcolormesh(*edges, shown.T, cmap=colours, norm=shades, edgecolors="white", linewidth=0.4)


# ---- rates


def lost(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return bars of how rallies end that aren't returned."""
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
    _legend(figure, ax)
    return figure


KINDS_SHOWN: Final = ("speed", "spin", "spin_kind", "arrival_y", "arrival_height", "target")


def _by_kind(
    groups: Sequence[GroupResult],
    colours: dict[str, str],
    label: str,
    line: Callable[[Axes, Array, list[dict[str, Any]], GroupResult, str], None],
    marks: Sequence[str] = (),
) -> Figure:
    """Return a panel for each way to tell balls apart; ``marks`` names filled and hollow ones."""
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
    _legend(figure, axes[0, 0])
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
    """Return what becomes of rallies that go on over a return."""
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
    _legend(figure, left)
    return figure
