import base64

import pytest
from markdown_it import MarkdownIt

from agents.report.evaluation import cell, code, code_block, escape, html_report, markdown_table

PICTURE = b"\x89PNG\r\n\x1a\n1234"
#: Names that mean something to Markdown or HTML.
HOSTILE = [
    "![x](secret.png)",
    "[x](http://example.org)",
    "<script>alert(1)</script>",
    "a | b",
    "**bold** _it_ ~~no~~",
    "`code` &lt; \\",
    "line\n\n# heading",
    "<http://example.org>",
]


def _rendered(text: str) -> str:
    return MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render(text)


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_shown_as_they_are(name):
    shown = " ".join(name.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert _rendered(f"a {escape(name)} b") == f"<p>a {shown} b</p>\n"
    table = _rendered(markdown_table(["name", "x"], [[escape(name), "1"]]))
    assert f"<td>{shown}</td>" in table
    assert table.count("<td") == 2
    assert _rendered(f"a {code(name)} b") == f"<p>a <code>{shown}</code> b</p>\n"


def test_plain_names_stay_readable():
    assert escape("my_file.py:MyPolicy?gain=1/2") == "my_file.py:MyPolicy?gain=1/2"
    assert escape("_private_") == "\\_private\\_"
    assert cell(None, ".2f") == "-"
    assert cell([0.5, 0.25], "+.1f") == "+0.5 to +0.2"
    assert cell("a|b", "") == "a\\|b"


def test_a_block_of_code_ends_where_it_should():
    page = _rendered(code_block(["ae-env --scenes '```'", "<b>\nmore"]))
    assert page == "<pre><code>ae-env --scenes '```'\n&lt;b&gt; more\n</code></pre>\n"


def test_a_page_has_the_reports_pictures_and_no_others(tmp_path):
    for name in ("plot.png", "secret.png"):
        (tmp_path / name).write_bytes(PICTURE)
    text = "![A & plot](plot.png) ![a secret](secret.png) ![gone](none.png)\n\n<script>x</script>"
    page = html_report(text, {"plot.png": tmp_path / "plot.png"}, "A & B")
    data = base64.b64encode(PICTURE).decode()
    assert f'<img src="data:image/png;base64,{data}" alt="A &amp; plot"> a secret gone' in page
    assert page.count(data) == 1
    assert "<title>A &amp; B</title>" in page
    assert "<script>" not in page
    assert "http" not in page  # it needs no other file
