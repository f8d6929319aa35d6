"""The child process of `large_derivation`."""

import sys
from pathlib import Path
from typing import Any

from service.datasets.data_child import answer_task
from service.formats.mcap.mcap_files import read_mcap, write_recording
from sysid.data.derivations import apply_steps


def _derive(task: dict[str, Any]) -> list[dict[str, Any]]:
    recording, subtracted = apply_steps(read_mcap(Path(task["source"])), task["steps"])
    write_recording(recording, task["target"])
    return [trend._asdict() for trend in subtracted]


if __name__ == "__main__":
    sys.exit(answer_task(_derive))
