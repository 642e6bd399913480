"""onnxruntime, and the only importer of it.

The memory arena is off. Over pictures of many sizes it kept 520 MB for ever where 158 MB were kept without it,
for 5 % of the time (compact pair, up to 1.5 megapixels).
A run asked to stop stops inside the graph, between two of its operators.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from service.inference.artifact import GraphFile, ModelFolderError
from service.inference.cancellation import Cancellation, Cancelled

LOG_FATAL_ONLY = 4

onnxruntime.disable_telemetry_events()


class Graph:
    """One ONNX graph on the CPU; ``run`` may be called from several threads at once."""

    def __init__(self, path: Path, described: GraphFile, intra_op_threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.intra_op_num_threads = intra_op_threads
        options.inter_op_num_threads = 1
        options.enable_cpu_mem_arena = False
        options.enable_mem_pattern = False
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as exc:  # onnxruntime's errors have no common base of their own
            raise ModelFolderError(f"{path} cannot be run: {exc}") from exc
        self.input_names = tuple(tensor.name for tensor in self._session.get_inputs())
        self.output_names = tuple(tensor.name for tensor in self._session.get_outputs())
        if set(self.input_names) != set(described.input_names):
            raise ModelFolderError(f"{path} has the inputs {self.input_names}, the manifest others")
        if missing := set(described.output_names) - set(self.output_names):
            raise ModelFolderError(f"{path} lacks the outputs {sorted(missing)} that the manifest names")

    def run(
        self, feeds: Mapping[str, NDArray[np.float32]], cancellation: Cancellation
    ) -> dict[str, NDArray[np.float32]]:
        """Every output by name; feeds without an input are left out. ``Cancelled`` when asked to stop."""
        options = onnxruntime.RunOptions()
        options.log_severity_level = LOG_FATAL_ONLY
        wanted = {name: feeds[name] for name in self.input_names}
        with cancellation.calling(lambda: setattr(options, "terminate", True)):
            try:
                values = self._session.run(self.output_names, wanted, options)
            except Exception as exc:
                if cancellation.is_set:
                    raise Cancelled from exc
                raise
        return dict(zip(self.output_names, values, strict=True))
