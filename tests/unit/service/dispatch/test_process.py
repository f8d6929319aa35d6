"""A dispatcher's process starts Ray first, and of Ray no more than it needs."""

import subprocess
import sys

import pytest

from workers.ray_executor import RayExecutor


def test_nothing_heavy_is_imported_before_ray_starts() -> None:
    heavy = "{'ray', 'numpy', 'numba', 'sqlalchemy', 'service.dispatch.dispatcher'}"
    code = f"import sys, service.dispatch.process; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.ray
def test_a_local_ray_has_neither_dashboard_nor_autoscaler_nor_collector_of_logs(
    ray_crew: RayExecutor,
) -> None:
    from ray._private.worker import _global_node

    assert ray_crew.slots > 0
    assert {"gcs_server", "raylet"} <= set(_global_node.all_processes)
    assert not {"dashboard", "monitor", "log_monitor"} & set(_global_node.all_processes)
