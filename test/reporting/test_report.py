"""The report: one page that says it all and needs nothing else, and the document behind it."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import virtual_setups as vs
from datasets import measured, orientations
from tied import dataset as tied

import parallel_cal as pc
from parallel_cal.cli import main as cli
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.file.modelfile import model_hash, write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.reporting import contents, figures, tables
from parallel_cal.reporting.arrows import Ramp, arrows, scale_of
from parallel_cal.reporting.figures import select_evenly
from parallel_cal.reporting.page import page
from parallel_cal.reporting.readable import (
    name_p_value,
    number,
    probability,
    vector,
    with_sigma,
    with_unit,
)
from parallel_cal.reporting.report import report
from parallel_cal.session.steps import fitted
from parallel_cal.virtual import robot as vr

SECTIONS = [
    "verdict",
    "numbers",
    "certificate",
    "history",
    "error-budget",
    "residuals-in-space",
    "residuals-against-quantities",
    "which-effect-is-missing",
    "what-to-measure-next",
    "parameters",
    "what-the-data-do-not-determine",
    "unexplained-structure",
    "provenance",
    "samples",
]
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:"
)
EVIL = '<script>alert("1")</script>'
FEW = ("backlash", "hysteresis", "zero_shift")  # a short catalogue: tests are to be quick


class Page(HTMLParser):
    """Elements, attributes and texts of a page, scripts apart."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.attributes, self.texts, self.scripts = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append(tag)
        self.attributes += attrs

    def handle_data(self, data):
        inside = self.elements and self.elements[-1] == "script"
        (self.scripts if inside else self.texts).append(data)

    def handle_endtag(self, tag):
        if tag == "script":
            self.elements.append("after a script")

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())

    @property
    def sections(self):
        return [value for name, value in self.attributes if name == "id" and value != "figures"]

    @property
    def figures(self):
        return json.loads(next(s for s in self.scripts if s.startswith("[")))


def section(text, name):
    return re.search(rf'<section id="{name}">.*?</section>', text, flags=re.DOTALL).group()


def shown(model, data, **options):
    """The document and the page, the effects a few."""
    made = report(model, data, **{"effects": FEW} | options)
    return made.document(), page(made)


@pytest.fixture(scope="module")
def data():
    """A robot with play, visited from both sides."""
    return measured(0, effects=[vr.Backlash((6e-4, 5e-4, 4e-4))])


@pytest.fixture(scope="module")
def calibrated(data):
    return fitted(new_model("delta54"), data).model


@pytest.fixture(scope="module")
def made(calibrated, data):
    return report(calibrated, data, effects=FEW, against=new_model("delta54"))


@pytest.fixture(scope="module")
def document(made):
    return made.document()


@pytest.fixture(scope="module")
def text(made):
    return page(made)


# --------------------------------------------------------------------------------- the page


def test_the_page_begins_with_the_verdict_and_has_every_section_in_order(document, text):
    there = Page(text)
    assert [s for s in there.sections if s != "two-models-side-by-side"] == SECTIONS
    assert there.sections[-3:] == ["two-models-side-by-side", "provenance", "samples"]
    summary = document["diagnosis"]["summary"].replace(" um", " µm")
    assert there.text.index("explained") < there.text.index(summary) < there.text.index("History")


def test_the_page_holds_all_it_needs_and_is_not_too_large(text):
    there = Page(text)
    assert len(text.encode()) < 6e6
    assert not {name for name, _ in there.attributes} & {"src", "href", "srcset", "data", "action"}
    assert not {"link", "img", "iframe", "object"} & set(there.elements)
    assert "@import" not in section_of_style(text)
    assert "url(" not in section_of_style(text)
    assert ("content", POLICY) in there.attributes
    assert "Plotly" in text


def section_of_style(text):
    return re.search(r"<style>(.*?)</style>", text, flags=re.DOTALL).group(1)


def test_every_figure_is_one_that_plotly_knows(text):
    import plotly.graph_objects as go

    figures = Page(text).figures
    places = re.findall(r'data-figure="(\d+)"', text)
    assert [int(p) for p in places] == list(range(len(figures)))
    for figure in figures:
        go.Figure(figure)  # raises for an unknown attribute or value


