"""The documentation site: its made pages are complete, it builds, and its links lead somewhere."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import parallel_cal as pc
from parallel_cal.cli.main import COMMANDS, OTHER_NAMES
from parallel_cal.model.file.schema import KNOWN

ROOT = Path(__file__).parents[2]


def site_pages():
    module = module_from_spec(
        spec := spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
    )
    spec.loader.exec_module(module)
    return module


def test_the_page_of_the_command_line_has_the_help_of_every_command():
    page = site_pages().command_line()
    for name in set(COMMANDS) - set(OTHER_NAMES):
        assert f"Usage: parallel-cal {name} " in page, name
    assert "Usage: parallel-cal session undo" in page
    assert not any(f"## {name}\n" in page for name in OTHER_NAMES)


def test_the_page_of_the_model_file_has_every_key_of_every_part():
    page = site_pages().model_file_schema()
    for part in KNOWN.values():
        for name, field in part.model_fields.items():
            assert f"| `{field.alias or name}` |" in page, name
    assert "| `kind` | `spool`, `screw`, `belt` | required |" in page
    assert "| `gear` | number above 0 | `1.0` |" in page


def test_the_page_of_python_names_lists_every_public_function_and_class():
    page = site_pages().python_names(ROOT).split()
    public = {name for name in pc.__all__ if name not in ("effects", "mechanisms", "sensors")}
    assert public - set(page) == set()


def test_links_of_the_repository_lead_to_the_pages_of_the_site():
    adapt = site_pages().adapt_links
    assert adapt("[c](../CONVENTIONS.md#units)", "export", ROOT) == "[c](made/conventions.md#units)"
    assert adapt("[e](docs/export.md)", "made/readme", ROOT) == "[e](../export.md)"
    assert adapt("![](docs/rooms.svg)", "made/contributing", ROOT) == "![](../rooms.svg)"
    assert adapt("[m](../msg_defs)", "ros", ROOT) == "[m](made/ros_interfaces.md)"
    assert adapt("[s](own_effect.py)", "made/examples", ROOT) == "[s](#own_effectpy)"
    assert adapt("[w](https://a.b/c.md)", "export", ROOT) == "[w](https://a.b/c.md)"


def test_the_page_of_the_readme_has_its_picture_as_one_that_sphinx_copies(tmp_path):
    pages = site_pages()
    pages.write_pages(tmp_path, ROOT)
    page = (tmp_path / "made" / "readme.md").read_text(encoding="utf-8")
    assert "<picture>" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "<picture>" not in page
    assert "](docs/first_screen.png)" in page
    shown = pages.adapt_links(page, "made/readme", ROOT)
    assert "](../first_screen.png)" in shown


class References(HTMLParser):
    """The ids of a page, its links, and what a browser loads for it."""

    def __init__(self, file):
        super().__init__()
        self.ids, self.links, self.loaded = set(), [], []
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.ids |= {found[key] for key in ("id", "name") if found.get(key)}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"])
        if tag in ("img", "script", "iframe") and found.get("src"):
            self.loaded.append(found["src"])
        if tag == "link" and found.get("rel") == "stylesheet":
            self.loaded.append(found["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site as `make docs` builds it, with warnings as errors."""
    for module in ("sphinx", "myst_nb", "numpydoc", "pydata_sphinx_theme"):
        if find_spec(module) is None:
            pytest.skip(f"{module} is not installed: pip install 'parallel_cal[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "sphinx",
            "-q",
            "-W",
            "--keep-going",
            "-d",
            folder / "trees",
            ROOT / "docs",
            folder / "html",
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


def html_pages(site):
    return [file for file in site.rglob("*.html") if "_static" not in file.parts]


@pytest.mark.wide
def test_every_link_of_the_site_leads_to_a_page_and_a_heading_that_exist(site):
    pages = {file: References(file) for file in html_pages(site)}
    broken = []
    for file, page in pages.items():
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or link == "#":
                continue
            target = file if not parts.path else (file.parent / unquote(parts.path)).resolve()
            if not target.exists():
                broken.append(f"{file.relative_to(site)}: {link}")
            elif parts.fragment and target in pages and target.suffix == ".html":
                ids = pages[target].ids
                if unquote(parts.fragment) not in ids:
                    broken.append(f"{file.relative_to(site)}: {link}")
    assert len(pages) > 90
    assert broken == []


@pytest.mark.wide
def test_the_site_loads_nothing_from_the_network(site):
    loaded = {link for file in html_pages(site) for link in References(file).loaded}
    assert [link for link in loaded if urlsplit(link).netloc] == []


@pytest.mark.wide
def test_the_notebook_shows_its_figures_and_a_lower_error(site):
    page = (site / "delta_notebook.html").read_text(encoding="utf-8")
    assert page.count("Plotly.newPlot") == 2
    assert "_static/plotly.min.js" in page
    errors = [float(number) for number in re.findall(r"held-out poses: ([\d.]+) um", page)]
    assert len(errors) == 2
    assert errors[1] < 0.6 * errors[0]
