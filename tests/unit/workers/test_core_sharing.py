"""The cores of one cluster are divided by need, and otherwise equally."""

from hypothesis import given
from hypothesis import strategies as st

from workers.core_sharing import divide_cores

WANTED = st.dictionaries(st.sampled_from("abcdefgh"), st.integers(0, 200), min_size=1)


@given(st.integers(1, 100), WANTED)
def test_nobody_is_without_a_core_and_no_core_is_promised_twice(n_cores, wanted):
    shares = divide_cores(n_cores, wanted)
    assert min(shares.values()) >= 1
    assert sum(share for share in shares.values() if share > 1) <= n_cores


@given(st.integers(8, 100), WANTED)
def test_who_gets_less_than_it_wants_gets_no_less_than_anybody_else(n_cores, wanted):
    shares = divide_cores(n_cores, wanted)
    for name, share in shares.items():
        if share < wanted[name]:
            assert share >= max(shares.values()) - 1


def test_a_cluster_without_others_belongs_to_one():
    assert divide_cores(7, {"alone": 7}) == {"alone": 7}


def test_what_one_does_not_want_the_others_have():
    assert divide_cores(10, {"idle": 0, "single": 1, "sweep": 10}) == {
        "idle": 1,
        "single": 1,
        "sweep": 9,
    }
