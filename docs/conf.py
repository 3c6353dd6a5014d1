"""Configuration of the site: `make docs` builds the pages of this folder with Sphinx."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx
from sphinx.util.inspect import stringify_signature

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))

from ae_env import __version__  # noqa: E402

project = "ae-env"
author = copyright = "The ae-env developers"
version = release = __version__

extensions = [
    *("myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"),
    "sphinx.ext.viewcode",
]
exclude_patterns = ["conf.py"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = f"ae-env {release}"
html_copy_source = False
html_show_sphinx = False
default_role = "code"

myst_heading_anchors = 4
myst_enable_extensions = ["html_image"]
# Parts of reports begin below the level of a title.
suppress_warnings = ["myst.header"]

# Pages of the API are made in `api/`, one per class, from the templates.
autosummary_generate = ["api.md"]
autosummary_ignore_module_all = False
autosummary_imported_members = True
autodoc_typehints = "both"
autodoc_typehints_description_target = "documented"
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True

#: Sections of the side bar, and their pages.
CONTENTS = {
    "Start": ["concepts", "faq", "limits"],
    "Jobs": ["train", "judge", "plug-in-a-scorer", "viewer", "raw-files", "on-a-camera"],
    "Tutorials": [
        f"tutorials/{name}"
        for name in ("explore_a_raw", "train_an_agent", "judge_a_meter", "plug_in_a_scorer")
    ],
    "The environment": [
        *("tasks", "environment", "scenes", "recorded-grids", "changing-light"),
        *("incident_light", "scorers", "task-rewards", "policies", "rpi-agc"),
        *("agents", "evaluation"),
        *("ae-bench", "clients", "offline", "scale"),
    ],
    "The simulator": [
        *("simulator", "cameras", "networks", "dataset", "colour", "performance", "stability"),
        *("refocus", "hdr", "augmentation", "latitude"),
    ],
    "More": [
        "architecture",
        "gallery",
        "results/README",
        *("ae-bench/v3", "ae-bench/v2", "ae-bench/v1"),
        "api",
    ],
}


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


def docstring(found: re.Match[str]) -> str:
    """The docstring of the class that a block ``{docstring} module:Class`` names."""
    text = inspect.getdoc(getattr(importlib.import_module(found[1]), found[2])) or ""
    return re.sub(r"^(#+ )", r"#\1", text, flags=re.MULTILINE)  # below the title of its task


def on_source_read(app: Sphinx, name: str, source: list[str]) -> None:
    """Puts in docstrings and the side bar, and makes plain text of links to the code."""
    text = re.sub(r"```\{docstring\} ([\w.]+):(\w+)\n```", docstring, source[0])
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
    page = path.suffix in (".md", ".py")  # pages of this site, or files of the repository
    return found[0] if path.is_relative_to(HERE) or (path.is_file() and not page) else text


#: Descriptions of attributes by name, before Napoleon takes what ends in a colon for a type.
DESCRIPTIONS: dict[str, list[str]] = {}


def on_docstring(app: Sphinx, what: str, name: str, found: object, *rest: Any) -> None:
    """Keeps the first line of an environment's docstring: all of it is the page of its task."""
    lines = rest[-1]
    if what == "class" and "## Description" in lines:
        lines[1:] = ["", "Spaces, reward and arguments: :doc:`the page of the tasks </tasks>`.", ""]
    elif what in ("attribute", "property"):
        DESCRIPTIONS[name] = lines[:]


def after_napoleon(app: Sphinx, what: str, name: str, found: object, *rest: Any) -> None:
    """Gives attributes their descriptions back."""
    if what in ("attribute", "property"):
        rest[-1][:] = DESCRIPTIONS[name]


def on_signature(app: Sphinx, what: str, name: str, found: Any, *rest: Any) -> Any:
    """Of a class whose fields are described one by one, with their types, leaves the names."""
    if what == "class" and (is_dataclass(found) or hasattr(found, "model_fields")):
        return stringify_signature(inspect.signature(found), show_annotation=False), None
    return None


def setup(app: Sphinx) -> None:
    """Registers scripts as pages, and what is done to every page."""
    app.add_source_suffix(".py", "script")
    app.add_source_parser(ScriptParser)
    app.connect("source-read", on_source_read)
    app.connect("autodoc-process-docstring", on_docstring, priority=400)
    app.connect("autodoc-process-docstring", after_napoleon, priority=600)
    app.connect("autodoc-process-signature", on_signature)
