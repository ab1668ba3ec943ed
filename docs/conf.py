"""The documentation site: `make docs` builds it into build/site.

The pages are docs/*.md. `site_pages.py` adds the pages of the repository's root and those that are
read from the code. rosdoc2 copies this folder and executes a copy of this file.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path.cwd()  # Sphinx reads this file in its folder
sys.path.insert(0, str(HERE))

import site_pages
from docutils import nodes
from sphinx.application import Sphinx

ROOT = site_pages.find_repository(HERE)
sys.path.insert(0, str(ROOT))
# The kernels that run the notebooks need the package, too.
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
os.environ["PARALLEL_CAL_REPOSITORY"] = str(ROOT)

import parallel_cal

project = "parallel_cal"
author = "the parallel_cal maintainers"
copyright = "the parallel_cal maintainers. Licence: Apache-2.0"
version = release = parallel_cal.__version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
]
root_doc = "index"
templates_path = ["_templates"]
exclude_patterns = ["_templates", "tables/*", "gallery/*", "mechanisms/*"]
NOTEBOOKS = ("delta_notebook",)

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

autosummary_generate = True
autodoc_typehints = "none"  # the sections of numpydoc state them
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
python_maximum_signature_line_length = 80

html_theme = "pydata_sphinx_theme"
html_title = "parallel_cal"
html_static_path = ["_static"]
html_sidebars = {page: [] for page in ("index", "start", "tables")}  # nothing is below them
html_css_files = ["site.css"]
html_js_files = ["copy.js"]
html_show_search_summary = False  # a page that is opened as a file cannot read others
highlight_language = "sh"  # of blocks that state none: commands
html_show_sourcelink = False
html_copy_source = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navbar_end": ["theme-switcher"],
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}

# What rosdoc2 would otherwise change. It runs without a network, and myst_nb reads Markdown.
rosdoc2_settings = {
    "override_theme": False,
    "support_markdown": False,
    "enable_breathe": False,
    "enable_exhale": False,
}


def mark_drawings_for_both_modes(app: Sphinx, doctree: nodes.document) -> None:
    """Tell the theme which drawings have colours for the dark mode, so it gives them no ground."""
    for image in doctree.findall(nodes.image):
        file = Path(app.srcdir) / image["uri"]
        # rosdoc2 repeats the README in a folder without its pictures.
        is_drawing = file.suffix == ".svg" and file.exists()
        if is_drawing and "prefers-color-scheme" in file.read_text(encoding="utf-8"):
            image["classes"].append("dark-light")


def add_plotly(app: Sphinx, page: str, *_: object) -> None:
    """Load plotly.js, from the site itself, on the pages with its figures."""
    if page in NOTEBOOKS:
        app.add_js_file("plotly.min.js", priority=100)


def copy_plotly(app: Sphinx) -> None:
    """Copy plotly.js from the installed package, so that the site needs no network."""
    from plotly.offline import get_plotlyjs

    file = Path(app.outdir) / "_static" / "plotly.min.js"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(get_plotlyjs(), encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Write the pages that are made at the build, and adapt links into the repository."""
    app.connect("doctree-read", mark_drawings_for_both_modes)
    app.connect("builder-inited", copy_plotly)
    app.connect("html-page-context", add_plotly)
    # Before Sphinx lists the pages of the folder: autosummary reads only those.
    app.connect(
        "config-inited",
        lambda app, _config: site_pages.write_pages(Path(app.srcdir), ROOT),
    )
    app.connect(
        "source-read",
        lambda app, page, source: source.__setitem__(
            0, site_pages.adapt_links(source[0], page, ROOT)
        ),
    )
