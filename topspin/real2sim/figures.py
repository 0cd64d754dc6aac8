"""Plots of single recordings: the camera's detections, the estimate and the ball, in space and by axis."""

from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from common.evaluation.rally_recorder import RecordedRally
from common.physics.constants import (
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
)
from topspin.real2sim.formats.tracks import Track
from topspin.render.replay import path_of, position_at
from topspin.report.style import FAINT, INK, PALETTE

Array = npt.NDArray[np.float64]

ESTIMATE, RECORDED, REFUSED, DETECTION = PALETTE[0], PALETTE[1], PALETTE[3], "#A0A0A0"
WHEN: Final = 7  # column of ``RecordedRally.measurement``
EVENTS: Final = ("bounce", "racket", "landing")  # the touch that starts state 1, 2 and 3
ROOM: Final = 0.08  # [-] of an axis' span, left around the ball; large errors may lie outside
AFTER: Final = 0.25  # [s] shown after the last touch
FARTHEST: Final = 1.7  # [m] from the net, in the 3-D view
UNITS: Final = ("x [m]", "y [m]", "z [m]")


def flight(rally: RecordedRally, track: Track | None, title: str) -> Figure:
    """Return one played recording: on the left in 3-D, on the right by axis, with the estimate's error."""
    figure = Figure(figsize=(11, 5.8), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1))  # Any: typed as one subfigure
    left, right = halves
    # drawn in the order of the calls: matplotlib's own guess puts the table before the ball
    space: Any = left.add_axes((-0.02, 0.06, 0.98, 0.98), projection="3d", computed_zorder=False)
    _hall(space, rally)
    axes = right.subplots(4, 1, sharex=True, height_ratios=(1, 1, 1, 0.7))
    _in_space(space, rally, track)
    for k, ax in enumerate(axes[:3]):
        _by_axis(ax, rally, track, k)
    _errors(axes[3], rally)
    _events(list(axes), rally)
    axes[3].set_xlabel("time since launch [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    left.legend(handles, labels, loc="lower center", ncols=2, fontsize=8.5)
    figure.align_ylabels(list(axes))
    figure.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    return figure


def _hall(space: Any, rally: RecordedRally) -> None:
    """Draw table and net, and set the view: the robot's end is on the left."""
    x, y = TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
    top = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
    net = [
        (0, -NET_HALF_WIDTH, 0),
        (0, NET_HALF_WIDTH, 0),
        (0, NET_HALF_WIDTH, NET_HEIGHT),
        (0, -NET_HALF_WIDTH, NET_HEIGHT),
    ]
    space.add_collection3d(Poly3DCollection([top], facecolor="#DCE8E2", edgecolor=INK, linewidth=0.8))
    space.add_collection3d(
        Poly3DCollection([net], facecolor="#BBBBBB", edgecolor="#777777", linewidth=0.6, alpha=0.35)
    )
    ball = rally.ball_pos[_over_table(rally.ball_pos)]
    low = np.minimum(ball.min(axis=0), [-x, -NET_HALF_WIDTH, 0.0])
    high = np.maximum(ball.max(axis=0), [x, NET_HALF_WIDTH, 0.45])
    for name, a, b in zip("xyz", low, high, strict=True):
        getattr(space, f"set_{name}lim")(a - 0.03, b + 0.03)
        axis = getattr(space, f"{name}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis._axinfo["grid"]["color"] = "#EEEEEE"  # matplotlib has no public way to make it faint
    space.set_box_aspect(high - low + 0.06, zoom=1.0)
    space.view_init(elev=24, azim=-72)
    space.set_proj_type("ortho")
    space.set_xlabel("x [m]", labelpad=8)
    space.set_ylabel("y [m]", labelpad=2)
    space.set_zlabel("z [m]", labelpad=-3)
    space.tick_params(labelsize=7.5, pad=0)
    space.set_xticks([-1, 0, 1])
    space.set_yticks([-0.5, 0, 0.5])
    space.set_zticks([0, 0.4])


def _over_table(positions: Array) -> npt.NDArray[np.bool_]:
    """Return which positions (n, 3) are drawn in 3-D: those beside the table would make the rest small."""
    over: npt.NDArray[np.bool_] = (positions[:, 2] > 0.0) & (np.abs(positions[:, 0]) < FARTHEST)
    return over


def _in_space(space: Any, rally: RecordedRally, track: Track | None) -> None:
    if track is not None:
        space.plot(
            *track.positions.T, "o", color=RECORDED, markersize=4.5, markerfacecolor="none", alpha=0.45
        )
    if len(rally.detections):
        detections = rally.detections[(rally.detections[:, 4] > 0) & _over_table(rally.detections[:, 1:4])]
        space.plot(*detections[:, 1:4].T, ".", color=DETECTION, markersize=4)
    ball = rally.ball_pos[_over_table(rally.ball_pos)]
    space.plot(*ball.T, color=INK, linewidth=1.1)
    for piece in _pieces(rally):
        here = piece[_over_table(piece[:, :3])]
        space.plot(*here[:, :3].T, ".-", color=ESTIMATE, markersize=2.5, linewidth=0.8)
    space.scatter(*rally.target, 0.0, marker="x", color=INK, s=30, linewidths=1.2)
    space.text(*rally.target, 0.0, "  target", fontsize=7.5)


def _pieces(rally: RecordedRally) -> list[Array]:
    """Return the estimates, cut where a touch lies between two of them, since no line is known there."""
    cuts = np.flatnonzero(np.diff(rally.measurement[:, 6]) != 0) + 1
    return [piece for piece in np.split(rally.measurement, cuts) if len(piece)]


def _by_axis(ax: Axes, rally: RecordedRally, track: Track | None, k: int) -> None:
    ball = rally.ball_pos[rally.time <= _end(rally), k]
    if track is not None:
        ax.plot(
            track.times, track.positions[:, k], "o", color=RECORDED, markersize=5.5, markerfacecolor="none",
            alpha=0.45, label="recorded samples",
        )  # fmt: skip
    if len(rally.detections):
        believed = rally.detections[:, 4] > 0
        ax.plot(
            *rally.detections[believed][:, (0, 1 + k)].T,
            ".",
            color=DETECTION,
            markersize=5,
            label="camera's detections",
        )
        if not believed.all():
            refused = rally.detections[~believed]
            ax.plot(
                *refused[:, (0, 1 + k)].T,
                "x",
                color=REFUSED,
                markersize=5,
                label="detections not accepted",
                zorder=3,
            )
    ax.plot(rally.time, rally.ball_pos[:, k], color=INK, linewidth=1.1, label="ball in the simulation")
    for n, piece in enumerate(_pieces(rally)):
        ax.plot(
            piece[:, WHEN], piece[:, k], ".-", color=ESTIMATE, markersize=3.5, linewidth=1.0,
            label="estimate" if n == 0 else None,
        )  # fmt: skip
    room = max(ROOM * float(np.ptp(ball)), 0.05)
    ax.set_ylim(ball.min() - room, ball.max() + room)
    ax.set_ylabel(UNITS[k])


def _errors(ax: Axes, rally: RecordedRally) -> None:
    """Draw the distance between the estimate and the ball at the estimate's time."""
    path = path_of(rally)
    moments = np.minimum(rally.measurement[:, WHEN], rally.time[-1])
    truth = np.array([position_at(path, float(moment)) for moment in moments])
    far = 1000.0 * np.linalg.norm(rally.measurement[:, :3] - truth, axis=1)
    ax.plot(moments, far, ".-", color=ESTIMATE, markersize=3.5, linewidth=1.0)
    ax.set_yscale("log")  # a few mm; shortly after a racket contact a few dm
    ax.set_ylim(0.3, 1000)
    ax.set_yticks([1, 10, 100], ["1", "10", "100"])
    ax.minorticks_off()
    ax.set_ylabel("error [mm]")


def _events(axes: list[Axes], rally: RecordedRally) -> None:
    """Mark when the ball touched something."""
    axes[0].set_xlim(-0.02, _end(rally) + 0.01)
    for k, (before, after) in enumerate(pairwise(rally.state)):
        if after > before:
            moment = float(rally.time[k + 1])
            for ax in axes:
                ax.axvline(moment, color=FAINT, linewidth=1.2, zorder=0.5)
            axes[0].annotate(
                EVENTS[int(after) - 1],
                (moment, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(4 if after == 2 else -4 if after == 1 else 0, 2),
                textcoords="offset points",
                ha=("right", "left", "center")[int(after) - 1],
                fontsize=8,
                color="#777777",
            )


def _end(rally: RecordedRally) -> float:
    """Return the end of the plot [s]: shortly after the ball's last touch."""
    touches = np.flatnonzero(np.diff(rally.state) > 0)
    end = float(rally.time[-1])
    return min(end, float(rally.time[touches[-1] + 1]) + AFTER) if len(touches) else end
