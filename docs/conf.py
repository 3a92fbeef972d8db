"""How Sphinx builds the site; `python3 scripts/docs.py` runs it."""

import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "scripts"))

project = "DER limb"
author = "the authors of DER limb"
copyright = "Apache-2.0"
release = version = re.search(
    r'(?m)^version = "(.+)"$', (HERE.parent / "pyproject.toml").read_text()
)[1]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["tutorials", "_build"]
html_theme = "furo"
html_title = f"DER limb {version}"
html_static_path = []
html_show_sourcelink = False
html_copy_source = False
# The search, the theme and everything else is local; no page asks the network for anything.
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
nitpicky = False
default_role = "code"
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

linkcheck_timeout = 20

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "generated/tutorials",
    "filename_pattern": r"/[0-9]_",
    "within_subsection_order": "FileNameSortKey",
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "download_all_examples": False,
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "plot_gallery": "True",
    "capture_repr": (),  # what is printed alone: not what the last line of a cell returns
}


def keep_bars(app, what, name, obj, options, lines):
    """Let |x| in a docstring be a magnitude, not a substitution."""
    lines[:] = [re.sub(r"(`[^`]*`)|\|", lambda m: m[1] or r"\|", line) for line in lines]


def stay_inside(app, name, source):
    """Turn links that lead out of docs/ in the repository: to pages here, or folders to their names."""
    pages = r"\]\((?:\.\./)+(CONTRIBUTING|CHANGELOG)\.md"
    text = re.sub(pages, lambda m: f"](/{m[1].lower()}.md", source[0])
    source[0] = re.sub(r"\[([^\]]*)\]\((?:\.\./)+(?:src|scripts|test)/[^).]*\)", r"\1", text)


def setup(app):
    """Connect what this site adds to Sphinx."""
    app.connect("autodoc-process-docstring", keep_bars)
    app.connect("source-read", stay_inside)
