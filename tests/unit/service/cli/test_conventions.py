"""What all commands have in common: help with examples, one meaning of an option, completion."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from service.cli import common, demo
from service.cli.common import Listing, fetch_listing
from service.cli.main import build_program
from sysid.identification import warmup
from tests.support.service.commands import check_refusal, run_lagid

PROGRAM: Any = typer.main.get_command(build_program())


def walk_commands(command: Any = PROGRAM, words: tuple[str, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield all commands without commands of their own, each with its words."""
    for name, below in getattr(command, "commands", {}).items():
        yield from walk_commands(below, (*words, name))
    if not hasattr(command, "commands"):
        yield (*words, command)


COMMANDS = {" ".join(words): command for *words, command in walk_commands()}
OPTIONS = [(name, option) for name, command in COMMANDS.items() for option in command.params]


def read_examples(command: Any) -> list[str]:
    lines = re.findall(r"^\[dim\]\$\[/\] (.*)$", command.epilog or "", re.MULTILINE)
    return [line.replace("\\[", "[") for line in lines]


def test_there_are_many_commands() -> None:
    assert len(COMMANDS) > 30
    assert {"identify", "dataset download", "runs simulate", "db check"} <= {*COMMANDS}


def test_the_examples_of_each_command_can_be_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert [name for name, command in COMMANDS.items() if not read_examples(command)] == []
    for command in COMMANDS.values():
        for line in read_examples(command):
            assert len(line) <= 76, line  # it is not folded in a terminal of 80 columns
            assert find_command(line) is command, line


def find_command(line: str) -> Any:
    """Parse an example as typed, with all options and types; nothing runs."""
    (part,) = [one for one in line.split(" | ") if one.startswith("lagid ")]
    program, *words = shlex.split(re.sub(r" [<>] \S+$", "", part))
    command, context = PROGRAM, PROGRAM.make_context(program, list(words))
    while hasattr(command, "commands") and (rest := [*context._protected_args, *context.args]):
        found, command, rest = command.resolve_command(context, rest)
        context = command.make_context(found, rest, parent=context)
    return command


def test_help_shows_the_groups_and_the_examples() -> None:
    text = run_lagid("--help").stdout
    places = [text.index(f"─ {name} ─") for name in ("Try it", "Data and models", "Jobs")]
    assert places == sorted(places)
    assert {"Results", "Server"} <= {*re.findall(r"╭─ (\w+) ─", text)}
    assert "$ lagid identify recording.csv --model fopdt" in text
    assert run_lagid("-h").stdout == text
    assert run_lagid("runs", "-h").stdout == run_lagid("runs", "--help").stdout


def test_the_terminal_alone_breaks_the_lines_of_a_help_text() -> None:
    texts = [PROGRAM.help, *(command.help for command in COMMANDS.values())]
    assert all(texts)
    assert any("\n\n" in text for text in texts)
    assert [text for text in texts if re.search(r"(?<!\n)\n(?!\n)", text)] == []


def test_json_is_a_switch_and_quiet_and_limit_mean_the_same_everywhere() -> None:
    kinds: dict[str, set[Any]] = {}
    for _, option in OPTIONS:
        for name in option.opts:
            if name in ("--json", "--quiet", "--limit", "--force", "--url", "--key"):
                kinds.setdefault(name, set()).add((option.is_flag, option.help, *option.opts))
    assert {name: len(kind) for name, kind in kinds.items() if name != "--url"} == {
        "--json": 1,
        "--quiet": 1,
        "--limit": 1,
        "--force": 1,
        "--key": 1,
    }
    assert {is_flag for is_flag, *_ in kinds["--json"]} == {True}


def test_what_asks_a_server_for_data_has_json() -> None:
    without = {
        name
        for name, command in COMMANDS.items()
        if not any("--json" in option.opts for option in command.params)
    }
    # They write a file, or run until they are stopped.
    assert without == {"demo", "serve", "dispatcher", "report", "dataset download"}


def test_what_writes_a_file_can_be_forced() -> None:
    writers = {name for name, option in OPTIONS if "--output" in option.opts}
    forced = {name for name, option in OPTIONS if "--force" in option.opts}
    assert forced == writers | {"backup", "restore"}  # their file is an argument
    assert writers == {"dataset download", "export", "identify", "reidentify", "report"}


