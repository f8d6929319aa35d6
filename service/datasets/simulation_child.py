"""The child process of `large_simulation`."""

import sys
from pathlib import Path
from typing import Any

from service.datasets.data_child import answer_task
from service.formats.mcap.mcap_files import read_mcap, write_recording
from sysid.kernels.compilation.compile_task import decode_model
from sysid.simulation.simulate import simulate


def _simulate(task: dict[str, Any]) -> None:
    *inputs, given = read_mcap(Path(task["source"])).channels
    outputs = simulate(decode_model(task["model"]), inputs, task["values"], times=given.times)
    write_recording(outputs, task["target"])


if __name__ == "__main__":
    sys.exit(answer_task(_simulate))
