"""For a researcher: train the paper's recipe with several seeds, measure each, and print the table.

    python examples/reproduce_paper.py --seeds 1 2 --frames 60000000

Runs are in runs/RECIPE-FRAMES-SEED. What is trained already is not trained again, so the program goes on where it was
stopped.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

PAPER = {"return_rate": 0.81, "return_after_catch": 0.90, "target_error_mean": 0.31}  # Hu et al.

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
parser.add_argument("--frames", type=int, default=60_000_000, help="of each training")
parser.add_argument("--rallies", type=int, default=2000, help="on which each policy is measured")
parser.add_argument("--recipe", default="paper", help="paper: at 200 Hz; paper-50hz: a quarter of the time")
arguments, more = parser.parse_known_args()  # other flags are of topspin train


def topspin(*flags: object) -> str:
    """Run a command of Topspin; return its standard output."""
    command = [sys.executable, "-m", "topspin", *map(str, flags)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


found = {}
for seed in arguments.seeds:
    run = f"{Path(arguments.recipe).stem}-{arguments.frames}-{seed}"
    if Path("runs", run).exists():
        topspin("train", "--run", run, "--resume")
    else:
        flags = ("--recipe", arguments.recipe, "--seed", seed, "--frames", arguments.frames)
        topspin("train", "--run", run, *flags, *more)
    measured = topspin(
        *("evaluate", "--policy", f"runs/{run}/policy/latest"),
        *("--rallies", arguments.rallies, "--launch", "paper", "--json"),
    )
    found[seed] = json.loads(measured.splitlines()[-1])

print(f"{'':>20} {'paper':>7} {'median':>7}  by seed")
for name, theirs in PAPER.items():
    values = [figures[name] for figures in found.values()]
    known = [value for value in values if value is not None]  # no error where nothing was returned
    middle = f"{statistics.median(known):.3f}" if known else "-"
    each = "  ".join("-" if value is None else f"{value:.3f}" for value in values)
    print(f"{name:>20} {theirs:>7.2f} {middle:>7}  {each}")
