"""The report's tables: the paper's results beside ours, every seed, every kind of ball."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from common.evaluation.breakdown import BREAKDOWNS
from common.policy.folder import Policy
from common.task.states import Outcome
from topspin.report.paired import Comparison, comparisons
from topspin.report.results import GroupResult, Results, RunResult, Spread, mean_of

NOTHING: Final = "–"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text; the first column is left-aligned, the others right."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    emphasized: frozenset[int] = frozenset()  # rows
    note: str = ""


# fmt: off
PAPER: Final = (
    # algorithm, end-to-end, return rate, return after catch, target error
    ("MLP + ARS (Abeyruwan et al. 2023)",            "no",  "88.60 %",        NOTHING,  "0.4 m"),
    ("Muscular robot (Büchler et al. 2022)",         "yes", "75 %",           "78.1 %", NOTHING),
    ("Defensive player (Koç et al. 2018)",           "no",  "80 %",           NOTHING,  NOTHING),
    ("Focused player (Koç et al. 2018)",             "no",  "50 %",           NOTHING,  "0.25 m"),
    ("8dof + GCBC + SSP (GoalsEye, Ding et al. 2022)", "yes", "21 % (< 0.3 m)", NOTHING,  "0.84 m"),
    ("MLP + PPO (Mahjourian et al. 2018)",           "no",  "40 %",           NOTHING,  NOTHING),
    ("CNN + ES + AF (Gao et al. 2020)",              "yes", "79 %",           "80.6 %", NOTHING),
    ("Hu et al. 2025, stage 3 only",                 "yes", "51 %",           "84 %",   "0.44 m"),
    ("Hu et al. 2025, stages 1+2+3",                 "yes", "81 %",           "90 %",   "0.31 m"),
)
# fmt: on
"""The table of Hu et al. 2025 (arXiv 2503.01251); two of its citation keys name other works than its rows do."""


def markdown(table: Table) -> str:
    """Return a table as GitHub Markdown."""
    escaped = [tuple(cell.replace("|", "\\|") for cell in row) for row in table.rows]
    lines = [
        f"| {' | '.join(table.columns)} |",
        f"|{'|'.join(['---'] + ['---:'] * (len(table.columns) - 1))}|",
    ]
    for k, (first, *others) in enumerate(escaped):
        lines.append(f"| {' | '.join([f'**{first}**' if k in table.emphasized else first, *others])} |")
    return "\n".join(lines) + "\n"


# ---- cells


def percent(rate: float | None, digits: int = 1) -> str:
    """Return a rate as text."""
    return NOTHING if rate is None else f"{100 * rate:.{digits}f} %"


def metres(value: float | None, digits: int = 2) -> str:
    """Return a distance as text."""
    return NOTHING if value is None else f"{value:.{digits}f} m"


def _cell(
    found: Spread | None, interval: Sequence[float] | None, scale: float, digits: int, unit: str
) -> str:
    """Return mean +- standard deviation over the seeds, and the interval of all rallies, times ``scale``."""
    if found is None:
        return NOTHING
    text = f"{scale * found.mean:.{digits}f}"
    if found.deviation is not None:
        text += f" ± {scale * found.deviation:.{digits}f}"
    text += f" {unit}"
    if interval:
        text += f" [{scale * interval[0]:.{digits}f}, {scale * interval[1]:.{digits}f}]"
    return text


def _rate_cell(found: Spread | None, interval: Sequence[float] | None) -> str:
    return _cell(found, interval, 100, 1, "%")


def _metre_cell(found: Spread | None, interval: Sequence[float] | None) -> str:
    return _cell(found, interval, 1, 3, "m")


def _policies(one: GroupResult) -> str:
    """Return the number of policies in a row, and the number of their seeds or trained policies."""
    played = [result for result in one.runs if result.played is not None]
    seeds = len({result.seed for result in played})
    text = "1 seed" if seeds == 1 else f"{seeds} seeds"
    if len(played) > seeds:
        text = f"{len(played)} runs of {text}"
    means = [parts for result in played if (parts := mean_of(result.run.policy))]
    if means:
        text += (
            f", mean of {len(means[0])} policies" if len(played) == 1 else ", means of policies among them"
        )
    return text


def _end_to_end(one: GroupResult) -> str:
    """Return "yes" if all policies of a row are end-to-end by their contracts, else "no"; a dash without policies."""
    found = {policy.contract.is_end_to_end for result in one.runs if (policy := result.run.policy)}
    return NOTHING if not found else "yes" if found == {True} else "no"


def count_of(frames: int | None) -> str:
    """Return a number of frames as text."""
    return NOTHING if frames is None else f"{frames / 1e6:.1f} M"


def hours_of(seconds: float | None) -> str:
    """Return a duration as text."""
    if seconds is None:
        return NOTHING
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min"


# ---- tables


def headline(found: Results) -> Table:
    """Return the paper's table with our rows below its own."""
    rows = list(PAPER)
    for one in found.groups:
        if one.played is None:
            continue
        rows.append(
            (
                f"Topspin, {one.label} ({_policies(one)})",
                _end_to_end(one),
                _rate_cell(one.spread.get("return_rate"), one.pooled["return_rate_ci"]),
                _rate_cell(one.spread.get("return_after_catch"), one.pooled["return_after_catch_ci"]),
                _metre_cell(one.spread.get("target_error_mean"), one.pooled["target_error_mean_ci"]),
            )
        )
    return Table(
        "Beside the paper",
        ("algorithm", "end-to-end", "returned", "returned after catch", "target error"),
        tuple(rows),
        frozenset(range(len(PAPER), len(rows))),
        "Ours: mean ± standard deviation over seeds, and in brackets the 95 % interval of all their rallies "
        "(Wilson for rates, normal for the error; as if each seed played different balls; it describes these "
        "policies, not another seed). The other rows "
        "are as Hu et al. 2025 print them, with the works that they come from; balls, robots and "
        "simulators differ.",
    )


