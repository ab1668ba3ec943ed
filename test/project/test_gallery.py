"""The gallery shows every effect of the catalogue, as the diagnosis sees it today."""

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from parallel_cal.model.shelf import list_plugins, load_effect

DOCS = Path(__file__).parents[2] / "docs"
EFFECTS = list_plugins("effects")


@pytest.fixture(scope="module")
def gallery():
    spec = spec_from_file_location("docs_gallery", DOCS / "gallery.py")
    tool = module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def titles(svg):
    """`backlash: 92 %` -> 92, by name."""
    found = re.findall(r'class="name"[^>]*>(\w+): (\d+)%<', svg)
    return {name: int(share) for name, share in found}


def kept(name):
    return (DOCS / "gallery" / f"{name}.svg").read_text(encoding="utf-8")


def test_the_page_has_a_section_and_a_picture_for_every_effect(gallery):
    page = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert page == gallery.page()
    assert re.findall(r"^## (\w+)$", page, flags=re.M) == EFFECTS
    assert sorted(p.stem for p in (DOCS / "gallery").glob("*.svg")) == sorted(EFFECTS)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effects_own_pattern_stands_first_and_no_lookalike_takes_more(name):
    shares = titles(kept(name))
    assert next(iter(shares)) == name
    assert set(shares) <= {name, *load_effect(name).lookalikes}
    assert shares[name] > 30  # or it would not be seen
    # Two or three of a family may be one over this travel: a gear, an eccentric disc.
    assert max(shares.values()) <= shares[name] + 1


@pytest.mark.wide
@pytest.mark.parametrize("name", ["backlash", "base_drift"])
def test_a_picture_is_the_one_that_is_drawn_today(gallery, name):
    drawn = titles(gallery.picture(gallery.found(load_effect(name))))
    assert drawn == pytest.approx(titles(kept(name)), abs=2)
