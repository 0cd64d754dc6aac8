"""The house in numbers: how long the papers and the files are, whether imports keep to the floor plan, and whether each
setting of the task is defined once.

    python -m benchmarks.house --json
"""

import ast
import json
import re
import subprocess
import sys
import sysconfig
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any, Final

from benchmarks.settings import BenchmarkConfig, run
from common.errors import ReportedError

PROJECT: Final = Path(__file__).parents[1]
CODE: Final = ("common", "services", "deploy", "topspin", "benchmarks", "tests")
LIVE: Final = ("common", "services", "deploy", "topspin")
ONCE: Final = ("launch", "randomization", "flight")
"""Settings of the task that must have one definition, shared by all programs that play or measure."""
TABLE_SHARE: Final = 0.5  # a file of which a literal table is this share is exempt from the limit of lines


class HouseConfig(BenchmarkConfig):
    """Count what the plan of the project limits: papers, files, imports, settings and pages."""


def main(config: HouseConfig, stop: Event) -> int:
    """Print the numbers; return the exit status."""
    del stop
    readme = (PROJECT / "README.md").read_text(encoding="utf-8")
    longest, lines = longest_file()
    kept, broken = import_contracts()
    pages, warnings = docs()
    found = definitions()
    row = {
        "readme_lines": len(readme.splitlines()),
        "readme_words": len(readme.split()),
        "longest_file": longest,
        "longest_file_lines": lines,
        "import_contracts": kept + broken,
        "import_contracts_broken": broken,
        "definitions_of_settings": found,
        "duplicate_setting_fields": sum(max(0, count - 1) for count in found.values()),
        "docs_pages": pages,
        "docs_warnings": warnings,
    }
    if not config.json_line:
        for name, value in row.items():
            sys.stdout.write(f"{name:26} {value}\n")
    else:
        sys.stdout.write(json.dumps(row) + "\n")
    return 0


def sources(folders: tuple[str, ...]) -> Iterator[Path]:
    """Yield the Python files of these folders."""
    for folder in folders:
        yield from sorted((PROJECT / folder).rglob("*.py"))


def longest_file() -> tuple[str, int]:
    """Return the longest file that is not mostly one literal table, and its lines."""
    counts = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in sources(CODE)}
    for path, lines in sorted(counts.items(), key=lambda item: -item[1]):
        if _table_lines(path) < TABLE_SHARE * lines:
            return str(path.relative_to(PROJECT)), lines
    raise ReportedError(f"no code under {PROJECT}")


def _table_lines(path: Path) -> int:
    """Return the lines of the longest value that a module assigns to a name."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return max(((value.end_lineno or value.lineno) - value.lineno + 1 for value in values), default=0)


def import_contracts() -> tuple[int, int]:
    """Return the import contracts kept and broken."""
    output = _run("lint-imports")
    found = re.search(r"Contracts: (\d+) kept, (\d+) broken", output)
    if found is None:
        raise ReportedError(f"lint-imports did not count its contracts: {output.strip().splitlines()[-1:]}")
    return int(found[1]), int(found[2])


def definitions() -> dict[str, int]:
    """Return how many settings models define each of the settings `ONCE`."""
    counts: Counter[str] = Counter(dict.fromkeys(ONCE, 0))
    for path in sources(LIVE):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                counts.update(name for name in ONCE if any(_defines(part, name) for part in node.body))
    return dict(counts)


def _defines(node: Any, name: str) -> bool:
    """Return whether a line of a class is ``name: ... = Field(...)``."""
    return (
        isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and node.target.id == name
        and isinstance(node.value, ast.Call)
        and isinstance(node.value.func, ast.Name)
        and node.value.func.id == "Field"
    )


def docs() -> tuple[int, int]:
    """Return the pages of the documentation, and the warnings of its build."""
    output = _run("mkdocs", "build", "--site-dir", "build/site")
    pages = len(list((PROJECT / "build" / "site").rglob("*.html"))) - 1  # without the page for a broken link
    return pages, len(re.findall(r"^WARNING", output, re.MULTILINE))


def _run(program: str, *words: str) -> str:
    command = Path(sysconfig.get_path("scripts")) / program
    try:
        done = subprocess.run(
            [str(command), *words], cwd=PROJECT, capture_output=True, text=True, check=False, timeout=300
        )
    except OSError as error:
        raise ReportedError(f"can't run {command}: {error.strerror}; make installs it into .venv") from error
    return done.stdout + done.stderr


if __name__ == "__main__":
    sys.exit(run("house", HouseConfig, main))
