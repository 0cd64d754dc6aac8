"""Plots of the court: where balls land, and what is returned by where it would land or arrive."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from common.evaluation.breakdown import on_grid
from common.evaluation.measures import WITHIN_M, MatchResult
from common.physics.constants import TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from common.task.states import Outcome
from topspin.report.results import GroupResult
from topspin.report.style import (
    ERROR_COLOURS,
    FEWEST,
    INK,
    MOST_POINTS,
    RATE_COLOURS,
    Array,
    panels,
    set_title,
    short_number,
)

LARGEST_ERROR: Final = 0.8  # [m] end of the error's colours


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
    ax.xaxis.set_major_formatter(short_number)
    ax.yaxis.set_major_formatter(short_number)


def landed_only(played: MatchResult) -> MatchResult:
    """Return the rallies that were returned."""
    return played.of(played.outcomes == Outcome.RETURNED)


def landings(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return where balls land, on the court and relative to their targets."""
    figure, axes = panels(2, len(groups), 3.2, 3.5)
    shades = Normalize(0, LARGEST_ERROR)
    for column, one in enumerate(groups):
        if one.played is None:
            continue
        landed = landed_only(one.played)
        thin = max(1, math.ceil(len(landed.seeds) / MOST_POINTS))
        top, bottom = axes[0, column], axes[1, column]
        _court(top, robots=False)
        top.scatter(
            landed.landings[::thin, 0],
            landed.landings[::thin, 1], c=landed.landing_errors[::thin], cmap=ERROR_COLOURS, norm=shades,
            s=5, linewidths=0, rasterized=True,
        )  # fmt: skip
        set_title(top, one.label, colours[one.label])
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


def _error_vectors(ax: Axes, landed: MatchResult, thin: int, colour: str) -> None:
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


def lowest_rate(groups: Sequence[GroupResult]) -> int:
    """Return the lower end of the colours of shares [%]: good policies differ only in the upper half."""
    lowest = min((one.pooled["return_rate"] for one in groups), default=0.0)
    return 50 if lowest > 0.65 else 0


CELLS: Final = (8, 9)  # of a court's heat map, along x and y: 0.17 m each


def courts(groups: Sequence[GroupResult], colours: dict[str, str]) -> Figure:
    """Return heat maps: share returned and landing error by bounce, share returned by target."""
    figure, axes = panels(3, len(groups), 3.1, 3.1)
    rate, error = Normalize(lowest_rate(groups), 100), Normalize(0, LARGEST_ERROR)
    across = np.linspace(-TABLE_HALF_WIDTH, TABLE_HALF_WIDTH, CELLS[1] + 1)
    own, theirs = (
        (np.linspace(x, x + TABLE_HALF_LENGTH, CELLS[0] + 1), across) for x in (-TABLE_HALF_LENGTH, 0.0)
    )
    for column, one in enumerate(groups):
        if one.played is None:
            continue
        played, landed = one.played, landed_only(one.played)
        returned = 100.0 * (played.outcomes == Outcome.RETURNED)
        _heat(axes[0, column], played.bounces, returned, own, rate, RATE_COLOURS)
        far = landed.landing_errors.astype(np.float64)
        _heat(axes[1, column], landed.bounces, far, own, error, ERROR_COLOURS)
        _heat(axes[2, column], played.targets, returned, theirs, rate, RATE_COLOURS)
        set_title(axes[0, column], one.label, colours[one.label])
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
