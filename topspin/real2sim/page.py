"""The report on recorded balls: report.md and report.html, results.json and the plots."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from common.errors import ReportedError
from common.evaluation.breakdown import breakdown
from common.evaluation.measures import MatchResult
from common.evaluation.rally_recorder import RecordedRally
from common.task.launch import SPIN, VELOCITY
from topspin.real2sim.dataset import Recorded
from topspin.real2sim.figures import flight
from topspin.render.overlay import OUTCOME_WORDS
from topspin.report import court_figures, figures
from topspin.report.page import Section, as_html, as_markdown
from topspin.report.results import GroupResult
from topspin.report.style import DPI, PALETTE, Drawing, style
from topspin.report.tables import NOTHING, Table, kind_table, metres, percent

TITLE: Final = "Topspin: recorded balls"
HEADLINE: Final = (
    ("valid_share", "recordings that are valid rallies"),
    ("catch_rate", "caught"),
    ("over_rate", "returned over the net"),
    ("return_rate", "returned to the opponent's court"),
    ("return_after_catch", "returned after a catch"),
    ("within_0.2_m", "share of landings within 0.2 m of the target"),
    ("within_0.3_m", "share of landings within 0.3 m of the target"),
)


def write(
    found: Mapping[str, Any],
    played: MatchResult,
    recorded: Recorded,
    shown: Mapping[int, RecordedRally],
    folder: Path,
) -> None:
    """Write the report.

    Args:
        found: What the command prints.
        played: The played rallies.
        recorded: The recordings.
        shown: Rallies to draw, played again; by row among the valid ones.
        folder: Folder of the report.
    """
    group = GroupResult(
        label="recorded balls",
        description="",
        runs=(),
        played=played,
        pooled=found,
        spread={},
        by=breakdown(played),
        survival={},
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        rates, landings, flights = _draw(group, recorded, shown, folder)
        parts = [
            Section("", (_about(found),)),
            Section("Measures", tables=(_headline(found), *_left_out(found))),
            Section("How rallies ended", tables=(_outcomes(found),)),
            Section(
                "By kind of ball",
                tables=tuple(kind_table(key, [group]) for key in ("speed", "spin", "spin_kind")),
                drawings=rates,
            ),
            Section("Where balls land", drawings=landings),
        ]
        if flights:
            parts.append(Section("Examples", (_LEGEND,), tables=(_shown(recorded, shown),), drawings=flights))
        (folder / "report.md").write_text(as_markdown(parts, TITLE), encoding="utf-8")
        (folder / "report.html").write_text(as_html(parts, folder, TITLE), encoding="utf-8")
        (folder / "results.json").write_text(json.dumps(found, allow_nan=False, indent=1) + "\n")
    except OSError as error:
        raise ReportedError(f"can't write the report to {folder}: {error.strerror}") from error


_LEGEND: Final = (
    "Spread evenly over all and played again by a robot that starts near its home and knows nothing of the opponent. "
    "So one of them may end otherwise than it was counted. The plotted estimate is the "
    "policy's observation. It is plotted at the time that it estimates: the camera's mean latency before."
)


def _draw(
    group: GroupResult, recorded: Recorded, shown: Mapping[int, RecordedRally], folder: Path
) -> tuple[tuple[Drawing, ...], tuple[Drawing, ...], tuple[Drawing, ...]]:
    """Write the plots; return those of rates, of landings and of single recordings."""
    colours = {group.label: PALETTE[0]}
    with style():
        rates = (
            _saved(
                figures.rates([group], colours),
                Drawing(
                    "rates",
                    "Which balls are returned",
                    "Filled: returned; hollow: caught; with 95 % intervals of the returned.",
                ),
                folder,
            ),
        )
        landings = (
            _saved(
                court_figures.landings([group], colours),
                Drawing(
                    "landings",
                    "Where balls land",
                    "Left: landings on the opponent's court from above (the net on the left), coloured by their "
                    "distance to the target. Right: relative to the target, with circles of 0.2 and 0.3 m and the "
                    "share within; the cross is the mean.",
                ),
                folder,
            ),
        )
        flights = []
        for number, (k, rally) in enumerate(shown.items(), 1):
            row = _row(recorded, k)
            drawing = Drawing(f"flight_{number}", recorded.rallies.ids[row], _words(recorded, row, rally))
            title = f"{drawing.title}: {drawing.caption}"
            flights.append(_saved(flight(rally, recorded.tracks[row], title), drawing, folder))
    return rates, landings, tuple(flights)


def _saved(figure: Figure, drawing: Drawing, folder: Path) -> Drawing:
    figure.savefig(folder / f"{drawing.name}.png", dpi=DPI)
    return drawing


def _row(recorded: Recorded, valid_row: int) -> int:
    """Return which recording the ``valid_row``-th valid one is."""
    return int(np.flatnonzero(recorded.rallies.valid)[valid_row])


def _words(recorded: Recorded, row: int, rally: RecordedRally) -> str:
    """Return a text about one recording and its outcome."""
    launch = recorded.rallies.launches[row]
    parts = [
        f"{np.linalg.norm(launch[VELOCITY]):.1f} m/s",
        f"{np.linalg.norm(launch[SPIN]):.0f} rad/s",
        OUTCOME_WORDS[rally.outcome],
    ]
    if np.isfinite(rally.landing_error):
        parts[-1] += f", {100 * rally.landing_error:.0f} cm from the target"
    return "; ".join(parts)


def _about(found: Mapping[str, Any]) -> str:
    how = (
        "a track drives its ball until the racket touches it"
        if found["mode"] == "kinematic"
        else "balls are launched as recorded and fly by the simulator's physics"
    )
    observed = (
        "through a simulated camera and its filter"
        if found["perception"] == "full"
        else "by its true state, with delay and noise"
    )
    return (
        f"{found['data']}: {found['recordings']:,} recordings that fly towards the robot, {found['rallies']:,} of them "
        f"played. Mode {found['mode']}: {how}. Perception {found['perception']}: the ball is observed {observed}. "
        f"Randomization {found['randomization']}, but the air is the recording's, or the nominal one where it shows "
        f"none. Policy {found['policy']}, without exploration noise."
    )


def _headline(found: Mapping[str, Any]) -> Table:
    rows = [
        (words, percent(found[name]), _interval(found.get(f"{name}_ci"), 100, 1, "%"))
        for name, words in HEADLINE
    ]
    rows += [
        ("landing error, mean", metres(found["target_error_mean"], 3),
         _interval(found["target_error_mean_ci"], 1, 3, "m")),
        ("landing error, median", metres(found["target_error_median"], 3), NOTHING),
    ]  # fmt: skip
    if "fit_rms_median" in found:
        rows.append(
            (
                f"fit of {found['tracks_fitted']} tracks, rms: median, 90th percentile",
                f"{1000 * found['fit_rms_median']:.1f} mm",
                f"{1000 * found['fit_rms_p90']:.1f} mm",
            )
        )
    return Table("Measures", ("measure", "value", "95 % interval"), tuple(rows), frozenset({3}))


def _interval(bounds: tuple[float, float] | None, scale: float, digits: int, unit: str) -> str:
    if bounds is None:
        return NOTHING
    return f"{scale * bounds[0]:.{digits}f} to {scale * bounds[1]:.{digits}f} {unit}"


def _left_out(found: Mapping[str, Any]) -> tuple[Table, ...]:
    rows = tuple(
        (reason, str(count)) for key in ("dropped", "invalid") for reason, count in found[key].items()
    )
    rows += tuple((f"file {name}", "1") for name in found["skipped"])
    if not rows:
        return ()
    return (Table("What was left out", ("reason", "number"), rows),)


def _outcomes(found: Mapping[str, Any]) -> Table:
    rows = tuple(
        (name.replace("_", " "), str(count), percent(count / found["rallies"]))
        for name, count in found["outcomes"].items()
    )
    return Table("How rallies ended", ("outcome", "rallies", "share"), rows)


def _shown(recorded: Recorded, shown: Mapping[int, RecordedRally]) -> Table:
    rows = []
    for k, rally in shown.items():
        row = _row(recorded, k)
        launch, rms = recorded.rallies.launches[row], recorded.fit_rms[row]
        rows.append(
            (
                recorded.rallies.ids[row],
                recorded.rallies.labels[row] or NOTHING,
                f"{np.linalg.norm(launch[VELOCITY]):.1f} m/s",
                f"{np.linalg.norm(launch[SPIN]):.0f} rad/s",
                NOTHING if np.isnan(rms) else f"{1000 * rms:.1f} mm",
                OUTCOME_WORDS[rally.outcome],
                metres(None if np.isnan(rally.landing_error) else rally.landing_error),
            )
        )
    columns = ("recording", "label", "speed", "spin", "fit's rms", "outcome", "landing error")
    return Table("Examples", columns, tuple(rows))
