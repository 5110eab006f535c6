"""How the documentation is built: ``sphinx-build -W docs docs/_build``.

Pictures, the tutorial's output and the reference of the commands are made here, at every
build in which a source of theirs is newer; nothing is fetched from the network.
"""

from __future__ import annotations

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

import generate  # noqa: E402

from amibayes import __version__  # noqa: E402

project = "amibayes"
author = "The amibayes developers"
copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "_generated/**/*.txt"]
myst_enable_extensions = ["deflist", "attrs_inline"]
myst_heading_anchors = 3
default_role = "py:obj"

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
maximum_signature_line_length = 78

# Names such as `n_data` are members of several classes: the link goes to one of them.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = f"amibayes {release}"
html_static_path = ["static"]
html_css_files = ["amibayes.css"]
html_extra_path = ["_generated/report"]
html_copy_source = False
html_show_sphinx = False


def setup(app: object) -> None:
    """Make what the pages include before Sphinx looks for it."""
    generate.everything(DOCS / "_generated")
