"""The measures of recorded balls as lines for people."""

from collections.abc import Mapping
from typing import Any

from common.evaluation.printed import aligned, results, table


def lines(found: Mapping[str, Any]) -> list[str]:
    """Return what was measured on recordings as lines for people."""
    by = {name: found[f"by_{name}"] for name in ("speed", "spin", "spin_kind")}
    return [*aligned(summary(found)), *table(by)]


def summary(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what was measured on recordings as names and texts."""
    policy = f"{found['policy']}, expected spin {found['expected_spin']}"
    if found["expected_spin"] == "learnt":
        policy += f", opponents {found['opponents']:,}"
    lines = [
        ("policy", policy),
        ("recordings", f"{found['recordings']:,} of {found['data']}"),
        ("not valid", _counts(found["invalid"])),
        ("left out", _counts(found["dropped"])),
        ("skipped files", "; ".join(f"{name}: {why}" for name, why in found["skipped"].items())),
    ]
    if "tracks_fitted" in found:
        lines += _fits(found)
    lines.append(
        (
            "played",
            f"{found['rallies']:,} balls, mode {found['mode']}, randomization {found['randomization']}, "
            f"perception {found['perception']}, seed {found['seed']}",
        )
    )
    lines += results(found)
    lines += [(name, found[name]) for name in ("video", "report") if name in found]
    lines.append(("took", f"{found['seconds']:.1f} s"))
    return [(name, text) for name, text in lines if text]


def _fits(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    median, most = 1e3 * found["fit_rms_median"], 1e3 * found["fit_rms_p90"]
    spin = ", ".join(f"{sigma:.1f}" for sigma in found["spin_sigma_median"])
    return [
        (
            "fits",
            f"{found['tracks_fitted']:,} tracks, {found['used_samples']:,} of {found['samples']:,} samples; "
            f"they are {median:.1f} mm away in the median, {most:.1f} mm in nine of ten",
        ),
        (
            "sigma",
            f"{1e3 * found['noise_median']:.1f} mm of a sample, {spin} rad/s of the spin in x, y, z (medians)",
        ),
    ]


def _counts(by_reason: Mapping[str, int]) -> str:
    return "; ".join(f"{count:,}: {reason}" for reason, count in by_reason.items())
