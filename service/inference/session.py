"""onnxruntime, and the only importer of it.

All graphs take their buffers from one arena, which grows by what is asked for. Without one each buffer is a fresh
mapping, whose page faults took a third of the time of a tile of 1.5 megapixels; with one that doubles for each graph
they took a third more memory. An arena keeps what the largest picture took, so who has read a large one says so.
A run asked to stop stops inside the graph, between two of its operators.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from service.inference.artifact import GraphFile, ModelFolderError
from service.inference.cancellation import Cancellation, Cancelled

# how long a thread waits awake for the next operator: from one to the next, not to the next picture
AWAKE_US = "100"
LOG_FATAL_ONLY = 4
GROW_AS_ASKED = 1
OUT_OF_MEMORY = ("Failed to allocate memory", "bad_alloc")  # in words, for the class of these errors is any failure's

onnxruntime.disable_telemetry_events()
onnxruntime.create_and_register_allocator(
    onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    ),
    onnxruntime.OrtArenaCfg(
        {
            "max_mem": 0,
            "arena_extend_strategy": GROW_AS_ASKED,
            "initial_chunk_size_bytes": -1,
            "max_dead_bytes_per_chunk": -1,
        }
    ),
)


class Graph:
    """One ONNX graph on the CPU; ``run`` may be called from several threads at once."""

    def __init__(self, path: Path, described: GraphFile, intra_op_threads: int) -> None:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.intra_op_num_threads = intra_op_threads
        options.inter_op_num_threads = 1
        options.enable_mem_pattern = False
        options.add_session_config_entry("session.intra_op.spin_duration_us", AWAKE_US)
        options.add_session_config_entry("session.use_env_allocators", "1")
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
        self, feeds: Mapping[str, NDArray[np.float32]], cancellation: Cancellation, *, free_memory: bool = False
    ) -> dict[str, NDArray[np.float32]]:
        """Every output by name; feeds without an input are left out. ``Cancelled`` when asked to stop, ``MemoryError``.

        ``free_memory`` gives back, at the end, what no run uses.
        """
        options = onnxruntime.RunOptions()
        if free_memory:
            options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        options.log_severity_level = LOG_FATAL_ONLY
        wanted = {name: feeds[name] for name in self.input_names}
        with cancellation.calling(lambda: setattr(options, "terminate", True)):
            try:
                values = self._session.run(self.output_names, wanted, options)
            except Exception as exc:
                if cancellation.is_set:
                    raise Cancelled from exc
                if any(sign in str(exc) for sign in OUT_OF_MEMORY):
                    raise MemoryError(str(exc)) from exc
                raise
        return dict(zip(self.output_names, values, strict=True))
