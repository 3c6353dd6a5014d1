from __future__ import annotations

import base64

import pytest

from agents.report.html import html_report

TEXT = """# Title

![A plot](plot one.png)

![Another](plot.png)

| a | b |
| --- | ---: |
| `x` | 1 < 2 |

<script>alert(1)</script>
"""


def test_pictures_are_within_and_markup_of_others_is_not(tmp_path):
    picture = b"\x89PNG\r\n\x1a\n1234"
    (tmp_path / "plot.png").write_bytes(picture)
    page = html_report(TEXT, tmp_path, "A & B")
    assert f"data:image/png;base64,{base64.b64encode(picture).decode()}" in page
    assert 'src="plot.png"' not in page
    assert "<title>A &amp; B</title>" in page
    assert "<table>" in page
    assert "<code>x</code>" in page
    assert "1 &lt; 2" in page
    assert "<script>" not in page
    assert "http" not in page  # it needs no other file


def test_a_picture_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="plot"):
        html_report("![x](plot.png)", tmp_path, "t")
