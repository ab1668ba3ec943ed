"""The report as a certificate: fields, decision, and a PDF on A4."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import parallel_cal as pc
from parallel_cal.base.errors import ModelFileError
from parallel_cal.cli import main as cli
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.reporting.certificate import CertificateError, CertificateFields, decide
from parallel_cal.reporting.page import page
from parallel_cal.reporting.pdf import PdfError, find_browser
from parallel_cal.reporting.report import report
from parallel_cal.session.session import Session
from parallel_cal.session.steps import fitted

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"
FIELDS = """\
serial_number: D-0042
measured_on: 2026-11-23
operator: B. Jones
limit_um: 50
"""


@pytest.fixture
def stated(tmp_path):
    file = tmp_path / "fields.yaml"
    file.write_text(FIELDS)
    return file


def test_fields_come_from_a_file_and_options_replace_them(stated):
    found = CertificateFields.read(stated, ["operator=A. Smith = me", "limit_arcmin=0.5"])
    assert found.serial_number == "D-0042"
    assert found.measured_on == "2026-11-23"
    assert found.operator == "A. Smith = me"
    assert (found.limit_um, found.limit_arcmin) == (50.0, 0.5)
    assert found.place == ""


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("serial_numer=1", "no field 'serial_numer'; did you mean 'serial_number'?"),
        ("operator", "expected NAME=VALUE"),
        ("limit_um=-3", "limit_um: expected a positive number in um, got '-3'"),
        ("limit_um=wide", "limit_um: expected a positive number in um, got 'wide'"),
    ],
)
def test_a_wrong_field_is_refused_with_its_name_and_what_was_expected(option, words):
    with pytest.raises(CertificateError, match=re.escape(words)):
        CertificateFields.read(None, [option])


def test_a_file_that_is_no_list_of_fields_is_refused(tmp_path):
    file = tmp_path / "f.yaml"
    with pytest.raises(CertificateError, match="cannot be read: No such file"):
        CertificateFields.read(file)
    file.write_text("- 1")
    with pytest.raises(CertificateError, match="expected lines 'FIELD: VALUE'"):
        CertificateFields.read(file)
    file.write_text("a: [")
    with pytest.raises(ModelFileError, match="not YAML"):
        CertificateFields.read(file)


@pytest.mark.parametrize(
    ("limit", "result"), [(36, "pass"), (35, "not decided"), (29, "not decided"), (28, "fail")]
)
def test_the_decision_needs_the_error_and_its_expanded_uncertainty(limit, result):
    errors = Summary(position_rms=32e-6)
    [found] = decide(CertificateFields(limit_um=limit), errors, {"position": 1.8e-6})
    assert found.result == result
    assert found.description.endswith(f"limit {limit} um: {result}")
    assert "32.0 +- 3.6 um (U = 2 sigma, without the device)" in found.description


def test_nothing_is_decided_about_an_error_that_is_not_known():
    stated = CertificateFields(limit_um=50, limit_arcmin=1)
    position, orientation = decide(stated, Summary(position_rms=1e-6), {})
    assert (position.result, orientation.result) == ("not decided", "not decided")
    assert orientation.description == "orientation error not known, limit 1 arcmin: not decided"


@pytest.fixture(scope="module")
def made():
    return certify(identify=True)


def certify(identify):
    model = pc.read_model(MODEL)
    data = pc.load_dataset(BAG, joints=model.joints)
    if identify:
        model = fitted(model, data).model
    fields = CertificateFields(serial_number="<D-0042>", operator="A. Smith", limit_um=50)
    effects = ["backlash", "hysteresis"]  # they are alike: poses are planned that tell them apart
    return report(model, data, effects=effects, certificate=fields)


def part(text, name):
    return text.split(f'<section id="{name}">')[1].split("</section>")[0]


@pytest.mark.wide
def test_the_certificate_shows_what_was_stated_and_leaves_the_rest_blank(made):
    shown = part(page(made), "certificate")
    assert "<details open" in shown
    assert "<dd>&lt;D-0042&gt;</dd>" in shown
    assert '<dt>Place</dt><dd class="blank"></dd>' in shown
    assert '<dt>Approved by</dt><dd class="blank"></dd>' in shown
    assert made.provenance.model_sha256 in shown
    assert "94 samples of 74 held-out poses" in shown
    error, sigma = made.errors.now.position_rms, made.errors.sigmas["now"]["position"]
    words = f"Position error {1e6 * error:.1f} ± {2e6 * sigma:.1f} µm "
    words += "(U = 2 sigma, without the device), limit 50 µm"
    assert f"{words}: pass." in shown
    assert "The model was identified from these samples." in shown
    assert made.document()["conformity"][0]["result"] == "pass"


@pytest.mark.wide
def test_every_sheet_and_the_decision_name_the_robot(made):
    named = replace(made, certificate=replace(made.certificate, robot="Delta 4"))
    robot = "Delta 4, serial number &lt;D-0042&gt;"
    text = page(named)
    assert f"<title>{robot} on delta_backlash</title>" in text
    assert f"<h1>{robot} on delta_backlash</h1>" in text
    assert f"samples, delta54, model {made.provenance.model_sha256[:12]}</p>" in text
    decision = part(text, "certificate").split('<div class="decision">')[1]
    assert f"<p>{robot}, model {made.provenance.model_sha256[:12]}</p>" in decision
    codes = re.search(r'@bottom-left \{ content: "([^"]*)"', text).group(1)
    footer = "".join(chr(int(code, 16)) for code in codes.replace("\\", "").split())
    assert footer == "Delta 4, serial number <D-0042>"
    assert "<title>delta54 on " in page(replace(made, certificate=CertificateFields()))


@pytest.mark.wide
def test_without_a_limit_no_letter_is_explained_that_nothing_uses(made):
    shown = part(page(replace(made, conformity=())), "certificate")
    assert "U is the expanded" not in shown
    assert "(1 sigma)" in shown
    assert "State a limit (limit_um, limit_arcmin) to obtain a decision." in shown


@pytest.mark.wide
def test_a_model_that_was_not_identified_here_is_judged_as_it_is():
    made = certify(identify=False)
    [found] = made.conformity
    nominal = made.diagnosis.base.fitted.given.errors.summary.position_rms
    assert found.error == pytest.approx(nominal)
    assert found.error > 10 * made.errors.now.position_rms
    assert found.result == "fail"
    assert "The model was not identified from these samples." in part(page(made), "certificate")
    assert "identified from other samples" not in page(made)  # it was never fitted


@pytest.mark.wide
def test_a_fit_that_excluded_other_samples_is_not_certified_by_the_errors_of_another_fit(made):
    data = made.diagnosis.dataset.excluding({3: "knocked"})
    other = report(
        made.diagnosis.model, data, effects=["backlash"], certificate=CertificateFields(limit_um=50)
    )
    [found] = other.conformity
    assert (found.error, found.result) == (None, "not decided")
    shown = part(page(other), "certificate")
    assert "that fit excluded none." in shown
    assert "The model was identified from these samples." not in shown


@pytest.mark.wide
def test_numbers_of_fits_to_other_samples_are_not_taken_for_those_of_the_model(made):
    data = made.diagnosis.dataset
    moved = replace(data, time=data.time + 1.0, sha256="another")
    other = report(made.diagnosis.model, moved, effects=["backlash"])
    assert not other.certified.identified_here
    assert "those of fits to these samples, which start from it" in page(other)


@pytest.mark.wide
def test_on_paper_nothing_is_folded_or_beyond_the_edge(made, tmp_path):
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    sync = pytest.importorskip("playwright.sync_api")
    file = tmp_path / "r.html"
    file.write_text(page(made), encoding="utf-8")
    with sync.sync_playwright() as p:
        drawn = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
        browser = p.chromium.launch(executable_path=CHROMIUM, args=drawn)
        window = browser.new_page(viewport={"width": 1280, "height": 900})
        window.set_default_timeout(200e3)
        window.goto(f"file://{file}")
        window.evaluate("dispatchEvent(new Event('beforeprint'))")
        window.emulate_media(media="print")
        window.set_viewport_size({"width": 703, "height": 1000})  # A4 between its margins
        assert window.evaluate("[...document.querySelectorAll('details')].every(d => d.open)")
        assert window.evaluate("document.documentElement.scrollWidth") <= 703
        widths = window.evaluate(
            "[...document.querySelectorAll('.plot')].map(e => ["
            "e.querySelector('.svg-container')?.getBoundingClientRect().width ?? 0, "
            "e.getBoundingClientRect().width])"
        )
        # A planned pose is one line, so that a person at the robot does not mix up its numbers.
        heights = window.evaluate(
            "[...document.querySelectorAll('#what-to-measure-next tbody tr')]"
            ".map(e => e.getBoundingClientRect().height).filter(h => h)"
        )
        assert len(heights) == 20
        assert max(heights) < 20  # px
        # A sample is one line. A long certificate begins on the first page; its decision and the
        # line to sign are on one page.
        rows = window.evaluate(
            "[...document.querySelectorAll('#samples tbody tr')]"
            ".map(e => e.getBoundingClientRect().height)"
        )
        assert max(rows) < 20  # px
        breaks = window.evaluate(
            "['#certificate', '.decision'].map("
            "name => getComputedStyle(document.querySelector(name)).breakInside)"
        )
        assert breaks == ["auto", "avoid"]
        assert window.locator(".decision .signature").count() == 1
        # Views in space and from three sides are low, so that two of them are on one sheet.
        tall = window.evaluate(
            "[...document.querySelectorAll('#residuals-in-space .plot')].map(e => e.clientHeight)"
        )
        assert len(tall) == 3
        assert max(tall) < 330  # px
        # Figures of what the residuals do not depend on are not printed: their place has no width.
        assert all(0 < figure <= place + 1 for figure, place in widths if place)
        assert sum(place > 0 for _, place in widths) > 10
        browser.close()


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main(["report", *map(str, arguments), "--effect", "backlash"])
    return ended.value.code


@pytest.mark.wide
def test_the_command_prints_a_pdf_of_a4_pages(stated, tmp_path, capsys):
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    target = tmp_path / "r.pdf"
    assert run(MODEL, BAG, "--pdf", target, "--certificate", stated) == 0
    shown = capsys.readouterr().out
    assert "limit 50 um: fail" in shown  # the nominal model
    assert shown.splitlines()[-1] == f"written: {target}"
    content = target.read_bytes()
    assert content.startswith(b"%PDF")
    sizes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert 4 < len(sizes) < 40
    assert {(round(float(w)), round(float(h))) for w, h in sizes} == {(595, 842)}


def test_without_a_browser_no_diagnosis_begins(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PdfError, match="Install chromium, or open the page"):
        find_browser()
    assert run("no.yaml", "no_bag", "--pdf", tmp_path / "r.pdf") == 1
    assert "no browser that prints PDF" in capsys.readouterr().err


def test_a_wrong_name_of_the_pdf_is_refused(tmp_path, capsys):
    assert run("no.yaml", "no_bag", "--pdf", tmp_path / "r.txt") == 1
    assert "expected a name that ends in .pdf" in capsys.readouterr().err


@pytest.mark.wide
def test_the_certificate_of_a_session_states_excluded_samples_with_reasons_and_counts(
    tmp_path, run_cli
):
    session = Session.new(tmp_path / "s", pc.read_model(MODEL), [BAG])
    session.exclude({3: "the table was bumped", 7: "the table was bumped", 9: ""})
    output = tmp_path / "report.html"
    shown = ("--field", "serial_number=D-0042")
    document = json.loads(
        run_cli("session", "report", session.folder, "-o", output, *shown, "--json")
    )
    certificate = part(output.read_text(), "certificate")
    words = "3 of 94: the table was bumped (2: samples 3, 7); no reason given (1: sample 9)"
    assert f"<dt>Excluded samples</dt><dd>{words}</dd>" in certificate
    assert "<dd>D-0042</dd>" in certificate
    assert "91 samples" in certificate
    assert document["provenance"]["dataset"]["excluded"]["3"] == "the table was bumped"
    # A page is read on other computers: it names files, and only the document has their paths.
    path = str(Path(BAG).resolve())
    assert document["provenance"]["dataset"]["source"] == path
    assert path not in output.read_text()
    assert "<dt>Data</dt><dd>delta_backlash; 91 samples" in certificate


@pytest.mark.wide
def test_a_certificate_without_excluded_samples_says_so(made):
    assert "<dd>none; all 94 samples were used</dd>" in part(page(made), "certificate")
