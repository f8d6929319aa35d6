"""Sentences of documents and messages stay short: readers are engineers in a hurry."""

import re
from collections.abc import Iterator
from pathlib import Path

from tests.support.checkout import ROOT
from tests.support.source_facts import list_modules, read_facts

MAX_WORDS, MEAN_WORDS = 25, 16
MAX_WORDS_WITH_COLON = 30
PROGRAMS = (ROOT / "sysid/export/c.py", ROOT / "sysid/export/python.py")  # texts are code
DOCUMENTS = sorted(
    path
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if not {"notes", "reference"} & set(path.parts)  # the reference is made from other texts
)

PROGRAM_FOLDERS = ("benchmarks", "examples", "service", "sysid", "tests", "workers")
FOLDERS = (*PROGRAM_FOLDERS, ".ci", "docker", "docs", "lagid", "migrations")
MODULES = {path.name for path in list_modules(PROGRAM_FOLDERS)}
RECORDS = {ROOT / "CHANGELOG.md", *(ROOT / "docs/decisions").iterdir()}  # of their time


def split_sentences(markdown: str, ends: str = ".!?:") -> list[str]:
    """Sentences of prose: without code, tables and headings; an entry of a list is one."""
    prose = re.sub(r"```.*?```", "", markdown, flags=re.DOTALL)
    prose = re.sub(r"^\s*\|.*$|^#.*$", "", prose, flags=re.MULTILINE)
    parts = re.split(rf"(?<=[{ends}])\s+|\n\s*\n|^\s*(?:[-*]|\d+\.) ", prose, flags=re.MULTILINE)
    return [part for part in parts if len(part.split()) > 2]


def sentences_of_cells(markdown: str) -> list[str]:
    """Sentences of the cells of tables; a piece of code counts as a word."""
    prose = re.sub(r"```.*?```", "", markdown, flags=re.DOTALL)
    rows = re.findall(r"^\s*\|.*$", prose, re.MULTILINE)
    text = re.sub(r"`[^`]*`", "X", "\n".join(rows))
    return re.split(r"(?<=[.!?:;])\s+|\||\n", text)


def test_a_long_sentence_is_seen() -> None:
    long = " ".join(["word"] * 26) + "."
    assert [
        len(one.split()) for one in split_sentences(f"# Title\n\nShort one here. {long}\n")
    ] == [
        3,
        26,
    ]
    cells = sentences_of_cells(f"| `a b` | {long} |\n|---|---|\n| short; {long} | |\n")
    assert [len(one.split()) for one in cells if len(one.split()) > MAX_WORDS] == [26, 26]


def test_sentences_of_documents_are_short() -> None:
    assert [fault for path in DOCUMENTS for fault in list_long_sentences(path)] == []


def list_long_sentences(path: Path) -> Iterator[str]:
    """List sentences of a document that are too long, and the mean if that is."""
    text, name = path.read_text(), path.relative_to(ROOT)
    short = split_sentences(text)
    long = [one for one in (*sentences_of_cells(text), *short) if len(one.split()) > MAX_WORDS]
    whole = split_sentences(text, ends=".!?")
    long += [one for one in whole if len(one.split()) > MAX_WORDS_WITH_COLON]
    yield from (f"{name}: {one}" for one in long)
    if short and (mean := sum(len(one.split()) for one in short) / len(short)) > MEAN_WORDS:
        yield f"{name}: {mean:.1f} words a sentence"


def list_missing_paths(markdown: str) -> Iterator[str]:
    """List paths, files and modules of the repository that a text names and that do not exist."""
    prose = re.sub(r"```.*?```", "", markdown, flags=re.DOTALL)
    for word in " ".join(re.findall(r"`([^`\n]+)`", prose)).split():
        if re.fullmatch(rf"(?:{'|'.join(map(re.escape, FOLDERS))})/[\w./*-]*", word):
            exists = any(ROOT.glob(word))
        elif re.fullmatch(r"\w+\.py", word):  # "beside it"
            exists = word in MODULES
        elif module := re.fullmatch(
            rf"((?:{'|'.join(PROGRAM_FOLDERS)})(?:\.[a-z]\w*)+):?\w*", word
        ):
            path = ROOT / module[1].replace(".", "/")
            exists = path.is_dir() or path.with_suffix(".py").exists()
        else:
            continue
        if not exists:
            yield word


