"""The server shows the documentation: every page, its pictures, and links that lead somewhere."""

import re
from pathlib import PurePosixPath

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.pages.documentation import guides
from tests.support.checkout import ROOT
from tests.support.service.web_app import settings_of

FOLDERS = ("", "tutorials", "howto", "answers", "explanation", "decisions", "notes")
PAGES = sorted(
    path.relative_to(ROOT / "docs").as_posix()
    for folder in FOLDERS
    for path in (ROOT / "docs" / folder).glob("*.md")
    if path.name != "index.md"
)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    return TestClient(create_app(settings_of(tmp_path_factory.mktemp("guides"))))


def list_targets(page: str, html: str) -> set[str]:
    """Addresses inside the documentation to which a page leads, from its root."""
    targets = set()
    [article] = re.findall(r'<article class="card guide">(.*)</article>', html, re.S)
    for address in re.findall(r'(?:src|href)="([^"#:]+)', article):
        if address.startswith(("/", "http")):
            continue
        parts: list[str] = []
        for part in (PurePosixPath(page).parent / address).parts:
            parts = parts[:-1] if part == ".." else [*parts, part]
        targets.add("/".join(parts))
    return targets


def test_every_page_is_shown_and_its_links_lead_somewhere(client: TestClient) -> None:
    broken = []
    for page in PAGES:
        answer = client.get(f"/guides/{page}")
        assert answer.status_code == 200
        broken += [
            f"{page}: {target}"
            for target in sorted(list_targets(page, answer.text))
            if client.get(f"/guides/{target}").status_code != 200
        ]
    assert len(PAGES) > 60
    assert broken == []


def test_headings_have_anchors_as_on_a_forge(client: TestClient) -> None:
    page = client.get("/guides/model.md").text
    assert '<h2 id="lagged-states">Lagged states</h2>' in page


def test_a_page_with_code_is_a_notebook_too(client: TestClient) -> None:
    page = client.get("/guides/tutorials/first_time_lag.md").text
    assert '<a href="first_time_lag.ipynb" download>' in page
    notebook = client.get("/guides/tutorials/first_time_lag.ipynb")
    assert notebook.headers["Content-Type"] == "application/x-ipynb+json"
    assert notebook.json()["nbformat"] == 4
    assert ".ipynb" not in client.get("/guides/howto/choose_a_model.md").text
    assert client.get("/guides/howto/choose_a_model.ipynb").status_code == 404


def test_formulas_are_mathml_on_a_page_and_latex_in_its_notebook(client: TestClient) -> None:
    page = client.get("/guides/explanation/method.md").text
    assert page.count("<math ") == page.count("</math>") == 5
    assert "<msqrt>" in page
    assert "\\sqrt" not in re.sub(r'aria-label="[^"]*"', "", page)
    cells = client.get("/guides/explanation/method.ipynb").json()["cells"]
    assert cells[0]["source"].count("$$") == 10


@pytest.mark.parametrize("latex", [r"\text{<b>bold</b>}", "x > 0", r"\text{a&lt;b}", "a & b"])
def test_a_formula_with_characters_of_html_is_refused(latex: str) -> None:
    with pytest.raises(ValueError, match=r"write \\lt"):
        guides.format_formula(latex)


def test_a_folder_has_one_address_where_its_links_lead_to_its_pages(client: TestClient) -> None:
    asked = client.get("/guides/howto", follow_redirects=False)
    assert (asked.status_code, asked.headers["Location"]) == (307, "/guides/howto/")
    listed = client.get("/guides/howto/").text
    assert 'href="read_the_verdict.md"' in listed
    before = guides.read_guide.cache_info().currsize
    assert client.get("/guides/howto///", follow_redirects=False).status_code == 404
    assert guides.read_guide.cache_info().currsize == before  # nobody fills it


@pytest.mark.parametrize("path", ["/guides", "/guides/"])
def test_the_folder_of_all_pages_shows_their_contents(client: TestClient, path: str) -> None:
    shown = client.get(path)
    assert shown.status_code == 200
    assert shown.url.path == "/guides/"  # its links are relative
    assert shown.text == client.get("/guides/README.md").text


def test_a_link_that_leaves_the_documentation_is_text(client: TestClient) -> None:
    assert "](../SECURITY.md)" in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    page = client.get("/guides/").text
    assert "<li>What is defended, what is not, and how do I report a fault?</li>" in page
    assert 'href="#"' not in page


def test_pictures_come_with_their_type(client: TestClient) -> None:
    picture = client.get("/guides/tutorials/pictures/first_time_lag.png")
    assert picture.headers["Content-Type"] == "image/png"
    assert picture.content.startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "path",
    [
        *("nothing.md", "%2e%2e/README.md", "..%2fREADME.md", "%2fetc%2fpasswd", "site/conf.py"),
        *("howto//", "/howto/", "tutorials/pictures/"),
    ],
)
def test_only_the_documentation_is_shown(client: TestClient, path: str) -> None:
    assert client.get(f"/guides/{path}", follow_redirects=False).status_code == 404
