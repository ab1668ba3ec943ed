"""Files of measuring devices that are not read are named with what to do."""

import pytest

from parallel_cal.base.errors import BagError, DatasetError
from parallel_cal.importing.controller_files import samples
from parallel_cal.recordings.loading import load_dataset

# The sections of a file of Renishaw's laser software, as two published readers of it expect them.
RTL = """HEADER::
File type: Linear
TARGET DATA::
Target-count: 2
Targets :
    0.0000  100.0000
RUNS::
Run-count: 2
DEVIATIONS::
Run Target Data:
   1   1    0.0000
   1   2    0.0012
   2   2    0.0019
   2   1    0.0004
"""
C3D = b"\x02P\x01\x00\x00\x00\x01\x00" + bytes(504)  # the begin of a file that ezc3d 1.7.2 wrote


def written(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("name", "content", "cure"),
    [
        ("a.c3d", C3D, "Export the bodies or trajectories as CSV"),
        ("renamed.dat", C3D, "Export the bodies or trajectories as CSV"),
        ("a.rtl", RTL, "deviations of one axis .* as x the target plus its deviation"),
        ("a.rtl", "\ufeff\r\n" + RTL, "deviations of one axis"),
    ],
)
def test_a_file_of_a_device_that_is_not_read_is_named_with_the_cure(tmp_path, name, content, cure):
    path = written(tmp_path, name, content)
    with pytest.raises(BagError, match=rf"{name}: a .*file of .*{cure}"):
        load_dataset(path, joints=("leg1",))


def test_so_is_one_that_is_given_as_a_table(tmp_path):
    joints = written(tmp_path, "joints.csv", "n,leg1 [mm]\n1,2\n2,3\n")
    for name, content in (("a.csv", RTL), ("b.c3d", C3D)):
        with pytest.raises(DatasetError, match=rf"{name}: a .*file of "):
            samples("table", [written(tmp_path, name, content), joints])


def test_targets_and_deviations_of_one_axis_make_samples_of_one_coordinate(tmp_path):
    """The table that the message asks for."""
    written(tmp_path, "a.csv", "leg1 [mm],x [mm]\n0,0\n100,100.0012\n100,100.0019\n0,0.0004\n")
    columns = "joints: {leg1: {column: leg1}}\nposition: {columns: [x, null, null]}\n"
    written(tmp_path, "a.columns.yaml", columns)
    data = load_dataset(tmp_path / "a.csv", joints=("leg1",))
    assert data.measured.tolist() == [[True, *[False] * 5]] * 4
    assert data.r[:, 0] == pytest.approx([0, 0.1000012, 0.1000019, 4e-7])
    assert data.pose_id.tolist() == [0, 1, 1, 0]
