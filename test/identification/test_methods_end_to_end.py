"""Every method through fit(), the command line and the model file, and its clear errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from datasets import measured
from marks import keep

from parallel_cal.base.errors import FitError
from parallel_cal.cli import main as cli
from parallel_cal.identification.fit import fit
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins
from parallel_cal.virtual import robot as vr

METHODS = list_plugins("identification.methods")
# One that solves closures, one that solves for poses, one of a single step, one that eliminates.
SOME_THEN_ALL = keep(METHODS, "implicit", "forward", "linear", "cascaded")
ECCENTRIC = vr.EncoderEccentricity((4e-3, -3e-3, 2e-3), (1e-3, 4e-3, -3e-3))
EXPANDED = ("semiparametric", "cascaded")  # they know no effect that needs its own functions


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return ended.value.code, out, err


@pytest.fixture(scope="module")
def ideal():
    """A Delta with perfect parallelograms: model 24 is all of it."""
    small = new_model("delta24").table.names
    return vr.Delta({**vr.TABLE_5_12, **{k: vr.TABLE_5_18[k] for k in small}})


@pytest.mark.wide
@pytest.mark.parametrize("method", SOME_THEN_ALL)
def test_every_method_goes_from_recording_to_model_file(method, ideal, tmp_path, capsys):
    write_model(new_model("delta24"), tmp_path / "model.yaml")
    measured(0, robot=ideal).to_json(tmp_path / "samples.json")
    files = [tmp_path / "model.yaml", tmp_path / "samples.json", "-o", tmp_path / "out.yaml"]
    code, out, err = run(capsys, "fit", *files, "--method", method, "--json")
    assert code == 0, err
    document = json.loads(out)
    assert document["method"] == method
    held, floor = document["held_out"]["after"], document["noise_floor"]
    assert held["position_rms"] < document["held_out"]["before"]["position_rms"] / 5
    assert held["position_rms"] < 1.5 * floor["position_rms"]
    written = read_model(tmp_path / "out.yaml")
    assert written.history[-1]["method"] == method
    sigma = np.sqrt(np.diag(written.covariance))
    for name, entry in document["parameters"].items():
        i = written.table.index_of(name)
        assert written.values[i] == entry["value"]
        assert sigma[i] == pytest.approx(entry["sigma"], rel=1e-6)


@pytest.mark.wide
@pytest.mark.parametrize("method", SOME_THEN_ALL)
def test_every_method_finds_an_effect_or_says_that_it_cannot(method, ideal):
    data = measured(7, robot=ideal, effects=[ECCENTRIC])
    model = new_model("delta24").with_effect("encoder_eccentricity")
    if method in EXPANDED:
        with pytest.raises(FitError, match=r"cannot be separated.*use the implicit method"):
            fit(model, data, method=method)
        return
    document = fit(model, data, method=method).document()
    without = fit(new_model("delta24"), data, method=method).document()
    within, before = (d["held_out"]["after"]["position_rms"] for d in (document, without))
    assert within < 0.8 * before
    assert within < 1.5 * document["noise_floor"]["position_rms"]


REFUSING = {"implicit": (), "cascaded": pytest.mark.wide}


@pytest.mark.parametrize(
    "method", [pytest.param(m, marks=REFUSING.get(m, pytest.mark.slow)) for m in METHODS]
)
def test_every_method_refuses_what_the_data_cannot_carry(method, ideal):
    model, data = new_model("delta24"), measured(0, robot=ideal)
    with pytest.raises(FitError, match=r"5 different poses give 30 equations|give 15 equations"):
        fit(model, data.select(np.arange(6)), method=method)
    with pytest.raises(FitError, match="1 different poses give"):
        fit(model, data.select(np.zeros(50, dtype=int)), method=method)
    with pytest.raises(FitError, match="free and fix both match"):
        fit(model, data, method=method, free=["chain1.Lb"], fix=["chain1.Lb"])
    with pytest.raises(FitError, match="no parameter is free"):
        fit(model, data, method=method, fix=["*"])


@pytest.mark.wide
@pytest.mark.parametrize("method", SOME_THEN_ALL)
def test_what_the_poses_cannot_tell_is_named_by_every_method(method):
    """On the line through its middle a chain shows arm, rod, distance, height and zero alone."""
    line = np.linspace([0.0, 0.0, 0.16], [0.0, 0.0, 0.26], 40)
    q, R = vr.NOMINAL.inverse(line)
    data = replace(measured(0).select(np.arange(40)), q=q, r=line, R=R, pose_id=np.arange(40))
    result = fit(new_model("delta24"), data, method=method, hold_out=0)
    assert result.estimate.spectrum.rank == 15
    assert np.isinf(result.estimate.sigma).sum() == 9
    said = [w for w in result.warnings if "the data do not determine" in w]
    assert len(said) == 1  # so many are one sentence
    assert said[0].startswith("the data do not determine 9 combinations of ")
    assert len(result.document()["unidentifiable"]) == 9
