"""History and migrants of a run in a few rows; signals of several runs in one object.

Old rows are carried over, back as well. Going down, runs whose signals share an object lose them:
what was written before reads an object as the signals of one run. All numbers stay.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from hashlib import blake2b
from itertools import groupby, islice
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
PHASES = ("start", "genetic", "sequence", "migration", "refinement")
MIGRANT = struct.Struct("<IIIId")
RUNS_AT_A_TIME, ROWS_AT_A_TIME = 200, 2000
PLACES = ("signals_start", "signals_size")

# Columns of the two tables besides `run_id`, as they were and as they are now; keys first.
POINTS = {
    "island": sa.Integer, "number": sa.Integer, "generation": sa.Integer, "evaluations": LARGE,
    "rms": sa.Double, "phase": sa.String, "parameters": JSON,
}  # fmt: skip
PARTS = {
    "digest": LARGE, "n_parameters": sa.Integer, "generation": sa.Integer, "evaluations": LARGE,
    "rms": sa.Double, "points": sa.LargeBinary,
}  # fmt: skip
LINES = {
    "number": sa.Integer, "epoch": sa.Integer, "source": sa.Integer, "destination": sa.Integer,
    "fitness": sa.Double,
}  # fmt: skip
PACKED_LINES = {"digest": LARGE, "migrants": sa.LargeBinary}


def upgrade() -> None:
    """Pack the rows of each run, and make room for a place in an object."""
    # First the table that writers lock first: the other way round they and this would deadlock.
    for place in PLACES:
        op.add_column("runs", sa.Column(place, LARGE, nullable=True))
    for name, was, now, keys, convert in (
        ("run_history", POINTS, PARTS, ("digest",), _pack_points),
        ("migrations_log", LINES, PACKED_LINES, ("digest",), _pack_lines),
    ):
        _rebuild(name, was, now, keys, convert)


def downgrade() -> None:
    """Unpack the rows; signals that are a part of an object cannot be told by the older tables."""
    op.execute("UPDATE runs SET signals_sha256 = NULL WHERE signals_start IS NOT NULL")
    for place in PLACES:
        op.drop_column("runs", place)
    for name, was, now, keys, convert in (
        ("run_history", PARTS, POINTS, ("island", "number"), _unpack_points),
        ("migrations_log", PACKED_LINES, LINES, ("number",), _unpack_lines),
    ):
        _rebuild(name, was, now, keys, convert)


def _rebuild(name: str, was: Any, now: Any, keys: tuple[str, ...], convert: Any) -> None:
    """Make a table anew from its old rows, the runs in batches."""
    old_name = f"{name}_before"
    op.rename_table(name, old_name)
    if op.get_bind().dialect.name == "postgresql":  # names of keys are those of indexes there
        op.execute(f"ALTER INDEX pk_{name} RENAME TO pk_{old_name}")
    op.create_table(
        name, sa.Column("run_id", sa.String, nullable=False),
        *(sa.Column(column, kind, nullable=False) for column, kind in now.items()),
        sa.PrimaryKeyConstraint("run_id", *keys, name=f"pk_{name}"),
        sa.ForeignKeyConstraint(["run_id"], ["runs.id"], name=f"fk_{name}_run_id"),
    )  # fmt: skip
    old, new = _table(old_name, was), _table(name, now)
    for rows in _of_runs(old):
        made = (one for run, mine in groupby(rows, lambda row: row.run_id)
                for one in convert(run, list(mine)))  # fmt: skip
        while some := list(islice(made, ROWS_AT_A_TIME)):
            op.get_bind().execute(sa.insert(new), some)
    op.drop_table(old_name)


def _table(name: str, columns: Any) -> sa.TableClause:
    return sa.table(
        name, sa.column("run_id", sa.String), *(sa.column(*one) for one in columns.items())
    )


def _of_runs(table: sa.TableClause) -> Iterator[Iterable[Any]]:
    """Rows of some runs after the other; they stay with the database until they are asked for."""
    connection, last = op.get_bind(), ""
    order = [column for column in table.c if column.name in ("run_id", "island", "number")]
    while True:
        runs = sa.select(table.c.run_id).distinct().where(table.c.run_id > last)
        names = connection.scalars(runs.order_by(table.c.run_id).limit(RUNS_AT_A_TIME)).all()
        if not names:
            return
        last = names[-1]
        among = table.c.run_id.between(names[0], last)
        rows = sa.select(*table.c).where(among).order_by(*order)
        yield connection.execute(rows, execution_options={"yield_per": ROWS_AT_A_TIME})


def _digest(data: bytes) -> int:
    return int.from_bytes(blake2b(data, digest_size=8).digest(), "big", signed=True)


def _pack_points(run: str, rows: Sequence[Any]) -> Iterator[dict[str, Any]]:
    count = len(rows[0].parameters)
    point = struct.Struct(f"<IIIQdB{count}d")
    data = b"".join(
        point.pack(one.island, one.number, one.generation, one.evaluations, one.rms,
                   PHASES.index(one.phase), *one.parameters)
        for one in rows
    )  # fmt: skip
    yield {
        "run_id": run, "digest": _digest(data), "n_parameters": count,
        "generation": max(one.generation for one in rows),
        "evaluations": max(one.evaluations for one in rows),
        "rms": min(one.rms for one in rows), "points": data,
    }  # fmt: skip


def _pack_lines(run: str, rows: Sequence[Any]) -> Iterator[dict[str, Any]]:
    data = b"".join(MIGRANT.pack(*one[1:]) for one in rows)
    yield {"run_id": run, "digest": _digest(data), "migrants": data}


def _unpack_points(run: str, rows: Sequence[Any]) -> Iterator[dict[str, Any]]:
    found: dict[tuple[int, int], Any] = {}
    for row in rows:
        for one in struct.Struct(f"<IIIQdB{row.n_parameters}d").iter_unpack(row.points):
            found[one[:2]] = one
    for island, number, generation, evaluations, rms, phase, *parameters in found.values():
        yield {
            "run_id": run, "island": island, "number": number, "generation": generation,
            "evaluations": evaluations, "rms": rms, "phase": PHASES[phase],
            "parameters": parameters,
        }  # fmt: skip


def _unpack_lines(run: str, rows: Sequence[Any]) -> Iterator[dict[str, Any]]:
    found = {one[0]: one for row in rows for one in MIGRANT.iter_unpack(row.migrants)}
    for one in found.values():
        yield {"run_id": run, **dict(zip(LINES, one, strict=True))}
