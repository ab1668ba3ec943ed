"""The page docs/real_machines.md: made from its kept results, and what they say of the targets."""

import json

import pytest

from bench.truth.real_machines import (
    HAND_WORK,
    MACHINES,
    MAX_EXCESS,
    PAGE,
    RESULTS,
    Machine,
    excess,
    make_page,
    own_target,
)

KEPT = json.loads(RESULTS.read_text())


def test_the_page_is_the_one_that_the_kept_results_make():
    assert PAGE.read_text() == make_page(KEPT)


def test_every_machine_has_its_results_and_the_work_of_its_user():
    assert set(KEPT) == set(HAND_WORK) == set(MACHINES)


@pytest.mark.parametrize("name", MACHINES)
def test_every_error_is_within_a_twentieth_of_the_independent_fit_or_better(name):
    assert max(excess(Machine(**KEPT[name])).values()) <= MAX_EXCESS == 0.05


@pytest.mark.parametrize("name", ["jugglebot", "ur5", "d300vs"])
def test_the_targets_of_single_machines_are_met(name):
    words, met = own_target(Machine(**KEPT[name]))
    assert met, words


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("jugglebot", {"with_effects": 1.16e-3}),
        ("jugglebot", {"effects": ["encoder_gain"]}),
        ("ur5", {"means": {"parallel_cal": 63e-6, "independent": 72e-6}}),
        ("d300vs", {"promised": 42e-6}),
    ],
)
def test_a_row_that_misses_its_target_says_so(name, change):
    page = make_page(KEPT | {name: KEPT[name] | change})
    [row] = [line for line in page.splitlines() if line.endswith(": **not met** |")]
    assert f"(#{name})" in row


def test_a_row_that_is_worse_than_the_independent_fit_says_so():
    worse = KEPT["wam"] | {"geometry": 1.06 * KEPT["wam"]["own"]["geometry"]}
    assert "| +6.0 % | - | **no** |" in make_page(KEPT | {"wam": worse})
    assert "**no**" not in make_page(KEPT)
