"""The page of settings has every setting, as it is."""

from service.core.settings import Settings
from tests.documents.settings import PAGE, format_default, write_page


def test_the_page_of_settings_is_that_of_the_settings() -> None:
    assert PAGE.read_text() == write_page(), "`make docs` writes it anew"


def test_every_setting_is_described_in_sentences() -> None:
    texts = {name: field.description or "" for name, field in Settings.model_fields.items()}
    assert [name for name, text in texts.items() if not text.strip().endswith(".")] == []


def test_defaults_are_written_as_one_sets_them() -> None:
    defaults = {
        "a": None,
        "b": (),
        "c": True,
        "d": 2.0,
        "e": "text",
        "f": "",
        "max_bytes": 3 * 2**20,
    }
    written = [format_default(name, value) for name, value in defaults.items()]
    assert written == ["none", "none", "`true`", "2", "`text`", "none", "3145728 (3 MiB)"]
