"""Datasets, lineage, models and dispatchers, on SQLite and on PostgreSQL alike."""

import threading
from dataclasses import replace

import pytest

from service.queue.dispatchers import LEASE_SECONDS_KEY, DispatcherRepository
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.lineage_rows import LineageLink, LineageRepository
from service.repositories.model_rows import ModelRepository
from service.storage.storage_errors import RowNotFound
from tests.support.storage.job_rows import Clock, new_dataset


def add(database, parents=(), **values):
    with database.write_session() as session:
        return DatasetRepository(session).add(new_dataset(**values), parents=parents).dataset.id


def at_once(n, work):
    """Run `work` in several threads at once; what they gave."""
    found, start = [], threading.Barrier(n)

    def begin():
        start.wait()
        found.append(work())

    threads = [threading.Thread(target=begin) for _ in range(n)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == n
    return found


def test_a_dataset_is_kept_whole(database):
    new = new_dataset(details={"segments": [{"labels": {"x": 5}}]}, size_bytes=3 << 32)
    with database.write_session() as session:
        stored = DatasetRepository(session).add(new)
    with database.read_session() as session:
        kept = DatasetRepository(session).get(stored.dataset.id)
    assert stored.is_new
    assert all(getattr(kept, name) == getattr(new, name) for name in type(new).__slots__)
    assert kept.n_channels == 1


def test_the_same_source_gives_the_same_dataset_even_at_once(database):
    def store():
        with database.write_session() as session:
            return DatasetRepository(session).add(new_dataset())

    found = at_once(4, store)
    assert len({one.dataset.id for one in found}) == 1
    assert sum(one.is_new for one in found) == 1


def test_a_deleted_dataset_is_gone_and_its_source_may_come_again(database):
    first = add(database)
    with database.write_session() as session:
        DatasetRepository(session).delete(first)
    second = add(database)
    assert second != first
    with database.read_session() as session, pytest.raises(RowNotFound, match=first):
        DatasetRepository(session).get(first)
    with database.read_session() as session, pytest.raises(RowNotFound, match=second):
        DatasetRepository(session, "proj_other").get(second)


def test_datasets_come_in_the_order_asked_for_and_the_missing_one_is_named(database):
    a, b = add(database, source_key="a"), add(database, source_key="b")
    with database.read_session() as session:
        repository = DatasetRepository(session)
        assert [one.id for one in repository.get_all([b, a, b])] == [b, a, b]
        with pytest.raises(RowNotFound, match="ds_none"):
            repository.get_all([a, "ds_none"])


def test_pages_of_datasets_are_latest_first_without_gap_or_repeat(database):
    ids = [add(database, source_key=str(i)) for i in range(5)]
    with database.read_session() as session:
        first = DatasetRepository(session).list_page(limit=3)
        second = DatasetRepository(session).list_page(limit=3, cursor=first.next)
    assert [one.id for one in first.items + second.items] == ids[::-1]
    assert second.next is None


def test_lineage_leads_from_a_dataset_to_all_it_was_made_from_and_all_made_of_it(database):
    raw = add(database, source_key="raw")
    other = add(database, source_key="other")
    cut = add(database, [raw], source_key="cut")
    both = add(database, [cut, other], source_key="both")
    with database.write_session() as session:
        lineage = LineageRepository(session)
        lineage.add_links("job_1", [both], "estimation")
        lineage.add_links("job_1", [both], "estimation")  # once more is as once
        up, down = lineage.list_ancestors("job_1"), lineage.list_descendants(raw)
    assert set(up) == {
        LineageLink("job_1", both, "estimation"),
        LineageLink(both, cut, "derived"),
        LineageLink(both, other, "derived"),
        LineageLink(cut, raw, "derived"),
    }
    assert set(down) == {one for one in up if one.parent != other}
    with database.read_session() as session:
        assert LineageRepository(session, "proj_other").list_ancestors("job_1") == []


def test_a_circle_of_lineage_ends(database):
    with database.write_session() as session:
        lineage = LineageRepository(session)
        lineage.add_links("ds_a", ["ds_b"], "derived")
        lineage.add_links("ds_b", ["ds_a"], "derived")
        assert len(lineage.list_ancestors("ds_a")) == 2


def test_a_model_has_numbered_versions_and_its_name_means_the_latest(database):
    with database.write_session() as session:
        models = ModelRepository(session)
        one = models.add("pump", {"order": 1})
        two = models.add("pump", {"order": 2})
        same = models.add("pump", {"order": 2})
    assert (one.model.version, two.model.version) == (1, 2)
    assert (same.is_new, same.model.id) == (False, two.model.id)
    with database.read_session() as session:
        models = ModelRepository(session)
        assert models.get("pump").document == {"order": 2}
        assert models.get("pump@1").document == {"order": 1}
        assert models.get(one.model.id).version == 1


@pytest.mark.parametrize(
    "reference",
    ["", "none", "pump@", "pump@2", "pump@x", "pump@-1", "pump@1@1", "pump@" + "9" * 40],
)
def test_an_unknown_model_or_version_is_not_found(database, reference):
    with database.write_session() as session:
        ModelRepository(session).add("pump", {"order": 1})
        with pytest.raises(RowNotFound, match="no model"):
            ModelRepository(session).get(reference)


def test_a_deleted_version_keeps_its_number(database):
    with database.write_session() as session:
        models = ModelRepository(session)
        models.add("pump", {"order": 1})
        models.delete("pump")
        assert models.list_page().items == ()
        assert models.add("pump", {"order": 1}).model.version == 2


def test_the_last_version_of_each_model_is_listed_once_over_all_pages(database):
    with database.write_session() as session:
        models = ModelRepository(session)
        for order in range(3):
            for name in ("pump", "valve", "tank"):
                models.add(name, {"order": order})
        models.delete("tank")  # an earlier version is the last one now
        found, cursor = [], None
        while True:
            page = models.list_page(cursor=cursor, limit=1, only_latest=True)
            found += [(one.name, one.version) for one in page.items]
            cursor = page.next
            if cursor is None:
                break
    assert sorted(found) == [("pump", 3), ("tank", 2), ("valve", 3)]


def test_models_stored_at_once_get_different_versions(database):
    orders = iter(range(4))

    def store():
        with database.write_session() as session:
            return ModelRepository(session).add("pump", {"order": next(orders)}).model.version

    assert sorted(at_once(4, store)) == [1, 2, 3, 4]


def test_a_dispatcher_is_alive_while_it_beats(database):
    clock = Clock()
    with database.write_session() as session:
        dispatchers = DispatcherRepository(session, clock)
        dispatchers.add_dispatcher("d1", {LEASE_SECONDS_KEY: 30.0})
        clock.advance(20)
        dispatchers.add_dispatcher("d2", {LEASE_SECONDS_KEY: 30.0})
        assert [one.owner for one in dispatchers.list_alive()] == ["d1", "d2"]
        clock.advance(20)
        assert [one.owner for one in dispatchers.list_alive()] == ["d2"]
        dispatchers.record_heartbeat("d1")
        clock.advance(15)
        assert [one.owner for one in dispatchers.list_alive()] == ["d1"]
        dispatchers.remove_dispatcher("d1")
        dispatchers.add_dispatcher("d2", {LEASE_SECONDS_KEY: 30.0, "cpus": 8})
        (left,) = dispatchers.list_alive()
    with database.read_session() as session:
        assert DispatcherRepository(session, clock).list_alive()[0].details["cpus"] == 8
    assert left.owner == "d2"


def test_a_new_dataset_is_a_value():
    assert replace(new_dataset(), name="a") == new_dataset(name="a")
