"""Sentences of documents and messages stay short: readers are engineers in a hurry."""

import re
from pathlib import Path

import pytest

from tests.repository import ROOT
from tests.sources import list_modules, read_facts

MOST_WORDS, MEAN_WORDS = 25, 16
PROGRAMS = (ROOT / "sysid/export/c.py", ROOT / "sysid/export/python.py")  # texts are code
DOCUMENTS = sorted(
    path
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if "notes" not in path.parts
)


def sentences(markdown: str) -> list[str]:
    """Sentences of prose: without code, tables and headings; an entry of a list is one."""
    prose = re.sub(r"```.*?```", "", markdown, flags=re.DOTALL)
    prose = re.sub(r"^\s*\|.*$|^#.*$", "", prose, flags=re.MULTILINE)
    parts = re.split(r"(?<=[.!?:])\s+|\n\s*\n|^\s*(?:[-*]|\d+\.) ", prose, flags=re.MULTILINE)
    return [part for part in parts if len(part.split()) > 2]


def test_a_long_sentence_is_seen() -> None:
    long = " ".join(["word"] * 26) + "."
    assert [len(one.split()) for one in sentences(f"# Title\n\nShort one here. {long}\n")] == [
        3,
        26,
    ]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_sentences_of_documents_are_short(path: Path) -> None:
    lengths = {one: len(one.split()) for one in sentences(path.read_text())}
    assert {one: count for one, count in lengths.items() if count > MOST_WORDS} == {}
    if lengths:
        assert sum(lengths.values()) / len(lengths) <= MEAN_WORDS


def test_sentences_of_messages_are_short() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{line}: {sentence}"
        for path in list_modules(("sysid", "workers", "service"))
        if path not in PROGRAMS
        for text, line in read_facts(path).messages
        for sentence in re.split(r"(?<=[.!?])\s+", text)
        if len(sentence.split()) > MOST_WORDS
    ]
    assert long == []