def test_the_headline_numbers_are_held_out_errors_with_their_units(document, text):
    said = section(text, "numbers")
    for key in ("before", "now", "found", "noise"):
        e, sigma = document["errors"][key], document["errors"]["sigmas"][key]
        for kind, factor, unit in (("position", 1e6, "µm"), ("orientation", 3437.747, "arcmin")):
            shown = with_sigma(e[f"{kind}_rms"], sigma[kind], factor)
            assert " ± " in shown
            assert f"<dd>{shown}<span>{unit}</span>" in said
    counts = document["errors"]
    assert f"{counts['samples']} samples of {counts['poses']} held-out poses" in said


def test_every_error_is_at_the_same_samples_though_the_model_was_fitted_to_more():
    robot, rng, n = vs.random_delta(4), np.random.default_rng(2), 60
    r = rng.uniform((-0.05, -0.05, 0.16), (0.05, 0.05, 0.24), (n, 3))
    q, R = robot.inverse(r)
    model = new_model("delta24")
    r += rng.normal(0, 1e-5, (n, 3))
    data = pc.Dataset.from_arrays(
        model.joints, q, r, R, pose_cov=np.diag([1e-10] * 6), joint_sigma=1e-5
    )
    first = fitted(model, data)
    fewer = data.excluding([0, 1, 2, 3], "in this test")
    found = pc.diagnose(first.model, fewer, effects=["backlash"])
    shown = contents.HeldOutErrors.of(found)
    assert (shown.samples, shown.poses, shown.before_name) == (56, 56, "nominal model")
    assert not shown.keeps_sensors
    assert shown.before.position_rms == pytest.approx(found.base.fitted.budgets[0].total)
    assert shown.before.position_rms != first.errors_to_beat.position_rms  # of all 60 samples


def test_the_history_falls_from_the_nominal_model_to_the_noise(document):
    rows, errors = document["history"], document["errors"]
    assert [row["name"] for row in rows] == ["before calibration", "fit", "with backlash"]
    falling = [row["error"]["position_rms"] for row in rows]
    assert falling == sorted(falling, reverse=True)
    assert falling[0] > 5 * falling[1] > 5 * falling[2]
    assert falling[2] < 1.3 * errors["noise"]["position_rms"]


def test_the_history_has_the_names_of_the_steps_and_dots_between_different_samples(document):
    error = Summary(**document["history"][0]["error"])
    row = {"name": "fit", "error": error, "samples": 85, "sha256": "ab", "excluded": []}
    rows = [row, row | {"name": "exclude 40", "samples": 84, "excluded": [40]}]
    found = figures.find_steps(rows, error, "position", "m")
    assert [step.name for step in found.steps] == ["fit", "exclude 40"]
    assert [step.is_comparable for step in found.steps] == [True, False]


def test_evidence_and_reasons_stand_beside_every_effect(document, text):
    said = section(text, "which-effect-is-missing")
    assert re.search(r'data-label="rank">1</td><td[^>]*>backlash', said)
    value, sigma = re.search(r"joint1.width ([\d.]+) ± ([\d.]+) mrad", said).groups()
    assert abs(float(value) - 0.6) < 3 * float(sigma) < 0.3  # planted: 0.6 mrad
    assert "Not tested" in said
    assert "cannot be tested: it needs at least two recordings" in said
    assert "Record session, to test zero_shift." in section(text, "what-to-measure-next")


def test_provenance_names_model_data_noise_and_options(calibrated, document, text):
    said = section(text, "provenance")
    assert model_hash(calibrated) in said
    assert "virtual robot" in said
    assert "hold_out 0.25" in said
    assert "False" not in said
    assert document["provenance"]["dataset"]["samples"] == len(document["samples"])