def test_a_path_that_does_not_exist_is_seen() -> None:
    right = (
        "`sysid/core/settings.py` `settings.py` `docs/*.md` `python -m benchmarks.fuzz` `a/b.py`"
    )
    wrong = "`sysid/settings.py` `no_such.py` `docs/*/none.md` `python -m benchmarks.none`"
    assert list(list_missing_paths(right)) == []
    assert list(list_missing_paths(wrong)) == [
        "sysid/settings.py",
        "no_such.py",
        "docs/*/none.md",
        "benchmarks.none",
    ]


def test_paths_that_documents_name_exist() -> None:
    missing = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in DOCUMENTS
        if path not in RECORDS
        for word in list_missing_paths(path.read_text(encoding="utf-8"))
    ]
    assert missing == []


def test_sentences_of_messages_are_short() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{line}: {sentence}"
        for path in list_modules(("lagid", "sysid", "workers", "service", "examples"))
        if path not in PROGRAMS
        for text, line in read_facts(path).messages
        for sentence in re.split(r"(?<=[.!?])\s+", text)
        if len(sentence.split()) > MAX_WORDS
    ]
    assert long == []


def list_comments(script: str) -> list[str]:
    """Comments of a JavaScript file. Neighbouring lines that begin with ``//`` are one text."""
    blocks = [text.replace("*", " ") for text in re.findall(r"/\*(.*?)\*/", script, re.DOTALL)]
    lines = re.findall(r"((?:^[ \t]*// .*\n)+)", script, re.MULTILINE)
    ends = re.findall(r"^[ \t]*[^\s/].*?[;,{})] // (.*)$", script, re.MULTILINE)
    return [*blocks, *(text.replace("//", " ") for text in lines), *ends]


def visible_texts(template: str) -> list[str]:
    """Texts that a template shows, hints included; a value that is filled in counts as a word."""
    source = re.sub(r"{{.*?}}", "X", re.sub(r"{#.*?#}", "", template, flags=re.DOTALL))
    hints = re.findall(r'(?:title|placeholder|aria-label|data-empty)="([^"]*)"', source)
    prose = re.sub(r"</?(?:a|abbr|b|code|em|i|small|span|sub|sup)\b[^>]*>", "", source)
    return [*hints, *re.split(r"<[^>]*>|{%.*?%}", prose)]


def test_a_long_sentence_of_a_page_is_seen() -> None:
    long = " ".join(["word"] * 26)
    script = f"const a = 1; // {long}\n  // one\n  // {long}\n/** {long}.\n * Short one here. */\n"
    assert sorted(len(text.split()) for text in list_comments(script)) == [26, 27, 29]
    page = f'<p>a <b>{long}</b></p>{{# {long} #}}<i title="{long} b">{{{{ x }}}}{{% if x %}} a'
    assert sorted(len(text.split()) for text in visible_texts(page) if text) == [1, 1, 27, 27]


def test_sentences_of_pages_are_short() -> None:
    pages = ROOT / "service" / "pages"
    texts = [
        *((path, text) for path in pages.rglob("*.js") for text in list_comments(path.read_text())),
        *(
            (path, text)
            for path in pages.rglob("*.html")
            for text in visible_texts(path.read_text())
        ),
    ]
    long = [
        f"{path.name}: {sentence}"
        for path, text in texts
        for sentence in re.split(r"(?<=[.!?:])\s+", text)
        if len(sentence.split()) > MAX_WORDS
    ]
    assert texts
    assert long == []
