"""Configuration of the site: `make docs` builds the pages of this folder with Sphinx."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))

from ae_env import __version__  # noqa: E402

project = "ae-env"
author = copyright = "The ae-env developers"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"ae-env {release}"
html_copy_source = False
html_show_sphinx = False
default_role = "code"

myst_heading_anchors = 4
myst_enable_extensions = ["html_image"]
# Results show tables of lengths that no lexer knows.
suppress_warnings = ["misc.highlighting_failure"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "show-inheritance": False}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

#: Sections of the side bar, and their pages.
CONTENTS = {
    "Jobs": ["train", "judge", "plug-in-a-scorer", "viewer", "raw-files", "on-a-camera"],
    "Tutorials": [
        f"tutorials/{name}"
        for name in ("explore_a_raw", "train_an_agent", "judge_a_meter", "plug_in_a_scorer")
    ],
    "The environment": [
        *("tasks", "environment", "scenes", "scorers", "policies", "agents"),
        *("evaluation", "ae-bench", "clients", "offline"),
    ],
    "The simulator": [
        *("simulator", "networks", "dataset", "colour", "performance", "stability"),
    ],
    "More": ["gallery", "results/README", "api/simulator", "api/ae_env", "api/agents"],
}


class DocstringPage(SphinxDirective):
    """``docstring``: the Markdown of a class's docstring, which is a page of its own."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The parsed docstring."""
        module, _, name = self.arguments[0].partition(":")
        text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class ScriptParser(MystParser):
    """A script of cells (``# %%``) as a page: text cells as Markdown, the others as code."""

    supported = ("script",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Parses the page that the script is."""
        super().parse(script_to_markdown(inputstring), document)


def script_to_markdown(script: str) -> str:
    """The page that a script of cells is."""
    parts = []
    for cell in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            parts.append(re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE))
        else:
            parts.append(f"```python\n{body.strip()}\n```")
    return "\n\n".join(parts) + "\n"


def on_source_read(app: Sphinx, name: str, source: list[str]) -> None:
    """Adds the side bar to the index, and makes plain text of links to folders of the code."""
    text = source[0]
    if name == "index":
        for caption, pages in CONTENTS.items():
            listed = "\n".join(pages)
            text += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{listed}\n```\n"
    elif name == "results/README":
        listed = sorted(
            path.relative_to(HERE / "results").with_suffix("").as_posix()
            for path in (HERE / "results").rglob("*.md")
            if path.name != "README.md"
        )
        text += "\n```{toctree}\n:hidden:\n\n" + "\n".join(listed) + "\n```\n"
    source[0] = re.sub(r"\[([^\]\n]+)\]\(([^)\s]+)\)", lambda m: _link(app, name, m), text)


def _link(app: Sphinx, name: str, found: re.Match[str]) -> str:
    text, target = found.groups()
    if "://" in target or target.startswith("#"):
        return found[0]
    path = (HERE / Path(name).parent / target.partition("#")[0]).resolve()
    page_of_site = path.suffix == ".md" and path.is_relative_to(HERE)
    return found[0] if page_of_site or (path.is_file() and path.suffix != ".md") else text


def setup(app: Sphinx) -> None:
    """Adds what this site needs beyond its extensions."""
    app.add_directive("docstring", DocstringPage)
    app.add_source_suffix(".py", "script")
    app.add_source_parser(ScriptParser)
    app.connect("source-read", on_source_read)
