"""Markdown with names from outside in it, and the same as one HTML page with its pictures."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
       max-width: 78rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; } h2 { margin-top: 2.4rem; border-bottom: 1px solid #ddd; }
img { max-width: 100%; height: auto; }
table { border-collapse: collapse; font-size: .86rem; display: block; overflow-x: auto; }
th, td { padding: .22rem .6rem; border-bottom: 1px solid #e6e6e6; white-space: nowrap; }
thead th { border-bottom: 2px solid #999; } tbody tr:hover { background: #f5f7fa; }
code { background: #f3f3f3; padding: .08rem .25rem; border-radius: 3px; }
pre { background: #f3f3f3; padding: .8rem; overflow-x: auto; } pre code { padding: 0; }
"""
#: Characters that mean something to Markdown anywhere, and underscores that are not within a word.
_SPECIAL = re.compile(r"[\\`*\[\]<>|&!~$]|(?<![^\W_])_|_(?![^\W_])")


def escape(name: object) -> str:
    r"""A name from outside, as of a file or a policy, so that Markdown shows it as it is.

    >>> escape("centre_weighted:P"), escape("![x](a.png)")
    ('centre_weighted:P', '\\!\\[x\\](a.png)')
    """
    return _SPECIAL.sub(r"\\\g<0>", " ".join(str(name).split()))


def code(text: object) -> str:
    """Text from outside as code within a line; not for tables, whose cells a bar ends.

    >>> print(code("a | b"), code("`x`"))
    `a | b` `` `x` ``
    """
    line = " ".join(str(text).split())
    fence = "`" * (_longest_run(line) + 1)
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def code_block(lines: Sequence[str]) -> str:
    """Lines from outside as a block of code."""
    fence = "`" * max(3, max(map(_longest_run, lines), default=0) + 1)
    return "\n".join([fence, *(" ".join(line.splitlines()) for line in lines), fence])


def _longest_run(text: str) -> int:
    """Length of the longest run of backticks."""
    return max(map(len, re.findall("`+", text)), default=0)


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table; columns but the first are aligned to the right."""
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rule, *body))


def cell(value: Any, form: str) -> str:
    """A number, a pair, a name or nothing as the text of a cell."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return f"{value[0]:{form}} to {value[1]:{form}}"
    return escape(value) if isinstance(value, str) else f"{value:{form}}"


def html_report(markdown: str, pictures: Mapping[str, Path], title: str) -> str:
    """The page of a report.

    Args:
        markdown: CommonMark with tables; raw HTML in it is shown as text.
        pictures: The picture files that may be shown, by their names in `markdown`; they are put
            into the page. Of any other only the caption is shown.
        title: Of the page.
    """
    from markdown_it import MarkdownIt

    def image(_: Any, tokens: Any, index: int, *__: Any) -> str:
        token = tokens[index]
        file, caption = pictures.get(str(token.attrs["src"])), html.escape(token.content)
        if file is None:
            return caption
        content = base64.b64encode(file.read_bytes()).decode()
        kind = file.suffix.removeprefix(".")
        return f'<img src="data:image/{kind};base64,{content}" alt="{caption}">'

    page = MarkdownIt("commonmark", {"html": False}).enable("table")
    page.add_render_rule("image", image)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{page.render(markdown)}</body>\n</html>\n"
    )
