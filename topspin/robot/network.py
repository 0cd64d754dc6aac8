"""The exported network, run by ONNX Runtime."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnxruntime

from topspin.robot.contract import ExportError

Floats = npt.NDArray[np.float32]

INPUT, OUTPUT = "obs", "actions"


class Network:
    """Actions for raw observations. The normaliser and the limits of the actions are in the file.

    Args:
        file: ``policy.onnx``.
        size: How many numbers an observation has.

    Raises:
        ExportError: ONNX Runtime can't run the file, or it takes other observations.
    """

    def __init__(self, file: Path, size: int) -> None:
        options = onnxruntime.SessionOptions()
        # One thread that does not spin: a network of this size takes 20 us, and a robot's other threads need the cores
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                str(file), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's errors have no common class of their own
            raise ExportError(f"{file} can't be run by ONNX Runtime: {str(error).splitlines()[0]}") from None
        found = [(node.name, node.shape[-1]) for node in self._session.get_inputs()]
        if found != [(INPUT, size)]:
            raise ExportError(f"{file} takes {found}; its contract allows {[(INPUT, size)]}")

    def act(self, obs: Floats) -> Floats:
        """Return the actions (B, 7), in -1..1, for raw observations (B, D)."""
        (actions,) = self._session.run([OUTPUT], {INPUT: obs})
        found: Floats = actions
        return found
