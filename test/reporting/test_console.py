"""What a terminal shows of a result, and what a pipe gets."""

import dataclasses
import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from datasets import measured

import parallel_cal as pc
from parallel_cal.cli.calibration import Given, write_program
from parallel_cal.identification.fit import summarise_parameters
from parallel_cal.model.model import new_model
from parallel_cal.reporting import console
from parallel_cal.reporting.blocks import Cell, Detail, PValue, Table, as_text, uncover
from parallel_cal.reporting.contents import describe_parameters
from parallel_cal.reporting.readable import COMMAND, FOUND, columns
from parallel_cal.reporting.results import describe_fit
from parallel_cal.reporting.summary import (
    Line,
    describe_effect,
    describe_missing,
    list_step,
    name_files,
    summarize,
)

ROOT = Path(__file__).parents[2]
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
TEXTS = (
    "encoder_eccentricity",
    "encoder_gain, joint_compliance, encoder_second_harmonic, device_field, device_axes",
)


class Screen(io.StringIO):
    """A stream that says whether it is a terminal."""

    def __init__(self, terminal):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal


@pytest.fixture
def screen(monkeypatch):
    """screen(terminal, columns) -> (stdout, stderr) of the commands."""

    def make(terminal, width=80):
        streams = Screen(terminal), Screen(terminal)
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.delenv("NO_COLOR", raising=False)
        for name, stream in zip(("stdout", "stderr"), streams, strict=True):
            monkeypatch.setattr(f"sys.{name}", stream)
        return streams

    return make


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_table_fits_the_terminal_and_no_word_of_it_is_broken(width):
    header = ("effect", "error at held-out poses, with it", "confused with")
    shown = columns(header, [(TEXTS[0], "37.6", TEXTS[1])], width)
    assert max(map(len, shown.splitlines())) <= width
    assert sorted(shown.split()) == sorted(" ".join([*header, TEXTS[0], "37.6", TEXTS[1]]).split())


def test_a_pipe_gets_one_line_for_each_row_and_headings_of_80_columns():
    header = ["", *(f"error at held-out poses, model {k}" for k in range(5))]
    *heads, row = columns(header, [("position", *"12345")]).splitlines()
    assert len(heads) > 1
    assert max(map(len, heads)) <= 80
    assert row.split() == ["position", *"12345"]
    assert columns(("effect", "confused with"), [TEXTS]).splitlines()[1].endswith("device_axes")


def test_a_broken_heading_stands_directly_above_its_numbers():
    shown = columns(("x", "held-out, after"), [("a" * 70, "37.6")])
    assert [line.rstrip() for line in shown.splitlines()] == [
        " " * 72 + "held-out,",
        "x" + " " * 71 + "    after",
        "a" * 70 + "       37.6",
    ]


def test_a_command_that_is_broken_stays_one_command_for_a_shell():
    command = "parallel-cal diagnose robot.yaml " + " ".join(f"bags/day{k}" for k in range(9))
    shown = columns(("", ""), [("next:", command)], 60, marks=[("", COMMAND)])
    first, *_ = lines = [line[len("next:  ") :] for line in shown.splitlines()]
    assert first.endswith(" \\")
    assert " ".join(line.strip().removesuffix(" \\") for line in lines) == command


def test_details_are_for_their_option_and_for_pages():
    blocks = ["result", Detail("all of it"), Detail("values", "parameters")]
    assert as_text(blocks) == "result"
    assert as_text(blocks, ["parameters"]) == "result\nvalues"
    assert list(uncover(blocks)) == ["result", "all of it", "values"]


def test_a_terminal_shows_no_exponent_of_a_p_value_and_a_page_does():
    assert [PValue(p).fixed() for p in (5.4e-19, 0.0312, None)] == ["< 0.001", "0.031", "-"]
    assert PValue(5.4e-19).on_page() == "5.4e-19"


def test_colours_are_for_terminals_only_and_change_no_letter(screen, monkeypatch):
    table = Table(("model", "error"), [(Cell("after", mark=FOUND), "37.6 um")])
    out, _ = screen(terminal=False)
    console.show([table])
    plain = out.getvalue()
    assert "\x1b" not in plain
    out, _ = screen(terminal=True)
    console.show([table])
    assert COLOUR.search(out.getvalue())
    assert COLOUR.sub("", out.getvalue()) == plain
    for name, value in (("NO_COLOR", "1"), ("TERM", "dumb")):
        out, _ = screen(terminal=True)
        monkeypatch.setenv(name, value)
        console.show([table])
        assert out.getvalue() == plain


