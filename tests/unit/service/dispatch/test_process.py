"""A dispatcher's process starts of Ray no more than it needs."""

from typing import Any

import pytest

from workers.ray_executor import RayExecutor


@pytest.mark.ray
def test_a_local_ray_has_neither_dashboard_nor_autoscaler_nor_collector_of_logs(
    ray_executor: RayExecutor,
) -> None:
    from ray._private import worker

    node: Any = worker._global_node
    assert ray_executor.slots > 0
    assert {"gcs_server", "raylet"} <= set(node.all_processes)
    assert not {"dashboard", "monitor", "log_monitor"} & set(node.all_processes)
