"""A Markdown report as one HTML file that needs no other: pictures are within."""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path

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
_IMAGE = re.compile(r'<img src="([^":]+\.png)"')


def html_report(markdown: str, folder: Path, title: str) -> str:
    """The page of a report.

    Args:
        markdown: CommonMark with tables; raw HTML in it is shown as text.
        folder: Where the ``.png`` files are that it shows; they are put into the page.
        title: Of the page.

    Raises:
        FileNotFoundError: If a picture is not there.
    """
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)

    def inlined(match: re.Match[str]) -> str:
        content = base64.b64encode((folder / html.unescape(match[1])).read_bytes()).decode()
        return f'<img src="data:image/png;base64,{content}"'

    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{_IMAGE.sub(inlined, body)}</body>\n</html>\n"
    )