def by_seed(found: Results) -> Table:
    """Return every run's measures."""
    rows = []
    for one in found.groups:
        for result in one.runs:
            rows.append(_run_row(one, result))
    columns = (
        "run", "experiment", "seed", "frames", "trained", "policy from", "caught", "over the net", "returned",
        "after catch", "error", "median", "< 0.2 m", "< 0.3 m",
    )  # fmt: skip
    return Table("Every seed", columns, tuple(rows))


MEASURED: Final = {
    "return_rate": ("returned", 100.0, "points", 1),
    "return_after_catch": ("returned after catch", 100.0, "points", 1),
    "target_error_mean": ("target error", 1.0, "m", 3),
}
"""Name, scale, unit and digits of each compared measure."""


def _comparison_row(one: Comparison) -> tuple[str, ...]:
    name, scale, unit, digits = MEASURED[one.measure]
    found = one.difference
    mean = f"{scale * found.mean:+.{digits}f} {unit}"
    interval = p = NOTHING
    if found.low is not None and found.high is not None and found.p is not None:
        interval = f"{scale * found.low:+.{digits}f} to {scale * found.high:+.{digits}f}"
        p = "< 0.001" if found.p < 0.001 else f"{found.p:.3f}"
    return f"{one.second} minus {one.first}", name, mean, interval, p, str(found.pairs)


def differences(found: Results) -> Table | None:
    """Return the paired differences between experiments that share seeds; None if no two do."""
    rows = tuple(_comparison_row(one) for one in comparisons(found.groups))
    if not rows:
        return None
    return Table(
        "Differences, seed by seed",
        ("experiments", "measure", "mean difference", "95 % interval", "p", "pairs"),
        rows,
        note="Paired t-test over the seeds that both experiments have, two-sided, not corrected for the number of "
        "rows. An interval that contains 0 shows no difference; it does not show that there is none.",
    )


def _run_row(one: GroupResult, result: RunResult) -> tuple[str, ...]:
    m, policy = result.measures, result.run.policy
    return (
        result.run.name,
        one.label,
        str(result.seed),
        count_of(result.frames),
        hours_of(result.seconds),
        NOTHING if policy is None else _policy_text(policy),
        *(percent(m.get(name)) for name in ("catch_rate", "over_rate", "return_rate", "return_after_catch")),
        metres(m.get("target_error_mean"), 3),
        metres(m.get("target_error_median"), 3),
        percent(m.get("within_0.2_m")),
        percent(m.get("within_0.3_m")),
    )


