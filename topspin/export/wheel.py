"""The wheel ``topspin-robot``: the observer's and the controller's own source files, under one package name.

The files are read from where they are: there is no second copy of them. Their imports of ``common`` and of
``topspin.robot`` are renamed to ``topspin_robot``, so that the wheel owns one name and can live beside Topspin.
"""

import ast
import base64
import hashlib
import zipfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).parents[2]
PACKAGE, ROOT = "topspin_robot", "topspin.robot"
RENAMED: Final = {ROOT: PACKAGE, "common": f"{PACKAGE}.common"}
"""Packages that go into the wheel, as far as ``topspin.robot`` needs them, by their name there."""

REQUIRES: Final = (
    "llvmlite>=0.45,<1",
    "numba>=0.62,<0.70",
    "numpy>=2.1,<2.5",
    "onnxruntime>=1.20,<2",
    "pydantic>=2.11,<3",
)
"""What the wheel needs, with the bounds of ``pyproject.toml``, and the same versions of Python."""
REQUIRES_PYTHON: Final = ">=3.11,<3.14"

_DATE: Final = (2020, 1, 1, 0, 0, 0)  # of every file: equal sources give equal bytes
_README: Final = "Plays with a policy of `topspin export`. The README of the exported folder says how."


def file_of(module: str) -> Path | None:
    """Return the source file of a module of this project; None: there is none of this name."""
    path = PROJECT.joinpath(*module.split("."))
    found = [file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()]
    return found[0] if found else None


def imports_of(source: str) -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    """Yield each import of a source text, with the module that it names; for ``from m import n`` also m.n."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node, node.module
            yield from ((node, f"{node.module}.{alias.name}") for alias in node.names)


def owner_of(module: str) -> str | None:
    """Return which of ``RENAMED`` a module is in."""
    return next((name for name in RENAMED if module == name or module.startswith(f"{name}.")), None)


def modules() -> dict[str, Path]:
    """Return the files that the wheel holds, by module: ``topspin.robot``, and what it imports of the project."""
    start = [
        f"{ROOT}.{path.stem}"
        for path in (PROJECT / "topspin" / "robot").glob("*.py")
        if path.stem != "__init__"
    ]
    found: dict[str, Path] = {}
    waiting = [ROOT, *start]
    while waiting:
        module = waiting.pop()
        file = file_of(module)
        if module in found or file is None:
            continue
        found[module] = file
        if "." in module and owner_of(module.rpartition(".")[0]):
            waiting.append(module.rpartition(".")[0])
        waiting += [name for _, name in imports_of(file.read_text()) if owner_of(name)]
    return dict(sorted(found.items()))


def renamed(source: str) -> str:
    """Return a source text with its imports of the project as they are in the wheel.

    Raises:
        ValueError: An import binds ``common`` or ``topspin`` itself, or one of the project that the wheel lacks.
    """
    lines = source.splitlines(keepends=True)
    for node, module in imports_of(source):
        owner = owner_of(module)
        if owner is None and module.partition(".")[0] in ("common", "topspin", "deploy", "services"):
            raise ValueError(f"line {node.lineno} imports {module}; allowed: {', '.join(RENAMED)}")
        if owner is None:
            continue
        if isinstance(node, ast.Import):
            raise ValueError(f"line {node.lineno} is 'import {module}'; allowed: 'from {module} import ...'")
        if module == node.module:
            line = lines[node.lineno - 1]
            lines[node.lineno - 1] = line.replace(f"from {owner}", f"from {RENAMED[owner]}", 1)
    return "".join(lines)


def place_of(module: str, file: Path) -> str:
    """Return the path of a module's file inside the wheel."""
    owner = owner_of(module) or ""
    name = RENAMED[owner] + module.removeprefix(owner)
    return name.replace(".", "/") + ("/__init__.py" if file.name == "__init__.py" else ".py")


def build_wheel(folder: Path) -> Path:
    """Write the wheel (PEP 427) into ``folder`` and return its path."""
    release = version("topspin")
    files = {place_of(module, file): renamed(file.read_text()) for module, file in modules().items()}
    info = f"{PACKAGE}-{release}.dist-info"
    requires = "".join(f"Requires-Dist: {requirement}\n" for requirement in REQUIRES)
    files[f"{info}/METADATA"] = (
        f"Metadata-Version: 2.1\nName: topspin-robot\nVersion: {release}\n"
        "Summary: Plays table tennis with a policy of Topspin: observer and network, without simulator and torch\n"
        f"Requires-Python: {REQUIRES_PYTHON}\n{requires}Description-Content-Type: text/markdown\n\n{_README}\n"
    )
    files[f"{info}/WHEEL"] = (
        "Wheel-Version: 1.0\nGenerator: topspin\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    record = "".join(f"{name},{_hash_of(text)},{len(text.encode())}\n" for name, text in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n"
    path = folder / f"{PACKAGE}-{release}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            entry = zipfile.ZipInfo(name, _DATE)
            entry.external_attr, entry.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
            archive.writestr(entry, text)
    return path


def _hash_of(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"sha256={base64.urlsafe_b64encode(digest).decode().rstrip('=')}"
