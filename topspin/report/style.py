"""How the plots of a report look, and what they have in common."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from textwrap import fill
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from topspin.report.results import GroupResult

Array = npt.NDArray[np.float64]

# Okabe and Ito's colours, for any colour vision, the strong ones first
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
FEWEST: Final = 5  # rallies that a cell of a heat map needs; with fewer it is empty
MOST_POINTS: Final = 2500  # of a scatter plot: more points only overlap
RATE_COLOURS, ERROR_COLOURS = "viridis", "magma_r"


@dataclass(frozen=True, slots=True)
class Drawing:
    """A plot in the report's folder."""

    name: str  # of its files, without .png and .svg
    title: str
    caption: str


@contextmanager
def style() -> Iterator[None]:
    """Draw in the report's style."""
    with mpl.rc_context(STYLE):
        yield


def chunks(groups: Sequence[GroupResult]) -> Iterator[tuple[str, Sequence[GroupResult]]]:
    """Return the groups by figure, at most PANELS in each, with a suffix for the figure's name."""
    for k in range(0, len(groups), PANELS):
        yield f"_{k // PANELS + 1}" if len(groups) > PANELS else "", groups[k : k + PANELS]


def add_legend(figure: Figure, axes: Axes) -> None:
    """Add one legend for the whole figure under it, in as many columns as fit."""
    handles, labels = axes.get_legend_handles_labels()
    widths = [0.6 + 0.075 * len(label) for label in labels]  # inches, about
    columns = next(
        n
        for n in range(len(labels), 0, -1)
        if n == 1 or sum(max(widths[k::n]) for k in range(n)) < figure.get_figwidth()
    )
    # matplotlib fills columns, but rows are read first
    order = [k for column in range(columns) for k in range(column, len(labels), columns)]
    figure.legend(
        [handles[k] for k in order], [labels[k] for k in order], loc="outside lower center", ncols=columns
    )


def panels(kinds: int, groups: int, width: float, height: float) -> tuple[Figure, npt.NDArray[Any]]:
    """Return axes [kind, group]: a column for each group, or side by side for a single group."""
    if groups == 1:
        figure = Figure(figsize=(kinds * (width + 0.6), height + 0.2), layout="constrained")
        return figure, figure.subplots(1, kinds, squeeze=False).T
    figure = Figure(figsize=(groups * width + 0.9, kinds * height), layout="constrained")
    return figure, figure.subplots(kinds, groups, squeeze=False)


def set_title(ax: Axes, label: str, colour: str) -> None:
    """Write a title in the colour of its group, broken into lines."""
    ax.set_title(fill(label, 32), loc="left", color=colour)


def short_number(value: float, _: object = None) -> str:
    """Return a number with at most two decimals, as a formatter of matplotlib's axes."""
    return f"{value:.2f}".rstrip("0").rstrip(".").replace("-", "\N{MINUS SIGN}")
