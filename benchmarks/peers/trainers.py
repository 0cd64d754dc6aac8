"""The trainers: one literal table, and how each gets an environment of its own."""

import importlib.metadata
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from common.errors import ReportedError

OURS: Final = "topspin"
PROJECT: Final = Path(__file__).parents[2]
SHARED: Final = ("torch", "mujoco", "numpy", "numba")  # a peer has them in our versions
INSTALL_S: Final = 900.0


@dataclass(frozen=True, slots=True)
class Trainer:
    """One trainer.

    Args:
        name: Its name.
        module: Of its launch script, in ``benchmarks.peers``.
        packages: What its environment has beside ours; none: it runs in ours.
        with_dependencies: Whether pip brings what they need. Otherwise ``packages`` has it, since their bounds exclude
            what our environment needs; they run with it all the same.
        build: Module to run after that.
        is_one_process: Whether the number of threads is its own choice: 1 or all cores, whichever is faster.
        network: How its network differs from ours.
    """

    name: str
    module: str
    packages: tuple[str, ...] = ()
    with_dependencies: bool = True
    build: str = ""
    is_one_process: bool = False
    network: str = ""

    @property
    def version(self) -> str:
        """Its package and release."""
        return self.packages[0] if self.packages else f"{OURS}=={importlib.metadata.version(OURS)}"


_ONE_TRUNK: Final = "our trunk for policy and value; ours gives the critic also the simulator's truth"

_PUFFERLIB_NEEDS: Final = ("pyro-ppl", "pyro-api", "opt-einsum", "rich-argparse", "nvidia-ml-py")
_SAMPLE_FACTORY_NEEDS: Final = ("signal-slot-mp", "faster-fifo", "colorlog", "threadpoolctl", "tensorboardx")

TRAINERS: Final = (
    Trainer(OURS, "launch.topspin"),
    Trainer("single_file", "single_file", is_one_process=True, network=_ONE_TRUNK),
    Trainer("sb3", "launch.sb3", ("stable-baselines3==2.9.2",), is_one_process=True, network=_ONE_TRUNK),
    Trainer(
        "rsl_rl",
        "launch.rsl_rl",
        ("rsl-rl-lib==5.5.1",),
        is_one_process=True,
        network="a trunk like ours for the policy, another for the value",
    ),
    Trainer(
        "pufferlib",
        "launch.pufferlib",
        ("pufferlib-core==3.0.23", *_PUFFERLIB_NEEDS),
        with_dependencies=False,
        build="launch.build_pufferlib",
        is_one_process=True,
        network=_ONE_TRUNK,
    ),
    Trainer(
        "sample_factory",
        "launch.sample_factory",
        ("sample-factory==2.1.1", *_SAMPLE_FACTORY_NEEDS),
        with_dependencies=False,
        network=_ONE_TRUNK,
    ),
    Trainer("rllib", "launch.rllib", ("ray[rllib]==2.60.0",), network=_ONE_TRUNK),
)
"""All trainers; the first is ours."""


def find_trainers(names: tuple[str, ...]) -> list[Trainer]:
    """Return ours and the peers with these names; all peers without names."""
    known = {trainer.name: trainer for trainer in TRAINERS}
    if unknown := [name for name in names if name not in known]:
        raise ReportedError(f"peers {', '.join(unknown)}; allowed: {', '.join(list(known)[1:])}")
    return [trainer for trainer in TRAINERS if not names or trainer.name in (OURS, *names)]


def install(trainer: Trainer, folder: Path) -> str:
    """Return the Python of a trainer: ours, or that of a new environment in ``folder``.

    The new environment sees the packages of ours, and adds its own. So all have one torch and one MuJoCo.

    Raises:
        ReportedError: It can't be installed; the text says why.
    """
    if not trainer.packages:
        return sys.executable
    place = folder / trainer.name
    _run(trainer, sys.executable, "-m", "venv", str(place))
    python = str(place / "bin" / "python")
    found = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    Path(found.stdout.strip(), "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pins = folder / "constraints.txt"
    versions = {name: importlib.metadata.version(name).partition("+")[0] for name in SHARED}
    pins.write_text("".join(f"{name}=={version}\n" for name, version in versions.items()))
    options = () if trainer.with_dependencies else ("--no-deps",)
    _run(trainer, python, "-m", "pip", "install", "--quiet", "-c", str(pins), *options, *trainer.packages)
    if trainer.build:
        _run(trainer, python, "-m", f"benchmarks.peers.{trainer.build}")
    return python


def _run(trainer: Trainer, *command: str) -> None:
    """Run a step of an installation."""
    try:
        done = subprocess.run(
            command, cwd=PROJECT, capture_output=True, text=True, check=False, timeout=INSTALL_S
        )
    except subprocess.TimeoutExpired:
        raise ReportedError(f"{trainer.name}: not installed within {INSTALL_S:.0f} s") from None
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("WARNING")]
        raise ReportedError(
            f"{trainer.name}: not installed: {lines[-1].strip() if lines else done.returncode}"
        )
