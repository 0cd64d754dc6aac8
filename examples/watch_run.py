"""For who keeps a run going: ask each of its services how it is; the status is 1 if something is wrong.

    python examples/watch_run.py night || mail -s "run night" me

It reads runs/NAME/targets.json, which a run keeps while it lives, then /readyz and /metrics of each service.
"""

import argparse
import json
import sys
import urllib.error
import urllib.request
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

SHOWN = {
    "learner": (
        "topspin_frames_total",
        "topspin_policy_lag",
        "topspin_rollbacks_total",
        "topspin_misfit_actors",
    ),
    "evaluator": ("topspin_return_rate", "topspin_target_error_meters"),
    "generator": ("topspin_messages_refused_total",),
    "actor": ("topspin_frames_total", "topspin_reconnects_total"),
}

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
parser.add_argument("run", help="its name")
parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs")
arguments = parser.parse_args()


def get(address: str, path: str) -> tuple[int, str]:
    """Return status and text of an answer; 0 and the reason if there is none."""
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError as error:
        return 0, str(error)


file = arguments.runs / arguments.run / "targets.json"
if not file.exists():
    sys.exit(
        f"no service of run {arguments.run} is known: {file} is missing; topspin train writes it while it runs"
    )
is_well = True
for group in json.loads(file.read_text()):
    role, name = group["labels"]["role"], f"{group['labels']['role']}-{group['labels']['id']}"
    (address,) = group["targets"]
    status, text = get(address, "/readyz")
    values = {}
    if status == 200:
        status, text = get(address, "/metrics")
    if status == 200:
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                values[sample.name] = values.get(sample.name, 0.0) + sample.value
    else:
        is_well = False
    numbers = "  ".join(
        f"{metric.removeprefix('topspin_')} {values[metric]:g}" for metric in SHOWN[role] if metric in values
    )
    print(f"{name:>12}  {'ready' if status == 200 else text.strip() or f'status {status}'}  {numbers}")
sys.exit(0 if is_well else 1)
