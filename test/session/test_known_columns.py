"""The columns of a table are known to the next table, in any session of the same user."""

import json

import pytest

from parallel_cal.base.files import state_folder
from parallel_cal.model.model import new_model
from parallel_cal.session.known_columns import FOLDER, remember_columns
from parallel_cal.session.session import Session
from parallel_cal.session.table_preview import preview_table

DELTA = new_model("delta54")
HEADER = ["m1", "m2", "m3", "X", "Y", "Z"]
COLUMNS = {
    "joints": {f"joint{k}": {"column": f"m{k}", "unit": "deg"} for k in (1, 2, 3)},
    "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
    "conditions": {},
    "visits": "unordered",
    "noise": {"position": 2e-5},
}


@pytest.fixture
def user(tmp_path, monkeypatch):
    """A user of whom nothing is known: the folder of the maps."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return state_folder() / FOLDER


@pytest.fixture
def preview(tmp_path):
    """The preview of a table with this header, in a new session of this model."""

    def read(header=HEADER, model=DELTA):
        session = tmp_path / f"s{len(list(tmp_path.glob('s*')))}"
        Session.new(session, model, [])
        table = tmp_path / "next.csv"
        table.write_text(",".join(header) + "\n" + ",".join(["1"] * len(header)) + "\n")
        return preview_table(table, session)

    return read


def test_the_columns_of_a_table_are_known_in_the_next_session(user, preview, tmp_path):
    assert preview()["remembered"] is None
    assert remember_columns(DELTA.mechanism, tmp_path / "first.csv", COLUMNS) == ""
    found = preview([*HEADER, "remark"])
    assert found["remembered"] == COLUMNS
    assert found["remembered_from"].startswith("first.csv, imported on 2")
    assert preview(HEADER[:-1])["remembered"] is None  # Z is not there
    # Joints of the same names that move in m are those of another machine.
    assert preview(model=new_model("linear_delta"))["remembered"] is None


def test_the_last_import_of_the_same_columns_counts(user, preview, tmp_path):
    remember_columns(DELTA.mechanism, tmp_path / "first.csv", COLUMNS)
    other = COLUMNS | {"noise": {"position": 1e-5}}
    remember_columns(DELTA.mechanism, tmp_path / "second.csv", other)
    assert preview()["remembered"] == other
    assert len(list(user.iterdir())) == 1


@pytest.mark.parametrize(
    "damage",
    [
        b"",
        b"\xff\xfe",
        b"[]",
        b'{"table": "a.csv", "joints": 3, "columns": {}}',
        lambda known: known | {"columns": {}},
        lambda known: known | {"columns": COLUMNS | {"joints": {"joint1": 3}}},
        lambda known: known | {"columns": COLUMNS | {"conditions": {"payload": 2.0}}},
        lambda known: known | {"columns": {k: v for k, v in COLUMNS.items() if k != "noise"}},
    ],
)
def test_a_damaged_file_is_as_none_and_the_next_import_replaces_it(user, preview, tmp_path, damage):
    remember_columns(DELTA.mechanism, tmp_path / "first.csv", COLUMNS)
    (file,) = user.iterdir()
    if callable(damage):
        damage = json.dumps(damage(json.loads(file.read_text()))).encode()
    file.write_bytes(damage)
    found = preview()
    assert not found["error"]
    assert found["remembered"] is None
    remember_columns(DELTA.mechanism, tmp_path / "second.csv", COLUMNS)
    assert preview()["remembered"] == COLUMNS


def test_a_folder_that_cannot_be_written_is_told(user, preview, tmp_path):
    user.parent.mkdir(parents=True)
    user.write_text("")  # a file where the folder should be
    said = remember_columns(DELTA.mechanism, tmp_path / "first.csv", COLUMNS)
    assert said.startswith("the columns are not remembered for the next table: ")
    assert preview()["remembered"] is None