def test_what_comes_from_files_cannot_become_part_of_the_page(data):
    joints = (EVIL, "joint2", "joint3")
    names = {
        f"{k.split('.')[0]}.{EVIL}" if k.endswith(".joint1") else k: v
        for k, v in data.conditions.items()
    }
    source = EVIL.replace("/", "|")  # of a path, the page shows the name of the file
    evil = replace(
        data, joint_names=joints, conditions=names, source=source, warnings=(f"</script>{EVIL}",)
    )
    model = new_model("delta24")
    model.mechanism.joints = joints
    document, text = shown(model, evil, effects=["backlash"])
    there = Page(text)
    assert there.elements.count("script") == 3
    assert document["provenance"]["dataset"]["source"] == source
    assert f"delta24 on {source}" in there.text
    assert "alert" not in "".join(s for s in there.scripts if "Plotly" not in s and s[0] != "[")


# --------------------------------------------------------------------------------- the document


def test_the_document_is_json_as_it_stands_and_holds_the_diagnosis(made, document):
    assert json.loads(json.dumps(document, allow_nan=False))["diagnosis"]["verdict"] == "explained"
    assert document["diagnosis"] == made.diagnosis.document()


def test_residuals_are_measured_minus_predicted_and_shrink_with_the_effect(data, document):
    found = document["residuals"]
    now, better = (np.array(found[key]) for key in ("now", "found"))
    assert np.sum(better**2) < 0.7 * np.sum(now**2)
    predicted = np.array(found["place"]) + now
    order = [list(data.numbers).index(s) for s in found["sample"]]
    np.testing.assert_allclose(predicted, data.r[order], atol=1e-12)


def test_samples_come_worst_first_and_planted_outliers_are_marked(data):
    r = np.array(data.r)
    r[[5, 17, 30, 44, 60, 70, 80, 90]] += [[1.5e-3, 0.0, 0.0]]  # too many to exclude
    document, text = shown(new_model("delta54"), replace(data, r=r), effects=["zero_shift"])
    assert document["samples"][0]["odd"] == "outlier"
    assert "17 (outlier)" in section(text, "samples")
    sigmas = [row["now"]["sigmas"] for row in document["samples"]]
    assert sigmas == sorted(sigmas, reverse=True)


def test_a_planted_outlier_is_excluded_and_named(data):
    r = np.array(data.r)
    r[17] += [1.5e-3, 0.0, 0.0]
    document, text = shown(new_model("delta54"), replace(data, r=r), effects=["zero_shift"])
    assert 17 not in [row["sample"] for row in document["samples"]]
    assert re.search(r"17 \(\d+ sigmas of the noise", section(text, "samples"))


@pytest.mark.parametrize("recorded", [True, False])
def test_times_that_were_not_recorded_are_not_shown(recorded):
    robot, rng, n = vs.random_delta(4), np.random.default_rng(2), 40
    r = rng.uniform((-0.05, -0.05, 0.16), (0.05, 0.05, 0.24), (n, 3))
    q, R = robot.inverse(r)
    model = new_model("delta24")
    times = {"time": np.arange(n) * 7.0} if recorded else {}
    data = pc.Dataset.from_arrays(
        model.joints, q, r, R, pose_cov=np.diag([1e-10] * 6), joint_sigma=1e-5, conditions=times
    )
    found = pc.compare(model, data)
    assert ("time [s]" in pc.show(found)) == recorded
    samples = contents.compared_samples(found)
    units = dict.fromkeys(model.joints, "rad")
    columns = [one.name for one in tables.sample_table(samples, ["position"], units).headings()]
    assert ("time [s]" in columns) == recorded


@pytest.mark.parametrize("odd", ["", "outlier"])
def test_the_table_of_samples_states_the_unit_of_joints_and_has_no_empty_column(odd):
    one = contents.JudgedSample(
        sample=1,
        time=np.nan,
        joints=np.array([0.1, 0.2]),
        position=np.zeros(3),
        now={"position": 1e-5, "sigmas": 1.0},
        found=None,
        odd=odd,
    )
    table = tables.sample_table([one], ["position"], {"a": "rad", "b": "m"})
    columns = [heading.name for heading in table.headings()]
    assert columns[-2:] == ["joints [deg, mm]", "position [mm]"]
    assert ("odd" in columns) == bool(odd)
    assert len(table.rows[0]) == len(columns)