def _policy_text(policy: Policy) -> str:
    parts = mean_of(policy)
    mean = f"mean of {len(parts)}, to " if parts else ""
    return f"{mean}{count_of(policy.contract.frames)}, stage {policy.contract.stage}"


def outcomes(found: Results) -> Table:
    """Return how rallies ended."""
    groups = [one for one in found.groups if one.played is not None]
    rows = []
    for outcome in Outcome:
        name = outcome.name.lower()
        shares = [one.pooled["outcomes"].get(name, 0) / one.pooled["rallies"] for one in groups]
        if any(shares):
            rows.append((name.replace("_", " "), *(percent(share) for share in shares)))
    return Table("How rallies ended", ("outcome", *(one.label for one in groups)), tuple(rows))


def robots(found: Results) -> Table | None:
    """Return what each run's policy asked of its robot, or None if none was played."""
    rows = []
    for one in found.groups:
        for result in one.runs:
            asked = result.robot
            if not asked:
                continue
            fastest = max(asked["speed_over_limit_by_joint"].items(), key=lambda joint: joint[1])
            speed = asked["racket_speed_m_per_s"]
            rows.append(
                (
                    result.run.name,
                    asked["name"],
                    percent(asked["self_penetration_share"], 2),
                    percent(asked["table_strike_share"], 2),
                    f"{asked['speed_over_limit_max']:.2f} ({fastest[0]})",
                    *(NOTHING if speed[k] is None else f"{speed[k]:.1f} m/s" for k in ("p50", "max")),
                    percent(asked["rim_hit_share"]),
                )
            )
    columns = (
        "run", "robot", "in itself > 2 mm", "on the table > 50 N", "joint speed / limit", "racket at contact, median",
        "largest", "hits on the rim",
    )  # fmt: skip
    note = (
        "Shares of rallies, on the rim of hits; largest joint speed over its limit, and the joint; the rim is beyond "
        "85 % of the radius."
    )
    return Table("What it asked of the robot", columns, tuple(rows), note=note) if rows else None


def by_kind(found: Results) -> list[Table]:
    """Return a table for each breakdown."""
    groups = [one for one in found.groups if one.played is not None]
    return [kind_table(key, groups) for key in BREAKDOWNS] if groups else []


def kind_table(key: str, groups: Sequence[GroupResult]) -> Table:
    """Return the table of one breakdown, a key of BREAKDOWNS."""
    kind = BREAKDOWNS[key]
    found: list[Mapping[str, Mapping[str, Any]]] = [
        {entry["bin"]: entry for entry in one.by[key]} for one in groups
    ]
    rows = []
    for name in kind.bins:
        entries = [of_group.get(name) for of_group in found]
        if not any(entries):
            continue
        balls = sum(entry["rallies"] for entry in entries if entry)
        rows.append((name, str(balls), *(_kind_cell(entry) for entry in entries)))
    columns = (kind.title, "rallies", *(one.label for one in groups))
    return Table(f"By {kind.title}: caught / returned / landing error", columns, tuple(rows))


def _kind_cell(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return NOTHING
    return " / ".join(
        (
            percent(entry["catch_rate"], 0),
            percent(entry["return_rate"], 0),
            metres(entry["target_error_mean"]),
        )
    )


def rounds(found: Results) -> Table | None:
    """Return how long rallies last, or None if that wasn't played."""
    groups = [one for one in found.groups if one.survival]
    if not groups:
        return None
    numbers = sorted({entry["round"] for one in groups for entry in one.survival["by_round"]})
    rows = []
    for number in numbers:
        cells = []
        for one in groups:
            entry = next((e for e in one.survival["by_round"] if e["round"] == number), None)
            cells.append(
                NOTHING
                if entry is None
                else f"{percent(entry['return_rate'])} of {entry['rallies']} / {percent(entry['survival'])}"
            )
        rows.append((str(number), *cells))
    rows.append(("balls in a row", *(f"{one.survival['rally_length_mean']:.2f}" for one in groups)))
    columns = ("ball of the episode", *(one.label for one in groups))
    note = "Share returned of the balls that were played / share of episodes still in play after it."
    return Table("Ball after ball", columns, tuple(rows), frozenset({len(rows) - 1}), note)
