"""The archive of minima: places, how often, and what is forgotten when it is full."""

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.identification.run import advance_run, begin_run
from sysid.search.archive import SAME_POINT, archive_end, make_archive, read_archive
from sysid.simulation.scaling import to_unit
from tests.support.library.search_problems import example


def test_ends_at_one_place_are_counted_and_the_lowest_is_kept() -> None:
    archive, place = make_archive(2), np.array([0.3, 0.7])
    archive_end(archive, place, 2.0)
    archive_end(archive, place + 0.5 * SAME_POINT, 1.0)
    archive_end(archive, place - 0.4 * SAME_POINT, 3.0)
    archive_end(archive, place + np.array([0.0, 2 * SAME_POINT]), 4.0)
    first, second = read_archive(archive)
    assert (first.count, second.count) == (3, 1)
    np.testing.assert_array_equal(first.point, place + 0.5 * SAME_POINT)


def test_a_full_archive_forgets_its_worst_minimum_for_a_better_one() -> None:
    archive = make_archive(1)
    size = archive.shape[0]
    for number in range(size):
        archive_end(archive, np.array([number / size]), float(size - number))
    archive_end(archive, np.array([0.99]), size + 1.0)  # worse than all
    assert 0.99 not in {one.point[0] for one in read_archive(archive)}
    archive_end(archive, np.array([0.99]), 0.5)
    places = {one.point[0] for one in read_archive(archive)}
    assert 0.99 in places
    assert 0.0 not in places
    assert len(places) == size
    assert {one.count for one in read_archive(archive)} == {1}


def test_a_search_archives_where_its_random_starts_end() -> None:
    problem, settings = example(), GeneticAlgorithm(generations=60)
    found = advance_run(problem, settings, begin_run(problem, settings, 1))
    counted = 0
    for island in found.islands:
        minima = read_archive(island.archive)
        counted += sum(minimum.count for minimum in minima)
        assert sum(minimum.count for minimum in minima) <= island.search["random_starts"]
        places = np.array([minimum.point for minimum in minima])
        assert np.all((places >= 0.0) & (places <= 1.0))
    assert counted >= found.islands[0].search["confirmed_starts"] > 0
    best = min(found.islands, key=lambda island: island.champion_rms)
    champion = to_unit(problem.evaluator, np.array(best.history[-1].parameters)[None])[0]
    distances = [
        np.max(np.abs(minimum.point - champion))
        for island in found.islands
        for minimum in read_archive(island.archive)
    ]
    assert min(distances) < 1e-2
