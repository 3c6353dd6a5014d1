"""The site: it builds without a warning, and its pages load nothing from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "--fail-on-warning", "--keep-going"]
    # But for `viewcode`: 40 pages of the packages' own text, of which nothing is tested here.
    command += ["-D", "extensions=myst_parser,sphinx.ext.autodoc,sphinx.ext.napoleon"]
    done = subprocess.run(
        [*command, "-d", str(folder / "doctrees"), str(ROOT / "docs"), str(folder / "html")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe|source)[^>]+src="([^"]+)"', text)
        loaded += re.findall(
            r'<link[^>]+rel="(?:stylesheet|preload|icon)"[^>]+href="([^"]+)"', text
        )
        assert loaded
        assert [address for address in loaded if "//" in address] == [], page.name
    for sheet in site.rglob("*.css"):
        imports = re.findall(r"(?:url\(|@import )['\"]?(https?:[^'\")]+)", sheet.read_text("utf-8"))
        assert imports == [], sheet.name


def test_tasks_are_the_docstrings_of_their_classes(site: Path) -> None:
    text = (site / "tasks.html").read_text(encoding="utf-8")
    for title in ("AutoExposure-v0", "AutoExposureVideo-v0", "ExposureBracket-v0"):
        assert f"<h2>{title}" in text
    assert text.count("<h3>Action Space") == 3
    assert "{docstring}" not in text


def test_tutorials_are_pages_of_text_and_code(site: Path) -> None:
    text = (site / "tutorials" / "explore_a_raw.html").read_text(encoding="utf-8")
    assert "<h1>Explore a raw" in text
    assert "# %%" not in text
    assert 'class="highlight-python' in text
