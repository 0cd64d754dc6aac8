"""Where a run keeps its things."""

import os
from dataclasses import dataclass
from pathlib import Path

RUNS = Path("runs")
LATEST = "latest"


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @staticmethod
    def of(run: str, folder: str = "") -> "RunFolder":
        """Return the folder of a run: runs/RUN unless another is given."""
        return RunFolder(Path(folder) if folder else RUNS / run)

    @property
    def config(self) -> Path:
        """Every setting of the run."""
        return self.root / "config.toml"

    @property
    def metrics(self) -> Path:
        """One row an epoch."""
        return self.root / "metrics.csv"

    @property
    def tensorboard(self) -> Path:
        """TensorBoard events."""
        return self.root / "tb"

    @property
    def checkpoints(self) -> Path:
        """What --resume goes on from."""
        return self.root / "checkpoints"

    @property
    def latest_policy(self) -> Path:
        """The newest policy."""
        return self.root / "policy" / "latest"

    @property
    def best_policy(self) -> Path:
        """The best policy by evaluation."""
        return self.root / "policy" / "best"

    @property
    def logs(self) -> Path:
        """One log a process."""
        return self.root / "logs"

    @property
    def report(self) -> Path:
        """Evaluations and reports."""
        return self.root / "report"

    @property
    def evaluations(self) -> Path:
        """The evaluator's curve: one row an evaluation."""
        return self.report / "evaluations.csv"

    def create(self) -> None:
        """Make the folders."""
        for path in (self.tensorboard, self.checkpoints, self.latest_policy.parent, self.logs, self.report):
            path.mkdir(parents=True, exist_ok=True)

    def point_latest_here(self) -> None:
        """Let runs/latest name this run."""
        link = self.root.parent / LATEST
        fresh = link.with_name(f".{LATEST}-{os.getpid()}")
        fresh.symlink_to(self.root.name)
        os.replace(fresh, link)