def test_two_models_stand_side_by_side_on_the_same_samples(document, text):
    this, other = document["against"]["sides"]
    assert this["errors"]["position_rms"] < 0.1 * other["errors"]["position_rms"]
    assert len(this["residual"]) == len(other["residual"]) == len(document["samples"])
    sizes = [abs(row["difference_tolerances"]) for row in document["against"]["parameters"]]
    assert sizes == sorted(sizes, reverse=True)
    said = section(text, "two-models-side-by-side")
    assert said.count("data-figure") == 2
    row = re.search(r"position error, rms</td>(.*?)</tr>", said).group(1)
    assert re.findall(r">([^<]*)</td>", row)[1:] == [
        number(other["errors"]["position_rms"], 1e6),
        number(other["noise"]["position_rms"], 1e6),
        "µm",
    ]


def test_models_side_by_side_have_one_scale_one_bar_and_one_space():
    from parallel_cal.reporting.spaces import sides

    rng = np.random.default_rng(4)
    places = rng.uniform(-0.1, 0.1, (30, 3))
    models = [(places, 1e-3 * rng.normal(size=(30, 3)), np.arange(30))]
    models += [(places[:20], 1e-4 * rng.normal(size=(20, 3)), np.arange(20))]
    figures, scale = sides(models, "position")
    one, other = (figure["layout"]["scene"] for figure in figures)
    assert one["annotations"] == other["annotations"]
    assert figures[0]["data"][-1] == figures[1]["data"][-1]
    for axis in ("xaxis", "yaxis", "zaxis"):
        assert one[axis]["range"] == other[axis]["range"]
    ends = np.concatenate([p + scale * f for p, f, _ in models]) * 1e3
    for axis, values in zip("xyz", ends.T, strict=True):
        low, high = one[f"{axis}axis"]["range"]
        assert low < values.min()
        assert values.max() < high


def test_a_parameter_that_one_model_lacks_has_no_difference(calibrated, data):
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.reporting.versus import Versus

    more = calibrated.with_effect("backlash")
    rows = Versus.of(compare(calibrated, data), compare(more, data)).parameters
    assert [row.name for row in rows] == [f"backlash.joint{k}.width" for k in (1, 2, 3)]
    assert rows[0].values == [None, 0.0]
    assert rows[0].difference_tolerances is None


# --------------------------------------------------------------------------------- a notebook


def test_a_result_has_the_text_that_the_command_line_prints(made, data, files, capsys):
    with pytest.raises(SystemExit):
        cli.main(["compare", str(files / "m.yaml"), str(files / "samples.json")])
    printed = capsys.readouterr().out
    *text, following = printed.splitlines()  # the next command names the files
    assert pc.show(pc.compare(made.diagnosis.model, data)).splitlines() == text
    assert following.startswith("next:     parallel-cal diagnose ")
    said = pc.show(made.diagnosis, details=True).splitlines()
    assert said[0] == f"explained: {made.diagnosis.verdict.summary}"
    assert any(line.startswith("zero_shift: cannot be tested") for line in said)
    parameters = pc.show(made.diagnosis.best.fitted, details=True).splitlines()
    assert sum("backlash.joint" in line and line.endswith("deg") for line in parameters) == 3
    with pytest.raises(
        pc.ParallelCalError, match=r"^result is Model\(.*; expected the result of fit"
    ):
        pc.show(made.diagnosis.model)


def test_a_result_has_the_figure_that_the_report_shows(made, data):
    falling = pc.figure(made.diagnosis).data[-1]
    rows = made.document()["history"]
    assert falling.y == pytest.approx([1e6 * row["error"]["position_rms"] for row in rows])
    arrows = pc.figure(pc.compare(made.diagnosis.model, data))
    assert {trace.type for trace in arrows.data} == {"scatter3d", "mesh3d"}
    bars = pc.figure(made.diagnosis.best.fitted).data[0]
    assert "backlash.joint1.width" in bars.y


# --------------------------------------------------------------------- data that lack something