def test_a_terminal_gets_three_warnings_of_one_line_and_the_count_of_the_rest(screen):
    warnings = [f"sample {k} " + "is far from all the others " * 5 for k in range(5)]
    _, err = screen(terminal=True)
    console.warn(warnings, brief=True)
    *lines, last = COLOUR.sub("", err.getvalue()).splitlines()
    assert [line[:17] for line in lines] == [f"warning: sample {k}" for k in range(3)]
    assert all(len(line) <= 80 and line.endswith(" ...") for line in lines)
    assert last == "2 more warnings; --details shows all"


def test_a_pipe_and_the_option_details_get_every_warning_in_full(screen):
    warnings = ["a warning " * 20 + str(k) for k in range(5)]
    _, err = screen(terminal=False)
    console.warn(warnings, brief=True)
    assert err.getvalue().splitlines() == [f"warning: {text}" for text in warnings]
    _, err = screen(terminal=True)
    console.warn(warnings)
    assert " ".join(COLOUR.sub("", err.getvalue()).split()) == " ".join(
        f"warning: {text}" for text in warnings
    )


@pytest.mark.parametrize("terminal", [True, False])
def test_an_error_is_one_line_which_a_terminal_gets_wrapped(screen, terminal):
    _, err = screen(terminal)
    console.error("a wrong value\n" * 20)
    shown = COLOUR.sub("", err.getvalue()).splitlines()
    assert (len(shown) > 1) == terminal
    assert " ".join(" ".join(shown).split()) == " ".join(["error:", *["a wrong value"] * 20])
    assert not terminal or max(map(len, shown)) <= 80


def test_the_bar_shows_the_time_left_of_work_that_takes_long(screen):
    _, err = screen(terminal=True)
    now = [100.0]
    bar = console.Bar(clock=lambda: now[0])
    bar("fit", 0.0)
    now[0] = 101.0
    bar("fit", 0.5)
    assert "left" not in err.getvalue()  # the work is short so far
    now[0] = 110.0
    bar("diagnosis", 0.25)  # other work: its time begins here
    now[0] = 120.0
    bar("diagnosis", 0.5)
    assert (
        err.getvalue().split("\x1b[2K")[-1] == "[##########----------]  50 %, 10 s left  diagnosis"
    )
    bar("", 1.0)
    assert err.getvalue().endswith("\r\x1b[2K")


def test_a_pipe_gets_no_bar(screen):
    _, err = screen(terminal=False)
    console.progress("fit", 0.5)
    console.progress("", 1.0)
    assert err.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "shown"), [(9.6, "10 s"), (99, "99 s"), (150, "2 min"), (5000, "1 h 23 min")]
)
def test_a_duration_has_the_units_of_a_clock(seconds, shown):
    assert console.format_duration(seconds) == shown


