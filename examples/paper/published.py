"""Numbers printed in the paper (Asakura and Guo)."""

from collections.abc import Mapping
from dataclasses import dataclass

# Section 4: the true parameters of Examples 1 and 2, and the input q(t) (Eq. 15).
TRUE_1 = {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}
TRUE_2 = {"c": 0.2, "L": 0.5, "b": 5.0, "mu": 0.5}
AMPLITUDE, OMEGA, SAMPLE_TIME, SAMPLES = 10.0, 5.0, 0.02, 300
SIGMA = 0.01
SETTINGS = {
    "population": 50,
    "selection_rate": 0.5,
    "mutation": [[0, 0.2], [50, 0.8]],
    "generations": 400,
    "stagnation": 30,
}


@dataclass(frozen=True, slots=True)
class PublishedColumns:
    """A table's two columns of estimates."""

    simple: Mapping[str, float]
    proposed: Mapping[str, float]


TABLE_1 = PublishedColumns(
    simple={"c": 0.143109, "L": 0.393939, "b": 5.171065, "a": 1.018573},
    proposed={"c": 0.195112, "L": 0.497556, "b": 5.004888, "a": 1.012708},
)
TABLE_2 = PublishedColumns(
    simple={"c": 0.233822, "L": 0.532747, "b": 4.877810, "mu": 0.466276},
    proposed={"c": 0.215445, "L": 0.517107, "b": 4.956012, "mu": 0.520039},
)
# By pattern. The gain has no unit, in spite of the table's heading (physically G(0) = 1).
TABLE_3 = (
    PublishedColumns(
        {"K": 0.9892, "T": 0.2854, "L": 0.2385}, {"K": 0.9902, "T": 0.3402, "L": 0.1193}
    ),
    PublishedColumns(
        {"K": 0.9902, "T": 0.4985, "L": 0.0753}, {"K": 1.0000, "T": 0.3617, "L": 0.1349}
    ),
)
# In SI units: k_a and k_b are rates, k_c was printed in kPa/rad (the table says N·m/Pa of all).
TABLE_4 = PublishedColumns(
    simple={
        "J": 3.6e-4,
        "F_c": 1.0068e-2,
        "F_max": 3.5288e-2,
        "k_a": 83.0890,
        "k_b": 121.7009,
        "k_c": 416.9110e3,
    },
    proposed={
        "J": 3.6e-4,
        "F_c": 1.2317e-2,
        "F_max": 3.3333e-2,
        "k_a": 83.0890,
        "k_b": 121.6784,
        "k_c": 456.9892e3,
    },
)