def test_a_robot_without_any_missing_effect_has_a_page_too():
    document, text = shown(new_model("delta54"), measured(1))
    assert document["diagnosis"]["verdict"] == "at_noise"
    assert document["errors"]["found"] is None
    assert "at the noise floor" in section(text, "verdict")
    assert 'class="switch"' not in text
    assert "two-models" not in text


@pytest.mark.wide
def test_orientations_alone_are_shown_at_the_platform_axis():
    document, text = shown(new_model("argos9"), orientations())
    assert document["residuals"]["kind"] == "orientation"
    np.testing.assert_allclose(np.linalg.norm(document["residuals"]["place"], axis=1), 1.0)
    assert "<span>arcmin</span>" in section(text, "numbers")
    assert "<span>µm</span>" not in section(text, "numbers")
    assert "unit sphere" in section(text, "residuals-in-space")


def test_what_the_data_do_not_determine_is_reported_in_words_and_correlations_by_name(data):
    positions = replace(data, measured=np.tile([True] * 3 + [False] * 3, (len(data), 1)))
    document, text = shown(new_model("delta24"), positions, effects=["zero_shift"], free=["*.D_z"])
    said = section(text, "what-the-data-do-not-determine")
    row = document["correlated"][0]
    assert abs(row["value"]) > 0.98
    assert f"{' and '.join(row['parameters'])}: {row['value']:.4f}" in said


def test_ways_and_speeds_of_a_sliding_joint_are_in_metres():
    data, model = measured(0), new_model("delta24")
    model.mechanism.joint_unit = "m"  # as a linear Delta's
    n = len(data)
    more = {"travel.joint1": np.linspace(0, 1, n), "velocity.joint2": np.linspace(0, 1, n)}
    data = replace(data, conditions=data.conditions | more)
    units = shown(model, data, effects=["backlash"])[0]["residuals"]["units"]
    assert (units["joint1"], units["travel.joint1"], units["velocity.joint2"]) == ("m", "m", "m/s")
    assert (units["direction.joint1"], units["time"], units["z"]) == ("1", "s", "m")


def test_maps_of_the_model_uncertainty_say_for_which_conditions_they_hold(made, text):
    from parallel_cal.workbench.picture_views import list_pictures

    validity = "at neutral conditions (direction 0)"
    assert f"not from the residuals. They hold {validity}." in Page(text).text
    pictures = list_pictures(made.residuals, made.diagnosis.best.scene, None)
    assert next(one["words"] for one in pictures if one["name"] == "uncertainty").endswith(
        f" times, {validity}"
    )


def test_a_set_up_without_any_pose_says_that_there_is_nothing_in_space():
    plate = vs.Plate()
    sensor = load_sensor(
        "plane_spheres",
        height=plate.height,
        holes=plate.holes,
        bars=(plate.bar,) * len(plate.holes),
    )
    data = tied(plate, *plate.session(vs.random_delta(0), 25, 0))
    document, text = shown(new_model("delta24", sensors=[sensor]), data)
    assert document["residuals"]["kind"] is None
    assert "No pose was measured" in section(text, "residuals-in-space")
    assert "<em>reading</em>" in section(text, "numbers")
    assert "no smooth map" in section(text, "unexplained-structure")


def test_without_held_out_poses_errors_are_reported_as_unknown(data):
    _, text = shown(new_model("delta54"), data, effects=["zero_shift"], hold_out=0.0)
    assert "<dd>–<span>µm</span>" in section(text, "numbers")


# --------------------------------------------------------------------------------- by hand


def test_numbers_have_as_many_digits_as_tell_something():
    assert number(3.2184e-5, 1e6) == "32.2"
    assert number(0.00012345, 1.0) == "0.000123"
    assert number(1.5e-9) == "1.50e-09"
    assert number(0.0) == "0"
    assert number(None) == number(float("nan")) == "–"
    assert with_unit(1e-3, "rad") == "3.44 arcmin"
    assert with_unit(2.5e-5, "m") == "25.0 µm"
    assert probability(1e-300) == "< 1e-99"
    assert name_p_value(probability(1e-300)) == "p < 1e-99"
    assert name_p_value(probability(0.02)) == "p = 0.02"
    assert vector([0.1, None], "m") == "100.00 –"


