"""Directions of which the data tell nothing or little, and what parameters they move."""

from dataclasses import dataclass

import numpy as np

from sysid.groups import Block, blocks
from sysid.types import BoolArray, FloatArray

# Share of a direction (squared) from which a parameter belongs to it: of one the data tell little
# about, and of one that has no effect at all, which is known to many digits.
_WEAK_MEMBER, NULL_MEMBER = 0.05, 1e-5
_SAYS_NOTHING = 0.5  # of the range: a standard error as large as that


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Singular directions (D, D) of the sensitivities, over the places.

    `null` are those along which the output does not change, `weak` those of which the data say
    little; `member` marks the parameters that `null` moves, `vague` those that are not told well.
    """

    rows: FloatArray
    null: BoolArray
    weak: BoolArray
    member: BoolArray
    vague: BoolArray


def weighed(
    singular: FloatArray, rows: FloatArray, null: BoolArray, moved: BoolArray,
    covariance: FloatArray, noise: float,
) -> Directions:  # fmt: skip
    """What a covariance (D, D) of the places makes of the singular directions (D, D).

    Parameters
    ----------
    singular : FloatArray, shape (D,)
    null : BoolArray, shape (D,)
    moved : BoolArray, shape (D,)
        Parameters that are known to be moved by what has no effect, however little.
    noise : float
        Its standard deviation.
    """
    spread = np.sqrt(np.maximum(np.einsum("id,de,ie->i", rows, covariance, rows), 0.0))
    weak = ~null & ((spread >= _SAYS_NOTHING) | (noise >= _SAYS_NOTHING * singular))
    member = np.any(rows[null] ** 2 > NULL_MEMBER, axis=0) | moved
    return Directions(rows, null, weak, member, np.diag(covariance) >= _SAYS_NOTHING**2)


def untold(directions: Directions) -> tuple[Block, ...]:
    """Parameters that have no effect of their own, then those of which the data say little."""
    found = blocks(directions.rows[directions.null], directions.member)
    weak = directions.rows[directions.weak]
    # One that has a small part in a direction of which nothing is known is not known either.
    has_part = np.any(weak**2 > _WEAK_MEMBER, axis=0) | directions.vague
    member = has_part & ~directions.member
    beside = blocks(weak, member)
    left = [one for one in beside if not one.basis.size]
    alone = [d for one in left for d in one.members if directions.vague[d]]
    nothing = tuple(Block(np.array([d]), np.zeros((0, 1))) for d in alone)
    return found + tuple(one for one in beside if one.basis.size) + nothing
