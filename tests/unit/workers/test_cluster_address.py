"""Addresses of a Ray cluster that are refused before Ray would wait for them."""

import pytest

from workers.cluster_address import check_address
from workers.errors import ClusterUnavailable


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1 (Connection refused)"),
        ("nowhere.invalid:6379", "no Ray cluster answers at nowhere.invalid:6379"),
        ("10.0.0.5", "the Ray address '10.0.0.5' is invalid: write host:port"),
        ("10.0.0.5:65536", "the Ray address '10.0.0.5:65536' is invalid: write host:port"),
        ("ray://10.0.0.5:10001", "is one of Ray Client, which is not supported"),
    ],
)
def test_an_address_that_is_wrong_is_refused_in_one_line(address: str, message: str) -> None:
    with pytest.raises(ClusterUnavailable) as refused:
        check_address(address)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
