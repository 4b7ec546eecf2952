"""The documentation site: ``make docs`` builds it into build/site, with warnings as errors and links checked.

Nothing is loaded from elsewhere when a page is read: no web fonts, equations as MathML, figures as SVG.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools" / "docs")]

import warprrf  # noqa: E402

project = "warprrf"
author = "The warprrf contributors"
copyright = f"{author}, Apache-2.0"
version = release = warprrf.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "site_parts"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
html_math_renderer = "mathml"

html_theme = "furo"
html_title = f"warprrf {version}"
html_static_path = ["static"]
html_css_files = ["extra.css"]
html_show_sphinx = False
html_copy_source = False
exclude_patterns = ["build"]

autodoc_typehints = "none"  # docstrings say shapes and units, which types cannot
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_maximum_signature_line_length = 88
default_role = "code"

# reStructuredText takes the underscore of numpy.str_ in an annotation for a link.
rst_epilog = ".. _numpy.str: https://numpy.org/doc/stable/reference/arrays.scalars.html"
