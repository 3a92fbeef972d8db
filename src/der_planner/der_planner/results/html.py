"""Pieces of the pages of results: one file that opens from disk, in one style."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
       color: #1a1a1a; background: #fff; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.87rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd;
         white-space: nowrap; }
th { border-bottom: 1.5px solid #333; } td.name, th.name { text-align: left; }
img { max-width: 100%; height: auto; } figure { margin: 1rem 0; }
figcaption, .small { font-size: 0.85rem; color: #555; }
.problem { color: #a33a00; white-space: normal; text-align: left; }
"""


def document(title: str, sections: Sequence[str]) -> str:
    """Return a page of sections, which are HTML already; empty ones are left out."""
    body = "\n".join(section for section in sections if section)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def figure(caption: str, path: Path) -> str:
    """Return a PNG within the page."""
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def table(header: Sequence[str], lines: Sequence[Sequence[str]], names: int) -> str:
    """Return a table whose first columns hold names and whose cells are HTML already."""

    def cells(values: Sequence[str], tag: str) -> str:
        marks = [f'<{tag} class="name">' if i < names else f"<{tag}>" for i in range(len(values))]
        return "".join(f"{m}{value}</{tag}>" for m, value in zip(marks, values, strict=True))

    body = "".join(f"<tr>{cells(line, 'td')}</tr>" for line in lines)
    return (
        f'<div class="wide"><table><thead><tr>{cells(header, "th")}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
