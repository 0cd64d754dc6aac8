"""All generated files of docs/reference, by name."""

from pathlib import Path
from typing import Final

from common.service import metric_table
from common.task import observation_reference
from deploy.manifests import alarms
from topspin.reference import configuration, protocol, robots, sequences, state_diagram

FOLDER: Final = Path("docs/reference")  # from the project's folder


def files() -> dict[str, str]:
    """Return the content of each generated file by its name in `FOLDER`."""
    return {
        "observation.md": observation_reference.markdown(),
        "robots.md": robots.markdown(),
        "metrics.md": metric_table.markdown(),
        "alarms.md": alarms.markdown(),
        "protocol.md": protocol.markdown(),
        "configuration.md": configuration.markdown(),
        "states.svg": state_diagram.svg(),
        **{f"{sequence.name}.svg": sequences.svg(sequence) for sequence in sequences.SEQUENCES},
    }