def test_a_proposed_command_finds_effects_of_ones_own(tmp_path, monkeypatch):
    """Those in a folder that PYTHONPATH names; an installed one is found anyway."""
    text = (Path(pc.__file__).parent / "effects" / "backlash.py").read_text()
    (tmp_path / "own_play.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    model = new_model("delta_nominal").with_effect("own_play")
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    assert write_program(model) == "parallel-cal"
    monkeypatch.setenv("PYTHONPATH", f"/elsewhere:{tmp_path}")
    assert write_program(model) == "PYTHONPATH=. parallel-cal"
    assert write_program(model.without_effect("own_play")) == "parallel-cal"
    assert write_program(model, [tmp_path / "a b"]) == "PYTHONPATH='a b:.' parallel-cal"
    given = Given(Path("a b.yaml"), [Path("bag")], ["exclude=3"], update=True)
    [shown] = given.fill(list_step("next:", "parallel-cal diagnose MODEL RECORDING"), model)
    command = "PYTHONPATH=. parallel-cal diagnose 'a b.yaml' bag --data=exclude=3 --update"
    assert shown == ("next:", command, COMMAND)


@pytest.mark.parametrize(("factor", "named"), [(1.0, False), (4.0, True)])
def test_a_noise_floor_above_the_error_is_named_as_that_of_the_stated_noise(factor, named):
    """`error: 27.7 um, noise: 74.3 um` stood there without a word: single messages had that noise,
    and the samples were the means of many."""
    model = pc.read_model(ROOT / "config" / "delta_mockup_identified.yaml")
    data = pc.load_dataset(ROOT / "bags" / "delta_clean", joints=model.joints)
    data = dataclasses.replace(data, pose_cov=data.pose_cov * factor**2)
    result = pc.fit(model, data)
    [head] = [one for one in describe_fit(result) if "chi2/dof" in str(one)]
    assert (", below 0." in str(head) and "too small a unit" in str(head)) == named
    lines = {line.label: line.text for line in summarize(result)}
    assert (" by the stated noise; that of the samples is smaller" in lines["noise:"]) == named
    assert lines["missing:"] == "nothing larger than the noise"


def test_the_joint_in_which_an_effect_is_largest_is_named_with_its_size():
    model = new_model("delta54", effects=("backlash", "encoder_eccentricity"))
    values = {"backlash.joint1.width": 3e-4, "backlash.joint2.width": -9e-4}
    sines = {"encoder_eccentricity.joint3.sin": 3e-4, "encoder_eccentricity.joint3.cos": 4e-4}
    known = model.table.mapping(model.values) | values | sines
    model = model.with_values(np.array([known[name] for name in model.table.names]))
    said = describe_effect(model, "backlash")
    assert said == "backlash (largest in joint2: 3.09 arcmin, others up to 1.03)"
    assert "(largest in joint3: 1.72 arcmin, others up to 0)" in describe_effect(
        model, "encoder_eccentricity"
    )
    gear = new_model("delta54").with_effect("gear_transmission_error", {"ratio": 80.0})
    said = describe_effect(gear, "gear_transmission_error", {"ratio": 0.25})
    assert said.endswith("; ratio 80.00 +- 0.25)")
    assert gear.settings_of("gear_transmission_error").sum() == 4  # for all, and 0 for each joint
    ratio = describe_parameters(
        gear, summarise_parameters(gear, np.full(len(gear.values), np.nan), gear.fixed)
    )["gear_transmission_error.ratio"]
    assert (ratio.nominal, ratio.moved_tolerances) == (80.0, 0.0)
    cable = new_model("delta54", effects=("thermal_expansion",))
    assert describe_effect(cable, "thermal_expansion") == "thermal_expansion"
    legs = new_model("stewart42").with_effect("universal_joint_offset")
    values = legs.values.copy()
    values[legs.table.index_of("universal_joint_offset.leg4.foot")] = 0.0105
    said = describe_effect(legs.with_values(values), "universal_joint_offset")
    assert said == "universal_joint_offset (largest in leg4: 10.5 mm, others up to 0)"


def test_noise_that_only_revisits_show_bounds_what_may_be_missing():
    """With 12 degrees of freedom, an error of twice the noise may be chance; `diagnose`, which
    looks for its pattern, may name its cause all the same."""
    data, model = measured(0, n_poses=40, n_replicates=20), new_model("delta54")
    unknown = np.full((len(data), 6, 6), np.nan)
    data = dataclasses.replace(data, pose_cov=unknown, joint_sigma=None)
    lines = {line.label: line.text for line in summarize(pc.fit(model, data))}
    assert lines["missing:"] == "nothing larger than the noise, as far as the revisits tell"


@pytest.mark.parametrize(
    ("each", "words"),
    [
        ({"backlash": 0.73, "hysteresis": 0.25}, "Backlash: 73 %, or hysteresis: 25 %."),
        ({"backlash": 0.56, "hysteresis": 0.48}, "Backlash: 56 %, or hysteresis: 48 %, or both."),
        (
            {"backlash": 0.56, "hysteresis": 0.48, "latency": 0.2},
            "Backlash: 56 %, or hysteresis: 48 %, or latency: 20 %, or several of these.",
        ),
    ],
)
def test_probabilities_of_rivals_that_exceed_one_are_said_to_overlap(each, words):
    cause = {"each": each, "settings": {}, "probability": max(each.values())}
    assert describe_missing(diagnosis_of(cause)) == words


def diagnosis_of(cause):
    """What a sentence needs of a diagnosis of a robot without effects."""
    robot, nothing = SimpleNamespace(effects=()), SimpleNamespace(chosen=())
    return SimpleNamespace(missing=[cause], model=robot, best=nothing)


def test_an_effect_that_imitates_another_cause_is_not_said_to_be_missing():
    cause = {"each": {"backlash": 0.004}, "settings": {}, "probability": 0.004}
    assert describe_missing(diagnosis_of(cause)) == (
        "No known effect is missing. Backlash: < 1 %; the error falls with it, but something else "
        "causes it."
    )


def test_a_placeholder_before_a_comma_is_replaced_too():
    """`keep MODEL, and put the measuring device back` kept the placeholder."""
    line = Line("next:", "keep MODEL, and put RECORDING back: parallel-cal fit MODEL")
    named = name_files(line, {"MODEL": "robot.yaml", "RECORDING": "day2.csv"})
    assert named.text == "keep robot.yaml, and put day2.csv back: parallel-cal fit robot.yaml"
