"""Which files a request may read and replace."""

import pytest

from parallel_cal.base.errors import ModelError, ParallelCalError
from parallel_cal.model import shelf
from parallel_cal.nodes.folders import Folders

MODEL, SAMPLES = "parallel_cal: 1\n", '{"parallel_cal_samples": 1}'


@pytest.fixture
def folders(tmp_path):
    (tmp_path / "in" / "deep").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    return Folders("", [tmp_path / "in"])


def test_what_lies_below_is_allowed_and_nothing_else(folders, tmp_path):
    assert folders.to_read(str(tmp_path / "in" / "deep" / "m.yaml"))
    for outside in ("out/m.yaml", "in/../out/m.yaml", "inside.yaml"):
        with pytest.raises(ParallelCalError, match="not in a folder"):
            folders.to_read(str(tmp_path / outside))


def test_no_link_leads_out(folders, tmp_path):
    (tmp_path / "in" / "link").symlink_to(tmp_path / "out")
    (tmp_path / "in" / "own").symlink_to(tmp_path / "in" / "deep")
    with pytest.raises(ParallelCalError, match="not in a folder"):
        folders.to_write(str(tmp_path / "in" / "link" / "m.yaml"), "model")
    assert folders.to_write(str(tmp_path / "in" / "own" / "m.yaml"), "model")


def test_a_file_is_replaced_by_its_own_kind_only(folders, tmp_path):
    model, samples, other = (tmp_path / "in" / n for n in ("m.yaml", "s.json", "notes.txt"))
    model.write_text(MODEL), samples.write_text(SAMPLES), other.write_text("mine")
    assert folders.to_write(str(model), "model")
    assert folders.to_write(str(samples), "samples")
    for path, kind in (
        (model, "samples"),
        (samples, "model"),
        (other, "model"),
        (tmp_path / "in", "model"),
    ):
        with pytest.raises(ParallelCalError, match=f"not a {kind} file"):
            folders.to_write(str(path), kind)


def test_a_backup_of_a_model_stays_in_an_allowed_folder_and_replaces_only_a_model(
    folders, tmp_path
):
    model, aside = tmp_path / "in" / "m.yaml", tmp_path / "in" / "m.yaml.previous"
    model.write_text(MODEL), aside.write_text("mine")
    with pytest.raises(
        ParallelCalError, match=r"m\.yaml\.previous: exists and is not a model file"
    ):
        folders.to_write(str(model), "model")
    aside.unlink(), (tmp_path / "out" / "m.yaml").write_text(MODEL)
    aside.symlink_to(tmp_path / "out" / "m.yaml")
    with pytest.raises(ParallelCalError, match=r"m\.yaml\.previous: not in a folder"):
        folders.to_write(str(model), "model")


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        (".bash_profile", "samples", r"must end in \.json"),
        ("samples", "samples", r"must end in \.json"),
        ("samples.json.sh", "samples", r"must end in \.json"),
        ("robot.yaml", "samples", r"must end in \.json"),
        (".profile.json", "samples", "begin with a dot"),
        (".json", "samples", "begin with a dot"),
        (".config/autostart/samples.json", "samples", "begin with a dot"),
        (".bash_profile", "model", r"must end in \.yaml or \.yml"),
        ("robot.json", "model", r"must end in \.yaml or \.yml"),
        (".robot.yaml", "model", "begin with a dot"),
        ("deep/.hidden/robot.yml", "model", "begin with a dot"),
    ],
)
def test_a_file_that_a_shell_may_execute_is_refused_by_its_name(
    folders, tmp_path, name, kind, expected
):
    path = str(tmp_path / "in" / name)
    with pytest.raises(ParallelCalError, match=expected) as refused:
        folders.to_write(path, kind)
    assert path in str(refused.value)


def test_a_link_with_a_good_name_does_not_lead_to_a_hidden_file(folders, tmp_path):
    (tmp_path / "in" / "s.json").symlink_to(tmp_path / "in" / ".profile")
    (tmp_path / "in" / ".profile").write_text(SAMPLES)
    with pytest.raises(ParallelCalError, match=r"must end in \.json"):
        folders.to_write(str(tmp_path / "in" / "s.json"), "samples")
    (tmp_path / "in" / ".hidden").mkdir()
    (tmp_path / "in" / "open").symlink_to(tmp_path / "in" / ".hidden")
    with pytest.raises(ParallelCalError, match="begin with a dot"):
        folders.to_write(str(tmp_path / "in" / "open" / "s.json"), "samples")


def test_files_below_an_allowed_folder_that_is_hidden_itself_are_written(tmp_path):
    """The usual folder is ~/.ros/parallel_cal."""
    (tmp_path / ".ros" / "parallel_cal").mkdir(parents=True)
    folders = Folders("", [tmp_path / ".ros" / "parallel_cal"])
    for name, kind in (("s.json", "samples"), ("m.yaml", "model"), ("m.yml", "model")):
        path = str(tmp_path / ".ros" / "parallel_cal" / name)
        assert folders.to_write(path, kind) == path


def test_listed_folders_stand_in_for_the_usual_ones(tmp_path):
    folders = Folders(f"{tmp_path}/a:{tmp_path}/b", [tmp_path / "in"])
    assert folders.to_read(f"{tmp_path}/b/x")
    with pytest.raises(ParallelCalError, match="not in a folder"):
        folders.to_read(f"{tmp_path}/in/x")


def test_forbidden_modules_are_not_imported(monkeypatch, tmp_path):
    """The name is judged before anything is imported: the file would leave a trace."""
    trace = tmp_path / "trace"
    (tmp_path / "stranger.py").write_text(f"open({str(trace)!r}, 'w')\n")
    (tmp_path / "pkg").mkdir()
    (tmp_path / "pkg" / "stranger.py").write_text(f"open({str(trace)!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(shelf, "_own_allowed", True)
    shelf.forbid_foreign()
    for load in (shelf.load_mechanism, shelf.load_effect, shelf.load_sensor):
        with pytest.raises(ModelError, match="allow_foreign_modules"):
            load("pkg.stranger")
    assert not trace.exists()
    assert shelf.load_mechanism("delta24").name == "delta24"
