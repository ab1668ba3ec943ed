"""One description of a result, and what a terminal, a report and the workbench make of it."""

import json

from parallel_cal.reporting.blocks import Cell, Column, Number, Table, as_rows, as_text
from parallel_cal.reporting.contents import DescribedParameter
from parallel_cal.reporting.markup import as_html, sentence
from parallel_cal.reporting.readable import write_micro
from parallel_cal.reporting.tables import parameter_table

TABLE = Table(
    ("part", "by itself", "unit", Column("position [um]", "place", on_terminal=False)),
    [
        (Cell("play", "30 um of <it>", mark="found"), Number(4.8344e-5, 1e6), "um", "-"),
        ("rest", Number(None, 1e6), "um", Number(1.23456e-5, 1e6, sigma=2e-7)),
    ],
)


def test_a_terminal_shows_ascii_fixed_decimals_and_no_columns_of_pages():
    assert as_text(["2 parts, 48 um", TABLE]).splitlines() == [
        "2 parts, 48 um",
        "part  by itself  unit",
        "play      48.34  um",
        "rest          -  um",
    ]


def test_a_page_shows_significant_digits_micro_sort_keys_and_small_lines():
    shown = as_html(["2 parts, 48 um", TABLE])
    assert shown.startswith("<p>2 parts, 48 µm</p>")
    assert '<th scope="col">position [µm]</th>' in shown
    assert '<td data-label="by itself" data-key="4.8344e-05">48.3</td>' in shown
    assert 'class="found">play<small style="display:block">30 µm of &lt;it&gt;</small>' in shown
    assert '<td data-label="by itself">–</td><td data-label="unit">µm</td>' in shown
    assert ">12.35</td>" in shown  # the decimals of 0.20 um


def test_the_workbench_gets_plain_data_that_it_can_sort():
    assert json.loads(json.dumps(as_rows(TABLE))) == {
        "columns": [
            ["part", "part"],
            ["by itself", "by itself"],
            ["unit", "unit"],
            ["place", "position [µm]"],
        ],
        "rows": [
            {
                "part": "play",
                "part details": "30 µm of <it>",
                "by itself": 48.3,
                "unit": "µm",
                "place": "–",
            },
            {"part": "rest", "by itself": None, "unit": "µm", "place": 12.35},
        ],
    }


def test_the_workbench_gets_the_zeros_that_a_number_loses():
    table = Table(("error [um]",), [(Number(3.9e-5, 1e6),), (Number(3.87e-5, 1e6),)])
    assert as_rows(table)["rows"] == [
        {"error [um]": 39.0, "error [um] digits": "39.0"},
        {"error [um]": 38.7},
    ]


def test_a_sort_key_replaces_the_text_of_its_cell_in_the_workbench():
    assert as_rows(Table(("sample",), [(Cell("7", key=7),)]))["rows"][0]["sample"] == 7


def test_a_terminal_shows_digits_of_a_number_that_its_decimals_would_hide():
    """A coefficient in m/N^2 was shown as 0.0000 +- 0.0000."""
    small = Number(-1.165e-7, decimals=4, sigma=4.3e-9)
    assert small.fixed() == "-0.0000001165"
    assert Number(4.3e-9, decimals=4, sigma=4.3e-9).fixed() == "0.0000000043"
    assert Number(0.09625681, 1e3, decimals=4, sigma=2.3e-5).fixed() == "96.2568"


def test_a_page_writes_micro_in_every_unit():
    assert write_micro("0.5 um, 21.6 urad +- 2 urad [um]") == "0.5 µm, 21.6 µrad ± 2 µrad [µm]"
    assert write_micro("a drum of 2 radii") == "a drum of 2 radii"


def test_a_column_that_is_not_printed_is_marked_in_every_row():
    shown = as_html([Table(["x", Column("turn", on_paper=False)], [["1", "2"], ["3", "4"]])])
    assert '<th scope="col" class="on-screen">turn</th>' in shown
    assert shown.count('<td data-label="turn" class="on-screen">') == 2
    assert shown.count("on-screen") == 3


def test_a_fixed_parameter_has_no_sigma():
    fixed = DescribedParameter(
        value=0.25,
        sigma=0.0,
        nominal=0.25,
        moved_tolerances=0.0,
        unit="m",
        fixed=True,
        shown_name="chain1.Lb",
        words="rod length",
        sigma_tolerances=0.0,
    )
    table = parameter_table({"chain1.Lb": fixed})
    [row] = as_rows(table)["rows"]
    assert (row["value"], row["sigma"]) == (250, None)
    assert as_text([table]).splitlines()[1].split() == [
        "chain1.Lb",
        "250.0000",
        "0.0000",
        "-",
        "mm",
    ]


def test_a_sentence_begins_with_a_capital_letter_unless_with_a_name_that_people_type():
    assert sentence("backlash helps: 3 um") == "Backlash helps: 3 µm."
    assert sentence("encoder_gain.leg1.gain is large.") == "encoder_gain.leg1.gain is large."
