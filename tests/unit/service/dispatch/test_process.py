"""A dispatcher's process starts of Ray no more than it needs."""

import pytest

from workers.ray_executor import RayExecutor


@pytest.mark.ray
def test_a_local_ray_has_neither_dashboard_nor_autoscaler_nor_collector_of_logs(
    ray_executor: RayExecutor,
) -> None:
    from ray._private.worker import _global_node

    assert ray_executor.slots > 0
    assert {"gcs_server", "raylet"} <= set(_global_node.all_processes)
    assert not {"dashboard", "monitor", "log_monitor"} & set(_global_node.all_processes)
