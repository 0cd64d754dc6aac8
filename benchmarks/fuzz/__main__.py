"""`python -m benchmarks.fuzz`: look for inputs that a decoder or a file reader neither reads nor refuses.

Each target has a process of its own, in which Atheris (libFuzzer) makes inputs from valid ones, and keeps those that
reach new lines of code. A process that is slow, large or dead is a fault, as is any error that is not a refusal.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Final

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.process import DONE

if TYPE_CHECKING:
    from benchmarks.fuzz.targets import Target

SLOWEST_S: Final = 5  # one input
LARGEST_MIB: Final = 2048  # the process, with torch and all that it imports
LONGEST_INPUT: Final = 1 << 20  # bytes
ENGINE: Final = "atheris>=3,<4"


class FuzzConfig(BenchmarkConfig):
    """Give bytes that nobody meant to every decoder and every file reader. Needs the package atheris."""

    inputs: int = Field(1_000_000, ge=1, description="inputs of each target")
    targets: tuple[str, ...] = Field((), description="names of targets; empty: all")
    seconds: float = Field(
        0.0, ge=0, description="longest time for each target; 0: any", json_schema_extra={"unit": "s"}
    )
    seed: int = Field(1, ge=1, description="of the inputs")
    child: str = Field("", description="the target of this process: it is how the benchmark starts them")


def fuzz_here(config: FuzzConfig) -> None:
    """Fuzz the target ``config.child`` in this process, which ends with it."""
    try:
        import atheris  # type: ignore[import-untyped] # noqa: PLC0415 - a tool that most machines lack
    except ImportError:
        raise ReportedError(f"atheris is not installed: pip install '{ENGINE}'") from None
    with atheris.instrument_imports(
        include=["common.comms", "common.policy", "services.learner", "topspin.real2sim"]
    ):
        from benchmarks.fuzz.targets import targets  # noqa: PLC0415 - Atheris must see the import
    target, (corpus,) = targets()[config.child], config.targets

    def read(data: bytes) -> None:
        target.run(data)

    limits = [f"-runs={config.inputs}", f"-max_len={LONGEST_INPUT}", f"-timeout={SLOWEST_S}"]
    limits += [f"-rss_limit_mb={LARGEST_MIB}", f"-seed={config.seed}", f"-artifact_prefix={corpus}/fault-"]
    if config.seconds:
        limits.append(f"-max_total_time={int(config.seconds)}")
    atheris.Setup([sys.argv[0], *limits, "-print_final_stats=1", corpus], read)
    atheris.Fuzz()


def fuzz(target: "Target", config: FuzzConfig, stop: Event) -> dict[str, Any]:
    """Return the figures of a target, from a process of its own."""
    with tempfile.TemporaryDirectory(prefix="topspin-fuzz-") as folder:
        for number, example in enumerate(target.examples):
            (Path(folder) / f"example-{number}").write_bytes(example)
        flags = ["--child", target.name, "--inputs", str(config.inputs), "--seconds", str(config.seconds)]
        flags += ["--seed", str(config.seed)]
        began = time.monotonic()
        output = Path(folder) / "output"
        with output.open("wb") as out:
            command = [sys.executable, "-m", "benchmarks.fuzz", *flags, "--targets", folder]
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
            try:
                while process.poll() is None:
                    check(stop)
                    time.sleep(0.2)
            finally:
                process.kill()
                process.wait()
        text = output.read_text(errors="replace")
        faults = sorted(Path(folder).glob("fault-*"))
        kept = [fault.read_bytes() for fault in faults]
    ran = re.search(r"stat::number_of_executed_units:\s*(\d+)", text)
    memory = re.search(r"stat::peak_rss_mb:\s*(\d+)", text)
    if process.returncode and not kept:
        raise ReportedError(
            f"{target.name}: {text.strip().splitlines()[-1] if text.strip() else 'no output'}"
        )
    reason = next((line for line in text.splitlines() if "Error" in line or "ERROR" in line), "")
    return {
        "inputs": int(ran.group(1)) if ran else 0,
        "seconds": round(time.monotonic() - began, 1),
        "peak_mib": int(memory.group(1)) if memory else 0,
        "faults": len(kept),
        **({"reason": reason.strip(), "input": kept[0][:200].hex()} if kept else {}),
    }


def main(config: FuzzConfig, stop: Event) -> int:
    """Fuzz and print; the status is 1 if there is a fault."""
    if config.child:
        fuzz_here(config)
    from benchmarks.fuzz.targets import targets  # noqa: PLC0415 - in a child Atheris must see the import

    known = targets()
    unknown = set(config.targets) - set(known)
    if unknown:
        raise ReportedError(f"no target {sorted(unknown)[0]!r}; allowed: {', '.join(known)}")
    found: dict[str, dict[str, Any]] = {}
    for name in config.targets or known:
        found[name] = fuzz(known[name], config, stop)
        print(f"{name}: {found[name]}", file=sys.stderr)
    result = {
        "targets": len(found),
        "inputs": sum(one["inputs"] for one in found.values()),
        "faults": sum(one["faults"] for one in found.values()),
        "peak_mib_max": max(one["peak_mib"] for one in found.values()),
        "by_target": found,
    }
    print_figures(result, config.json_line)
    return DONE if result["faults"] == 0 else 1


if __name__ == "__main__":
    sys.exit(run("fuzz", FuzzConfig, main))
