"""The page: tables and plots in order, as report.md and as report.html, a single file."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import jinja2

from common.errors import ReportedError
from common.service.whole_file import write_whole
from topspin.report import tables
from topspin.report.provenance import own_command
from topspin.report.results import Results, as_json, mean_of
from topspin.report.style import Drawing
from topspin.report.tables import Table, markdown

TITLE: Final = "Topspin: results of the runs"


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page; its content is in this order."""

    title: str
    text: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    code: str = ""


def sections(found: Results, drawings: Sequence[Drawing]) -> list[Section]:
    """Return the page's parts."""

    def named(*beginnings: str) -> tuple[Drawing, ...]:
        return tuple(drawing for drawing in drawings if drawing.name.startswith(beginnings))

    config = found.settings
    rounds, differences, robots = tables.rounds(found), tables.differences(found), tables.robots(found)
    parts = [
        Section(
            "",
            (
                f"Every policy plays the same {config.rallies:,} rallies (launch {config.launch}, randomization "
                f"{config.randomization}, air {config.flight}, perception {config.perception}, collision "
                f"{config.collision}, seed {config.seed} of the evaluation's own seeds, rounds "
                f"{config.rounds}, expected spin {config.expected_spin}), without exploration noise and to their end. "
                "Runs that differ only in their seed are one group.",
            ),
        ),
        Section("In words", note(config.note)),
        Section("Missing or unequal", missing=found.missing),
        Section("Beside the paper", tables=(tables.headline(found),)),
        Section("Differences, seed by seed", tables=(differences,) if differences else ()),
        Section("Training", drawings=named("curves")),
        Section("Every seed", tables=(tables.by_seed(found),)),
    ]
    if any(one.played is not None for one in found.groups):
        parts += [
            Section("What it asked of the robot", tables=(robots,) if robots else ()),
            Section("How rallies ended", tables=(tables.outcomes(found),), drawings=named("outcomes")),
            Section("Where balls land", drawings=named("landings", "courts")),
            Section("Ball after ball", tables=(rounds,) if rounds else (), drawings=named("rounds")),
            Section(
                "By kind of ball", tables=tuple(tables.by_kind(found)), drawings=named("rates", "errors")
            ),
        ]
    parts.append(Section("How it was made", (_machine(found),), code=_commands(found)))
    return [part for part in parts if part.text or part.missing or part.tables or part.drawings]


def note(path: str) -> tuple[str, ...]:
    """Return the paragraphs of a text file; none without a path. Raises ReportedError where it can't be read."""
    if not path:
        return ()
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it isn't UTF-8 text"
        raise ReportedError(f"can't read the note {path}: {reason}") from None
    return tuple(" ".join(paragraph.split()) for paragraph in text.split("\n\n") if paragraph.strip())


def _machine(found: Results) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in found.versions.items())
    return (
        f"Measured on {found.machine['processor']}, {found.machine['cores']} cores, {found.machine['system']}; "
        f"{versions}. The runs, each by the settings of its config.toml that are not the defaults:"
    )


def _commands(found: Results) -> str:
    """Return the commands of all runs, with seeds, frames and hours."""
    lines = []
    for one in found.groups:
        lines.append(f"# {one.description}")
        for result in one.runs:
            took = f"{tables.count_of(result.frames)} frames in {tables.hours_of(result.seconds)}"
            lines.append(f"{result.command}  # seed {result.seed}, {took}")
            if parts := mean_of(result.run.policy):
                lines.append(f"# then trained further: its policy is the mean of {len(parts)}")
                lines += [f"#     {part}" for part in parts]
        lines.append("")
    lines += ["# this report", own_command(found.settings)]
    return "\n".join(lines)


def as_markdown(parts: Sequence[Section], title: str = TITLE) -> str:
    """Return the page as Markdown with its plots beside it."""
    lines = [f"# {title}"]
    for part in parts:
        if part.title:
            lines.append(f"## {part.title}")
        lines += part.text
        if part.missing:
            lines.append("\n".join(f"- {line}" for line in part.missing))
        for table in part.tables:
            if table.title != part.title:
                lines.append(f"### {table.title}")
            lines.append(markdown(table).rstrip())
            if table.note:
                lines.append(table.note)
        for drawing in part.drawings:
            if drawing.title != part.title:
                lines.append(f"### {drawing.title}")
            lines += [f"![{drawing.title}]({drawing.name}.png)", drawing.caption]
        if part.code:
            lines.append(f"```\n{part.code}\n```")
    return "\n\n".join(lines) + "\n"


def as_html(parts: Sequence[Section], folder: Path, title: str = TITLE) -> str:
    """Return the page as one self-contained HTML file; the plots are read from ``folder``."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True
    )
    images = {
        drawing.name: base64.b64encode((folder / f"{drawing.name}.png").read_bytes()).decode()
        for part in parts
        for drawing in part.drawings
    }
    return environment.get_template("page.html.j2").render(title=title, sections=parts, images=images)


def write_numbers(found: Results, folder: Path) -> None:
    """Write results.json, which needs no plots."""
    write_whole(folder / "results.json", json.dumps(as_json(found), allow_nan=False, indent=1) + "\n")


def write(found: Results, drawings: Sequence[Drawing], folder: Path) -> None:
    """Write report.md and report.html beside the plots in ``folder``."""
    parts = sections(found, drawings)
    (folder / "report.md").write_text(as_markdown(parts), encoding="utf-8")
    (folder / "report.html").write_text(as_html(parts, folder), encoding="utf-8")