@pytest.mark.parametrize("words", [["identify", "a.csv", "--model", "fopdt"], ["export", "run_1"]])
def test_no_file_is_overwritten_before_any_work(words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    path.write_text("mine")
    line = check_refusal(run_lagid(*words, "--output", path))
    assert line.endswith(
        "exists, and nothing was written. Add --force, or name another by --output"
    )
    assert path.read_text() == "mine"
    line = check_refusal(run_lagid(*words, "--output", tmp_path), 2)
    assert "this is a folder; name a file" in line
    line = check_refusal(run_lagid(*words, "--output", tmp_path / "no" / "a.json"), 2)
    assert "there is no folder" in line


def test_a_file_after_json_is_refused_with_the_option_that_writes_it() -> None:
    for words in ("a.csv --json b.json", "--json b.json a.csv"):
        line = check_refusal(run_lagid("identify", *words.split(), "--model", "fopdt"), 2)
        assert "--json takes no file, it prints on standard output" in line
        assert "To write one: --output b.json" in line
    line = check_refusal(run_lagid("jobs", "--json", "jobs.json"), 2)
    assert "To write one: --json > jobs.json" in line
    line = check_refusal(run_lagid("identify", "a.csv", "b.csv", "--model", "fopdt", "--json"), 1)
    assert "there is no file a.csv" in line


def test_a_missing_choice_is_told_with_the_choices() -> None:
    line = check_refusal(run_lagid("health"), 2)
    assert "Choose from: web, dispatcher, ray (lagid health --help)" in line


def test_the_version_is_printed_alone() -> None:
    printed = run_lagid("--version")
    assert re.fullmatch(r"lagid \d+\.\d+\.\d+\S*\n", printed.stdout)
    assert run_lagid("-V") == printed
    assert printed.code == 0


def test_a_shell_completes_commands_and_options() -> None:
    def complete(text: str) -> list[str]:
        count = str(len(text.split(" ")) - 1)
        asked = {"_LAGID_COMPLETE": "complete_bash", "COMP_WORDS": text, "COMP_CWORD": count}
        return run_lagid(**asked).stdout.split()

    assert complete("lagid ide") == ["identify"]
    assert complete("lagid dataset dow") == ["download"]
    assert complete("lagid submit --wa") == ["--wait"]
    assert complete("lagid identify a.csv --model tube") == ["tube", "tube-second-order"]
    assert complete("lagid reidentify --model fo") == ["foipdt", "fopdt"]
    assert complete("lagid models show duffing-d") == ["duffing-delay"]
    shown = run_lagid("--show-completion", "bash", _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert "_LAGID_COMPLETE=complete_bash" in shown.stdout


def test_quiet_hides_notes_for_one_command_only(capsys: pytest.CaptureFixture[str]) -> None:
    told = typer.Typer()

    @told.command()
    def tell(quiet: common.Quiet = False) -> None:
        common.err.print("progress")
        common.print_note("text")
        common.print_error("fault")

    tell_command = typer.main.get_command(told)
    tell_command.main(["--quiet"], standalone_mode=False)
    assert capsys.readouterr() == ("", "lagid: fault\n")
    tell_command.main([], standalone_mode=False)
    assert capsys.readouterr() == ("note: text\n", "progress\nlagid: fault\n")


@pytest.mark.parametrize(
    ("limit", "as_json", "shown", "rest"),
    [
        (None, False, 50, "… and 30 more; --limit 0 lists all"),
        (None, True, 80, None),
        (5, False, 5, "… and 75 more; --limit 0 lists all"),
        (5, True, 5, "… and 75 more; --limit 0 lists all"),
        (80, False, 80, None),
        (0, False, 80, None),
    ],
)
def test_a_list_has_as_many_entries_as_asked_and_tells_the_rest(
    limit: int | None, as_json: bool, shown: int, rest: str | None
) -> None:
    entries = [{"id": number} for number in range(80)]
    listing = fetch_listing(lambda most: entries[:most], limit, as_json)
    assert listing.entries == entries[:shown]
    assert listing.describe_rest() == rest


def test_not_all_entries_of_a_long_list_are_counted() -> None:
    asked: list[int | None] = []

    def fetch(most: int | None) -> list[dict[str, Any]]:
        asked.append(most)
        return [{}] * (most or 100_000)

    assert fetch_listing(fetch, 3, False).describe_rest() == (
        "… and 500 or more others; --limit 0 lists all"
    )
    assert asked == [503]
    assert Listing([]).describe_rest() is None


@pytest.mark.parametrize(
    ("words", "environment", "folder", "port", "again"),
    [
        ([], {}, "lagid-demo", None, "serve --data-dir lagid-demo, then open {}8000/"),
        (
            [],
            {"LAGID_DATA_DIR": "my data", "LAGID_PORT": "8701"},
            "my data",
            8701,
            "serve --data-dir 'my data' --port 8701, then open {}8701/",
        ),
        (["--port", "0"], {}, "lagid-demo", None, "serve --data-dir lagid-demo, then open {}8000/"),
        (
            ["--data-dir", "other", "--port", "8702"],
            {"LAGID_DATA_DIR": "mine", "LAGID_PORT": "8701"},
            "other",
            8702,
            "serve --data-dir other --port 8702, then open {}8702/",
        ),
    ],
)
def test_the_demo_obeys_its_settings_and_ends_with_what_opens_its_data(
    words: list[str],
    environment: dict[str, str],
    folder: str,
    port: int | None,
    again: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    def run_example(url: str, data_dir: Path, console: Any) -> Path:
        asked.append(url)
        return data_dir / "report.html"

    class Embedded:
        def __init__(self, data_dir: Path, **options: Any) -> None:
            asked.append((data_dir, options["port"]))

        def __enter__(self) -> str:
            return "http://of-the-demo"

        def __exit__(self, *_: object) -> None:
            """Nothing runs."""

    monkeypatch.setattr(demo, "run_embedded_service", Embedded)
    monkeypatch.setattr(demo, "run_example", run_example)
    monkeypatch.setattr(warmup, "compile_search", lambda: asked.append("compiled"))
    monkeypatch.delenv("LAGID_DATA_DIR", raising=False)
    monkeypatch.delenv("LAGID_PORT", raising=False)
    done = run_lagid("demo", *words, cwd=tmp_path, **environment)
    assert done.code == 0, done.stderr
    assert asked == ["compiled", (Path(folder), port), "http://of-the-demo"]
    last = done.stdout.strip().splitlines()[-1]
    assert last.startswith("Look at it again: ")
    assert last.endswith(again.format("http://127.0.0.1:"))


def test_a_port_of_the_demo_that_is_none_is_one_line(tmp_path: Path) -> None:
    assert "LAGID_PORT" in check_refusal(run_lagid("demo", cwd=tmp_path, LAGID_PORT="many"))