def test_a_number_that_rounds_to_zero_has_no_sign():
    assert with_sigma(-6.4e-5, 0.012) == "0.000 ± 0.012"
    assert vector([-1e-7, 1e-7, -0.1], "m") == "0.00 0.00 -100.00"


def test_arrows_reach_from_the_place_to_the_magnified_error():
    places, field = (
        np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.1]]),
        np.array([[1e-4, 0, 0], [0, 0, 2e-4]]),
    )
    shafts, heads, _ = arrows(places, field, 100.0, ["a", "b"], 1e3)
    assert shafts["x"][:3] == [100.0, 110.0, None]
    assert shafts["z"][3:] == [100.0, 120.0, None]
    # Each head is a closed pyramid: four corners, the first at the arrow's end, four sides.
    assert (len(heads["x"]), len(heads["i"])) == (8, 8)
    assert (heads["x"][0], heads["z"][4]) == (110.0, 120.0)


def test_colours_show_sizes_on_one_ramp_and_the_scale_is_round():
    small, large = np.full((20, 3), 1e-5), np.full((20, 3), 4e-5)
    ramp = Ramp.over([small, large])
    assert (ramp.low, ramp.high) == pytest.approx((1e-5 * 3**0.5, 4e-5 * 3**0.5))
    assert ramp.colour(0.0) == ramp.colour(ramp.low) == "rgb(127,159,198)"
    assert ramp.colour(2 * ramp.low) == "rgb(230,159,0)"  # half way by the logarithm
    assert ramp.colour(1.0) == "rgb(193,39,45)"
    shafts = arrows(small, small, 1.0, [""] * 20, ramp=ramp)[0]
    assert set(shafts["line"]["color"]) == {ramp.colour(ramp.low)}
    bar = ramp.bar("position")["marker"]["colorbar"]
    assert bar["ticktext"] == ["20", "50"]
    assert bar["title"]["text"] == "error [µm]"
    corners = np.array([[0.0, 0, 0], [0.3, 0, 0]])
    # 16 % of 0.3 m is 48 mm, for 100 um 480 times: the next round number below is 200.
    assert scale_of(corners, [np.full((2, 3), 1e-4 / np.sqrt(3))]) == 200.0
    assert scale_of(corners, [np.zeros((2, 3))]) == 1.0


def test_long_recordings_are_thinned_out_evenly_from_end_to_end():
    kept = select_evenly(100_000, 500)
    assert (kept[0], kept[-1], len(kept)) == (0, 99_999, 500)
    assert np.ptp(np.diff(kept)) <= 1
    np.testing.assert_array_equal(select_evenly(7, 500), range(7))


# --------------------------------------------------------------------------------- command line


@pytest.fixture(scope="module")
def files(tmp_path_factory, calibrated, data):
    folder = tmp_path_factory.mktemp("report")
    write_model(calibrated, folder / "m.yaml")
    data.to_json(folder / "samples.json")
    return folder


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main(["report", *map(str, arguments), "--effect", "backlash"])
    return ended.value.code


def test_the_command_writes_the_page_and_says_where(files, capsys):
    assert run(files / "m.yaml", files / "samples.json", "-o", files / "r.html") == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == f"written: {files / 'r.html'}"
    assert said.out.startswith("explained: backlash")
    assert Page((files / "r.html").read_text()).sections == SECTIONS


def test_the_written_document_is_the_printed_one(files, capsys):
    target = files / "r.json"
    assert run(files / "m.yaml", files / "samples.json", "-o", target, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed.pop("output") == str(target)
    assert json.loads(target.read_text()) == printed


def test_wrong_targets_are_refused_before_anything_is_computed(files, capsys):
    inputs = (files / "no.yaml", files / "samples.json")
    assert run(*inputs, "-o", files / "nowhere/r.html") == 1
    assert "does not exist" in capsys.readouterr().err
    assert run(*inputs, "-o", files / "r.pdf") == 1
    assert "ends in .html (page) or .json (document)" in capsys.readouterr().err
    assert run(*inputs) == 2
