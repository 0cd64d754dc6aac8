"""The libraries of the page, from the npm registry: pinned by version and content, and copied into the page's folder.

To take another version: change its row; ``npm view NAME@VERSION dist.integrity`` prints the content's hash.
"""

import base64
import hashlib
import json
import shutil
import subprocess
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from common.errors import ReportedError

_LONGEST_S: Final = 300.0  # of a download
_FLAGS: Final = (
    "--json",
    "--prefer-offline",
    "--ignore-scripts",
    "--fetch-retries=1",
    "--fetch-retry-mintimeout=1000",
)
_ADVICE: Final = (
    "a written page needs neither npm nor a network: write it on a computer that has both, and copy it"
)


class PackageError(ReportedError):
    """A library can't be had: one line with what to do."""


@dataclass(frozen=True, slots=True)
class Package:
    """A library, and which of its files a page needs."""

    name: str
    version: str
    integrity: str  # sha512 of the archive, as npm prints it
    licence: str
    files: tuple[str, ...]


PACKAGES: Final = (
    Package(
        "@mujoco/mujoco",
        "3.14.0",
        "sha512-WPUYidu4Fx8+uM4hQv80SOA0ifpWGrsNJguKs8JBV8SCTxjKQ2/rqsh880nUH0/Vwa8vuefghvCQkkoed3bkUg==",
        "Apache-2.0",
        ("mujoco.js", "mujoco.wasm"),
    ),
    Package(
        "onnxruntime-web",
        "1.30.0",
        "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
        "MIT",
        (
            "dist/ort.wasm.min.mjs",
            "dist/ort-wasm-simd-threaded.mjs",
            "dist/ort-wasm-simd-threaded.wasm",
        ),
    ),
    Package(
        "three",
        "0.187.0",
        "sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
        "MIT",
        (
            "build/three.core.js",
            "build/three.module.js",
            "examples/jsm/controls/OrbitControls.js",
            "LICENSE",
        ),
    ),
)


def listed() -> str:
    """Return the libraries as a Markdown list, with their licences."""
    return "".join(f"- {package.name} {package.version}, {package.licence}\n" for package in PACKAGES)


def fetch(folder: Path) -> None:
    """Write the libraries' files into ``folder``; npm keeps what it has fetched, so a second call needs no network.

    Raises:
        PackageError: npm is missing, or a library can't be fetched, or is not the one that is pinned.
    """
    npm = shutil.which("npm")
    if npm is None:
        raise PackageError(
            f"a page needs npm (it comes with Node.js), which isn't installed; install it, or: {_ADVICE}"
        )
    with tempfile.TemporaryDirectory() as place:
        for package, archive in zip(PACKAGES, _archives(npm, Path(place)), strict=True):
            check(package, archive.read_bytes())
            _extract(package, archive, folder)


def check(package: Package, content: bytes) -> None:
    """Raise PackageError unless an archive is the one that is pinned."""
    found = f"sha512-{base64.b64encode(hashlib.sha512(content).digest()).decode()}"
    if found != package.integrity:
        raise PackageError(
            f"{package.name}@{package.version} from npm is {found[:20]}...; allowed: {package.integrity[:20]}... "
            "(topspin/web/packages.py)"
        )


def _archives(npm: str, place: Path) -> list[Path]:
    """Return the archives of all packages, fetched into a folder."""
    wanted = [f"{package.name}@{package.version}" for package in PACKAGES]
    try:
        done = subprocess.run(
            [npm, "pack", *wanted, *_FLAGS],
            cwd=place,
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise PackageError(
            f"npm did not fetch {', '.join(wanted)} within {_LONGEST_S:.0f} s; {_ADVICE}"
        ) from None
    if done.returncode != 0:
        reason = _reason(done.stdout, done.stderr)
        raise PackageError(f"npm can't fetch {', '.join(wanted)}: {reason}; {_ADVICE}")
    # npm 7 and 8 report @scope/name-1.0.tgz for the file scope-name-1.0.tgz
    names = (str(found["filename"]) for found in json.loads(done.stdout))
    return [place / name.removeprefix("@").replace("/", "-") for name in names]


def _reason(out: str, errors: str) -> str:
    """Return npm's reason as one line."""
    try:
        summary = json.loads(out)["error"]["summary"]
    except (ValueError, KeyError, TypeError):
        summary = errors
    lines = [line.strip() for line in str(summary).splitlines() if line.strip()]
    return lines[0].removeprefix("npm error ") if lines else "no reason given"


def _extract(package: Package, archive: Path, folder: Path) -> None:
    with tarfile.open(archive) as files:
        for name in package.files:
            content = files.extractfile(f"package/{name}")
            if content is None:
                raise PackageError(f"{package.name}@{package.version} has no {name}")
            own = Path(name).name
            target = f"{package.name}.LICENSE" if own == "LICENSE" else own
            (folder / target).write_bytes(content.read())
