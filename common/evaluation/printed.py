"""The measures of a policy as lines for people."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from common.evaluation.breakdown import BREAKDOWNS

Lines = Callable[[Mapping[str, Any]], Sequence[str]]

RATES: Final = (
    ("caught", "catch_rate"),
    ("over the net", "over_rate"),
    ("returned", "return_rate"),
    ("after a catch", "return_after_catch"),
)


def evaluation_lines(found: Mapping[str, Any]) -> list[str]:
    """Return what ``measure`` found as lines for people."""
    return [*aligned(summary(found)), *table(found["by"])]


def print_measures(found: Mapping[str, Any], as_json: bool, lines: Lines = evaluation_lines) -> None:
    """Print measures for a person, or as one JSON line.

    Args:
        found: What ``measure`` found, or what ``lines`` reads.
        as_json: Whether a program reads it.
        lines: Returns the lines for people.
    """
    shown = [json.dumps(found)] if as_json else lines(found)
    sys.stdout.write("\n".join(shown) + "\n")


def summary(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what ``measure`` found as names and texts; rates have their 95 % intervals."""
    observed = "end-to-end" if found["end_to_end"] else "not end-to-end"
    lines = [
        ("policy", f"{found['policy']}, {observed}, expected spin {found['expected_spin']}"),
        (
            "balls",
            f"{found['rallies']:,} {found['launch']}, randomization {found['randomization']}, "
            f"air {found['flight']}, contacts {found['collision']}, perception {found['perception']}, "
            f"seed {found['seed']}",
        ),
    ]
    lines += results(found)
    if found["rounds"] > 1:
        rows = ", ".join(
            f"{number}: {_share(one['survival'])}" for number, one in enumerate(found["by_round"], 1)
        )
        lines.append(
            ("rallies", f"{found['rally_length_mean']:.2f} balls returned in the mean; in a row {rows}")
        )
    if "robot" in found:
        lines += _robot(found["robot"])
    lines.append(("took", f"{found['seconds']:.1f} s"))
    return lines


def results(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the names and texts of ``measures``: rates with their 95 % intervals, landings, outcomes."""
    return [
        *((name, _rate(found[key], found[f"{key}_ci"])) for name, key in RATES),
        ("landing error", _error(found)),
        ("how they ended", ", ".join(f"{name} {n:,}" for name, n in found["outcomes"].items())),
    ]


def aligned(lines: Sequence[tuple[str, str]]) -> list[str]:
    """Return names and texts as lines for people, in two columns."""
    return [f"{name:<14}  {text}" for name, text in lines]


def table(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Return ``breakdown`` as lines for people."""
    lines = []
    for key, bins in found.items():
        lines += ["", f"{BREAKDOWNS[key].title:>40}  rallies  caught  returned  after catch   error"]
        for entry in bins:
            rates = "".join(
                f"{_share(entry[name]):>{width}}"
                for name, width in (("catch_rate", 8), ("return_rate", 10), ("return_after_catch", 13))
            )
            error = entry["target_error_mean"]
            lines.append(
                f"{entry['bin']:>40}  {entry['rallies']:7d}{rates}{'-' if error is None else f'{error:.2f} m':>8}"
            )
    return lines


def _robot(robot: Mapping[str, Any]) -> list[tuple[str, str]]:
    racket = robot["racket_speed_m_per_s"]
    speed = "no hit"
    if racket["p50"] is not None:
        speed = f"racket at the hit {racket['p50']:.1f} m/s (median), at most {racket['max']:.1f} m/s"
    strikes, inside = _share(robot["table_strike_share"]), _share(robot["self_penetration_share"])
    return [
        (
            "robot",
            f"{robot['name']}: {speed}; fastest joint at {robot['speed_over_limit_max']:.2f} of its limit",
        ),
        (
            "its faults",
            f"strikes on the table {strikes}, in itself {inside}, hits on the rim {_share(robot['rim_hit_share'])}",
        ),
    ]


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _rate(value: float | None, interval: tuple[float, float]) -> str:
    if value is None:
        return "-"
    low, high = interval
    return f"{_share(value):>7}  ({100 * low:.1f} to {100 * high:.1f})"


def _error(found: Mapping[str, Any]) -> str:
    if found["target_error_mean"] is None:
        return "-"
    interval = found["target_error_mean_ci"]
    spread = f"  ({interval[0]:.3f} to {interval[1]:.3f})" if interval else ""
    within = ", ".join(
        f"{_share(value)} within {name.split('_')[1]} m"
        for name, value in found.items()
        if name.startswith("within_")
    )
    return (
        f"{found['target_error_mean']:.3f} m{spread}, median {found['target_error_median']:.3f} m; {within}"
    )
