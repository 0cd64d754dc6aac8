"""TensorBoard's event files, cut where a resumed run goes on: they then tell the same as metrics.csv."""

from pathlib import Path

from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.summary.writer.record_writer import RecordWriter


def cut_after(file: Path, step: int) -> None:
    """Remove a file's events after ``step``, and the file if it then has no values.

    The rest of a file after a damaged event goes too: no reader gets beyond it.
    """
    events = [(Event.FromString(raw), raw) for raw in RawEventFileLoader(str(file)).Load()]
    kept = [raw for event, raw in events if event.step <= step]
    if not any(event.HasField("summary") and event.step <= step for event, _ in events):
        file.unlink()
    elif len(kept) < len(events):
        part = file.with_name(f".{file.name}.part")
        with part.open("wb") as out:
            writer = RecordWriter(out)
            for raw in kept:
                writer.write(raw)
        part.replace(file)
