"""What workers do before their first task."""

from sysid.core.settings import GeneticAlgorithm
from sysid.identification.identify import identify
from sysid.identification.warmup import compile_search
from sysid.islands.evolve import _run_epochs
from sysid.models.catalogue.load import load_model
from tests.searching import noisy, record


def test_after_warming_up_another_model_compiles_nothing() -> None:
    compile_search()
    before = len(_run_epochs.signatures)  # type: ignore[attr-defined]
    identify(load_model("duffing-eq16"), record(noisy()), GeneticAlgorithm(generations=2))
    assert len(_run_epochs.signatures) == before == 1  # type: ignore[attr-defined]
