"""The documentation site: ``make docs`` builds it in build/docs."""

import sys
from pathlib import Path

from docutils.nodes import SkipNode, math, math_block
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from lagid import __version__  # noqa: E402 - of this checkout
from service.pages.documentation.guides import format_formula, list_notebooks  # noqa: E402
from tests.documents.reference import follow_top_level, write_reference  # noqa: E402

write_reference(ROOT / "docs" / "reference")

project = "lagid"
author = "The maintainers of lagid"
release = __version__
root_doc = "index"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["README.md", "site", "openapi.json"]
source_suffix = {".md": "markdown"}
suppress_warnings = ["toc.not_included"]
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
pygments_dark_style = "github-dark"  # Furo's own underlines names like links
html_title = f"lagid {__version__}"
html_show_sphinx = False
html_copy_source = False
myst_enable_extensions = ["colon_fence", "deflist"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
html_math_renderer = "mathml"
copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"
autodoc_typehints = "description"
autodoc_member_order = "groupwise"
napoleon_google_docstring = False
napoleon_use_rtype = False
linkcheck_anchors = False


def write_formula(writer: HTML5Translator, node: math | math_block) -> None:
    """Write a formula as a running server shows it; no script of another site is needed."""
    writer.body.append(format_formula(node.astext()))
    raise SkipNode


def setup(app: Sphinx) -> None:
    """Let links to pages of the top level lead to their copies, and pages to their notebooks."""
    notebooks = list_notebooks()

    def follow(_: Sphinx, page: str, source: list[str]) -> None:
        source[0] = follow_top_level(source[0], "/reference/")
        if f"{page}.ipynb" in notebooks:
            title, rest = source[0].split("\n", 1)
            path = f"/reference/notebooks/{page}.ipynb"
            link = f"{{download}}`This page as a Jupyter notebook <{path}>`"
            source[0] = f"{title}\n\n{link}\n{rest}"

    app.connect("source-read", follow)
    renderers = (write_formula, None)
    app.add_html_math_renderer("mathml", renderers, renderers)
