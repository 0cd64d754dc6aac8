"""A page's closed loop against ours: the same balls, played by Node.js with the page's programs and by us.

    python -m benchmarks.web --json

The page has another MuJoCo (WebAssembly, and another version) and another ONNX Runtime; ball, rules and perception are
the same kernels, compiled for it. Each ball starts with the robot near home, as in `topspin view`.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Event
from typing import Any, Final, get_args

import numpy as np
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError
from common.evaluation.config import SEED
from common.evaluation.match import evaluation_rallies, match_task
from common.evaluation.rally_recorder import record_rallies
from common.policy.box import policy_folder
from common.policy.folder import Policy, load_policy
from common.task.config import MatchConditions, PresetName
from common.task.states import Outcome
from topspin.web.folder import BALLS, write_page

FOUND: Final = "found.json"  # that Node.js writes
PLAY: Final = """
import fs from "node:fs";
const [count, ...kinds] = process.argv.slice(1);
const { Match } = await import(`${process.cwd()}/match.js`);
const match = await Match.load(async (name) => new Uint8Array(fs.readFileSync(name)).buffer);
const found = {};
for (const kind of kinds) {
  const balls = await match.balls(kind), started = performance.now();
  const outcomes = [], errors = [];
  for (let k = 0; k < count; k++) {
    const { outcome, landingError } = await match.play(balls.of(k));
    outcomes.push(outcome);
    errors.push(landingError);
  }
  found[kind] = { outcomes, errors, ms: (performance.now() - started) / count };
}
fs.writeFileSync("found.json", JSON.stringify(found));
process.exit(0);
"""


class WebBenchmark(BenchmarkConfig):
    """Compare the page's closed loop with ours."""

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    balls: int = Field(BALLS, ge=1, le=BALLS, description="balls of each kind")


def main(config: WebBenchmark, _stop: Event) -> int:
    """Measure and print."""
    policy, kinds = load_policy(policy_folder(config.policy)), get_args(PresetName)
    with tempfile.TemporaryDirectory() as place:
        page = Path(place) / "page"
        write_page(policy, config.policy, page)
        found = played(page, config.balls, kinds)
    figures: dict[str, Any] = {"policy": config.policy, "balls_of_each_kind": config.balls}
    for kind in kinds:
        figures |= compared(policy, kind, found[kind])
    print_figures(figures, config.json_line)
    return 0


def played(page: Path, balls: int, kinds: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return outcomes and landing errors of each kind's first balls, and the time of a ball, by the page's programs."""
    node = shutil.which("node")
    if node is None:
        raise ReportedError("the benchmark needs Node.js, which isn't installed")
    (page / "package.json").write_text('{"type": "module"}')  # read the programs as browsers do
    subprocess.run([node, "--input-type=module", "-e", PLAY, str(balls), *kinds], cwd=page, check=True)
    found: dict[str, dict[str, Any]] = json.loads((page / FOUND).read_text())
    return found


def compared(policy: Policy, kind: PresetName, page: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of one kind of ball."""
    task = match_task(policy.contract, MatchConditions(launch=kind))
    balls = evaluation_rallies(BALLS, task, SEED).of(np.arange(len(page["outcomes"])))
    ours = record_rallies(policy.act, balls, task)
    outcomes, theirs = np.array([rally.outcome for rally in ours]), np.array(page["outcomes"])
    both = (outcomes == Outcome.RETURNED) & (theirs == Outcome.RETURNED)
    errors = np.array([rally.landing_error for rally in ours])[both]
    apart = np.abs(errors - np.array(page["errors"], np.float64)[both])
    return {
        f"{kind}_return_rate_ours": round(float((outcomes == Outcome.RETURNED).mean()), 4),
        f"{kind}_return_rate_page": round(float((theirs == Outcome.RETURNED).mean()), 4),
        f"{kind}_other_outcome": int((outcomes != theirs).sum()),
        f"{kind}_landing_error_apart_m_p50": float(f"{np.median(apart):.1e}"),
        f"{kind}_landing_error_apart_m_max": float(f"{apart.max():.1e}"),
        f"{kind}_ms_a_ball": round(page["ms"], 1),
    }


if __name__ == "__main__":
    sys.exit(run("web", WebBenchmark, main))
