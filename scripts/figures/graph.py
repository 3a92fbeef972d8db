"""Draw the way of the data through the graph, as README.md has it in Mermaid, for pages without it.

python3 scripts/draw_figures.py graph
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from pathlib import Path

from benchmarks.browser import open_browser
from workspace_setup.basics import ROOT

DRAWING = ROOT / "docs" / "pictures" / "graph.svg"
LOOK = {"startOnLoad": False, "theme": "neutral", "htmlLabels": False}
PAGE = """<body><script type="module">
import {{ mermaid }} from "{module}";
mermaid.initialize({look});
window.drawn = (await mermaid.render("graph", {text})).svg;
</script></body>"""


def text() -> str:
    """Return the drawing's text."""
    found = re.search(r"```mermaid\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found is not None
    return found[1]


def mark() -> str:
    """Return the comment by which a drawing tells the text that it was drawn from."""
    return f"<!-- {hashlib.sha256(text().encode()).hexdigest()} -->"


def main() -> int:
    """Run the command line."""
    import nicegui  # noqa: PLC0415 - its wheel has Mermaid
    from selenium.webdriver.support.ui import WebDriverWait  # noqa: PLC0415

    dist = Path(nicegui.__file__).parent / "elements" / "mermaid" / "dist" / "index.js"
    with (
        tempfile.NamedTemporaryFile("w", suffix=".html") as page,
        open_browser("--allow-file-access-from-files") as window,
    ):
        words = {"look": json.dumps(LOOK), "text": json.dumps(text())}
        page.write(PAGE.format(module=dist.as_uri(), **words))
        page.flush()
        window.get(f"file://{page.name}")
        drawn = WebDriverWait(window, 30).until(
            lambda each: each.execute_script("return window.drawn")
        )
    shorter = re.sub(r"(\.\d)\d+", r"\1", drawn)
    shorter = shorter.replace('style="', 'style="background: white; ', 1)  # for dark pages
    DRAWING.write_text(f"{shorter}\n{mark()}\n")
    print(DRAWING)
    return 0
