"""A model file that is replaced is laid aside, and comes back."""

import shutil
from pathlib import Path

import pytest

from parallel_cal.base.errors import ModelFileError
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import dump_model, model_hash, replace_text
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.goals import Request, propose_model, undo_write, write_proposal

ROOT = Path(__file__).parents[2]


def test_undo_gives_the_file_before_back_and_undone_twice_the_new_one(tmp_path):
    path = str(shutil.copy(ROOT / "config" / "delta_mockup_nominal.yaml", tmp_path / "m.yaml"))
    before = Path(path).read_bytes()
    request = Request(path, path, FitOptions(hold_out=0.0), force=True)
    outcome = write_proposal(
        request, propose_model(request, load_dataset(ROOT / "bags" / "delta_clean"))
    )
    assert outcome.success, outcome.message
    after = Path(path).read_bytes()
    assert after != before
    assert Path(path + ".previous").read_bytes() == before
    assert model_hash(before)[:12] in undo_write(path)
    assert Path(path).read_bytes() == before
    undo_write(path)
    assert Path(path).read_bytes() == after


def test_a_file_laid_aside_has_the_permissions_of_the_one_that_was_there(tmp_path):
    """Also where an older one with others is replaced."""
    model, aside = tmp_path / "m.yaml", tmp_path / "m.yaml.previous"
    text = dump_model(new_model("delta24"))
    model.write_text("parallel_cal: 1\n"), aside.write_text("parallel_cal: 1\n")
    model.chmod(0o600), aside.chmod(0o644)
    replace_text(model, text)
    assert aside.stat().st_mode & 0o777 == 0o600


def test_where_nothing_was_replaced_or_it_was_spoilt_undo_says_so(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text("parallel_cal: 1\n")
    with pytest.raises(ModelFileError, match="nothing to undo"):
        undo_write(str(path))
    (tmp_path / "m.yaml.previous").write_text("parallel_cal: 1\nodd: 1\n")
    with pytest.raises(ModelFileError, match=r"m\.yaml\.previous"):
        undo_write(str(path))
    assert path.read_text() == "parallel_cal: 1\n"
