"""Build the site: docs/_build/html/index.html, which opens from disk and asks no network.

python3 scripts/docs.py              build it if anything that it is made of has changed
python3 scripts/docs.py --fresh      build it from nothing
python3 scripts/docs.py --external   look at the links that lead out of the site, too
python3 scripts/docs.py --graph      ask the running graph for nodes, topics, parameters first
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys

from documentation import graph, reference
from workspace_setup.basics import ROOT, file_digest

DOCS = ROOT / "docs"
BUILT = DOCS / "_build"
SITE = BUILT / "html" / "index.html"
STAMP = BUILT / "digest.txt"
"""What the site was last built of without a complaint."""


def digest() -> str:
    """Return a digest of all that the site is made of, the code of the tutorials included."""
    folders = {DOCS: "*", ROOT / "src": "*.py", ROOT / "scripts" / "documentation": "*.py"}
    found = [path for folder, kind in folders.items() for path in folder.rglob(kind)]
    made = (BUILT, reference.FOLDER)
    parts = [path for path in found if path.is_file() and not set(made) & set(path.parents)]
    others = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    others += sorted((ROOT / "src").glob("*/msg/*.msg")) + sorted((ROOT / "requirements").glob("*"))
    return file_digest(sorted(path for path in parts if "__pycache__" not in path.parts) + others)


def sphinx(builder: str) -> int:
    """Run Sphinx with every warning an error; returns its exit code."""
    command = [sys.executable, "-m", "sphinx", "-b", builder, "-W", "--keep-going", "-q"]
    command += ["-d", str(BUILT / "doctrees"), str(DOCS), str(BUILT / builder)]
    return subprocess.call(command, cwd=ROOT, env={**os.environ, "MPLBACKEND": "agg"})


def build(fresh: bool = False) -> int:
    """Build the site unless it stands as its parts are now; returns the exit code."""
    now = digest()
    if not fresh and STAMP.exists() and STAMP.read_text() == now:
        return 0
    STAMP.unlink(missing_ok=True)
    # Sphinx notices no change of the code that a page or a tutorial shows.
    for folder in (BUILT, reference.FOLDER):
        shutil.rmtree(folder, ignore_errors=True)
    reference.write()
    if code := sphinx("html"):
        return code
    STAMP.write_text(now)
    return 0


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fresh", action="store_true", help="build it from nothing")
    parser.add_argument("--external", action="store_true", help="look at links to other sites")
    parser.add_argument("--graph", action="store_true", help="write reference/graph.json anew")
    given = parser.parse_args()
    if given.graph:
        graph.FILE.write_text(graph.text(graph.FILE.read_text()))
    code = build(given.fresh)
    if code == 0 and given.external:
        code = sphinx("linkcheck")
    print(f"the site: file://{SITE}" if code == 0 else "the site was not built: see above")
    return code
