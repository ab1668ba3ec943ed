"""A folder of images and a table of joints become samples; nothing is dropped silently."""

import json

import numpy as np
import pytest

from parallel_cal.base.errors import DatasetError
from parallel_cal.cli import main as cli
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING
from parallel_cal.virtual.camera import Camera

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

import board_images  # noqa: E402

from parallel_cal.imaging.opencv import ImageError  # noqa: E402
from parallel_cal.importing.controller_files import samples  # noqa: E402

N = 6
SMALL = Camera((640, 512), (600.0, 600.0), (319.5, 255.5), board_images.LENS)


@pytest.fixture(scope="module")
def images():
    return list(board_images.shots(N, SMALL, near=0.38, far=0.5, tilt=0.4))


def name_of(k):
    return f"shot_{k:02d}.png"


@pytest.fixture
def folder(tmp_path, images):
    """A folder of images; the table has one row for each, in another order."""
    path = tmp_path / "shots"
    path.mkdir()
    for k, shot in enumerate(images):
        cv2.imwrite(str(path / name_of(k)), shot.image)
    return path


def joints_of(k):
    return 10.0 * k + np.array([1.0, 2.0, 3.0])


def table(folder, rows, header="image,joint1 [deg],joint2 [deg],joint3 [deg]", name=name_of):
    path = folder.parent / "joints.csv"
    lines = [",".join([str(name(k)), *map(str, joints_of(k))]) for k in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return str(path)


def check_pixels(dataset, row, shot):
    """The corners of a sample are those of a shot, and every one that is missing is NaN."""
    seen = 0
    for number in range(35):
        pixel = [dataset.conditions[f"{READING}camera.{number}.{a}"][row] for a in "uv"]
        if np.isfinite(pixel).all():
            assert pixel == pytest.approx(list(shot.pixels[number]), abs=0.3)
            seen += 1
        else:
            assert np.isnan(pixel).all()
    assert seen > 20


def test_each_row_gets_the_pixels_of_the_image_that_it_names(folder, images, tmp_path):
    order = [3, 0, 5, 1, 2, 4]
    output = tmp_path / "samples.json"
    words = ["import", "images", str(folder), "--joints", table(folder, order), "-o", str(output)]
    with pytest.raises(SystemExit, match="0"):
        cli.main(words)
    dataset = Dataset.from_json(output)
    assert dataset.joint_names == ("joint1", "joint2", "joint3")
    assert not dataset.measured.any()
    for row, k in enumerate(order):
        assert dataset.q[row] == pytest.approx(np.radians(joints_of(k)))
        check_pixels(dataset, row, images[k])
    assert dataset.conditions["direction.joint1"].tolist() == [0, -1, 1, -1, 1, 1]
    assert any("image_size: [640, 512]" in warning for warning in dataset.warnings)


def test_the_import_prints_the_corners_as_one_entry(folder, capsys, tmp_path):
    joints = table(folder, range(N))
    words = ["import", "images", str(folder), "--joints", joints, "-o", str(tmp_path / "s.json")]
    with pytest.raises(SystemExit, match="0"):
        cli.main(words)
    printed = " ".join(capsys.readouterr().out.split())
    assert "readings of 35 corners)" in printed
    assert "camera.17.u" not in printed


@pytest.mark.parametrize(
    ("name", "header", "options"),
    [
        (lambda k: name_of(k)[:-4], "file", {}),
        (lambda k: f"/home/robot/shots/{name_of(k)}", "path", {}),
        (lambda k: k, "index", {}),
        (lambda k: k, "visit", {"by": "visit"}),
        (lambda k: 100.004 + 0.5 * k, "time", {"within": 0.02}),
    ],
    ids=["stems", "paths", "numbers", "stated column", "times"],
)
def test_a_row_may_state_its_image_in_several_ways(folder, images, name, header, options):
    if header == "time":
        for k in range(N):
            (folder / name_of(k)).rename(folder / f"{int((100 + 0.5 * k) * 1e9):019d}.png")
    rows = [4, 2, 0, 1, 3, 5]
    header += ",joint1 [deg],joint2 [deg],joint3 [deg]"
    dataset = samples("images", [folder], joints=table(folder, rows, header, name), **options)
    assert len(dataset) == N
    check_pixels(dataset, 0, images[4])
    check_pixels(dataset, 3, images[1])


def test_rows_that_name_no_image_are_matched_by_their_order_and_the_note_says_so(folder, images):
    path = folder.parent / "joints.csv"
    lines = ["joint1 [deg]", *(str(10.0 * k) for k in range(N))]
    path.write_text("\n".join(lines) + "\n")
    dataset = samples("images", [folder], joints=str(path))
    check_pixels(dataset, 5, images[5])
    assert any("matched in the order of rows and of names" in note for note in dataset.warnings)
    path.write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(DatasetError, match=r"5 rows, but 6 images .*--option by=COLUMN"):
        samples("images", [folder], joints=str(path))


def test_unusable_images_are_listed_with_the_reason_and_their_rows_are_excluded(folder, images):
    cv2.imwrite(str(folder / name_of(4)), np.full((512, 640), 3, np.uint8))
    (folder / name_of(2)).write_bytes(b"not an image")
    blurred = cv2.GaussianBlur(images[1].image, (0, 0), 1.8)
    cv2.imwrite(str(folder / name_of(1)), blurred)
    cv2.imwrite(str(folder / name_of(5)), np.ascontiguousarray(images[5].image[:, ::-1]))
    cv2.imwrite(str(folder / "shot_07.png"), images[0].image)
    dataset = samples("images", [folder], joints=table(folder, range(N)))
    assert np.degrees(dataset.q[:, 0]) == pytest.approx([1.0, 31.0])
    reasons = {one.reason: (one.count, one.detail) for one in dataset.dropped}
    assert reasons["camera: the file is not an image"] == (1, name_of(2))
    dark = next(reason for reason in reasons if "dark" in reason)
    assert reasons[dark] == (1, name_of(4))
    assert reasons["camera: blurred"][1].startswith(f"{name_of(1)} (its edges are ")
    assert reasons["camera: no joint readings"] == (1, "shot_07.png")
    mirrored = next(reason for reason in reasons if "mirrored" in reason)
    assert mirrored.endswith("switch off the mirroring of the camera or its driver")
    assert reasons[mirrored] == (1, name_of(5))
    assert reasons["row without a usable image"][0] == 4


@pytest.mark.wide
def test_a_board_of_another_size_is_named_before_any_sample_is_made(folder):
    with pytest.raises(ImageError, match=r"a board of 8 columns and at least 6 rows .* 9x6"):
        samples("images", [folder], joints=table(folder, range(N)), board="9x6")


def test_a_second_camera_has_channels_of_its_own(folder, images, tmp_path):
    other = tmp_path / "right"
    other.mkdir()
    for k in range(1, N):
        cv2.imwrite(str(other / name_of(k)), images[k].image[::1])
    dataset = samples("images", [folder, other], joints=table(folder, range(N)))
    left, right = (dataset.conditions[f"{READING}{c}.17.u"] for c in ("camera", "camera2"))
    assert np.isnan(right[0])
    assert np.array_equal(left[1:], right[1:])


def test_poses_in_the_table_and_a_column_map_are_read_as_in_other_tables(folder, tmp_path):
    header = "image,leg,x [mm],y [mm]"
    joints = table(folder, range(N), header)
    (tmp_path / "map.yaml").write_text("joints: {leg1: {column: leg, unit: mm}}\n")
    dataset = samples("images", [folder], joints=joints, columns=str(tmp_path / "map.yaml"))
    assert dataset.joint_names == ("leg1",)
    assert dataset.q[2, 0] == pytest.approx(0.021)
    header = "image,x [mm],y [mm],z [mm]"
    with pytest.raises(DatasetError, match=r"no joints in image, x .mm., .*unit of each joint"):
        samples("images", [folder], joints=table(folder, range(N), header))


def test_columns_of_conditions_are_recorded_and_the_unused_ones_are_named(folder):
    """A stranger stated the side of each stop in a column, as docs/camera.md says."""
    sides = [1, 1, -1, -1, 1, -1]
    header = (
        "image,joint1 [deg],joint2 [deg],joint3 [deg],direction.joint1,direction.joint3,"
        "travel.joint1 [mrad],payload [g],temperature.arms [K],time [ms],direction.joint7,remark"
    )
    lines = [
        ",".join(map(str, (name_of(k), *joints_of(k), side, -side, 7, 500, 300, 40 * k, 1, "ok")))
        for k, side in enumerate(sides)
    ]
    path = folder.parent / "joints.csv"
    path.write_text("\n".join([header, *lines]) + "\n")
    dataset = samples("images", [folder], joints=str(path))
    found = dataset.conditions
    assert dataset.joint_names == ("joint1", "joint2", "joint3")
    assert found["direction.joint1"].tolist() == sides
    assert found["direction.joint3"].tolist() == [-side for side in sides]
    assert found["travel.joint1"] == pytest.approx(np.full(N, 0.007))
    assert found["payload"] == pytest.approx(np.full(N, 0.5))
    assert found["temperature.arms"] == pytest.approx(np.full(N, 26.85))
    assert found["time"] == pytest.approx(0.04 * np.arange(N))
    assert not any("order of the rows" in note for note in dataset.warnings)
    assert f"{path}: columns that are not used: direction.joint7, remark" in dataset.warnings


def test_columns_that_a_column_map_does_not_name_are_listed(folder, tmp_path):
    header = "image,leg,direction.leg1,remark"
    (tmp_path / "map.yaml").write_text("joints: {leg1: {column: leg, unit: mm}}\n")
    joints = table(folder, range(N), header)
    dataset = samples("images", [folder], joints=joints, columns=str(tmp_path / "map.yaml"))
    assert f"{joints}: columns that are not used: direction.leg1, remark" in dataset.warnings


def test_a_printer_without_encoders_gets_its_joints_from_commanded_positions(folder, images):
    """The commands of docs/camera.md for a robot with stepper motors."""
    work = folder.parent
    positions = [f"{0.01 * k},{-0.005 * k},{0.02 + 0.01 * k}" for k in range(N)]
    (work / "targets.csv").write_text("\n".join(["x,y,z", *positions]) + "\n")
    joints = ", ".join(f"joint{i}: {{column: joint{i}, unit: m}}" for i in (1, 2, 3))
    (work / "map.yaml").write_text(f"joints: {{{joints}}}\n")
    model, table, output = (str(work / name) for name in ("m.yaml", "joints.csv", "s.json"))
    options = ["--option", f"columns={work / 'map.yaml'}", "--option", "by=row"]
    for words in (
        ["new", "linear_delta", "-o", model],
        ["inverse", model, "--input", str(work / "targets.csv"), "--output", table],
        ["import", "images", str(folder), "--joints", table, *options, "-o", output],
    ):
        with pytest.raises(SystemExit, match="0"):
            cli.main(words)
    dataset = Dataset.from_json(output)
    reached = Kinematics(new_model("linear_delta")).direct(dataset.q).position
    np.testing.assert_allclose(reached[5], [0.05, -0.025, 0.07], atol=1e-9)
    check_pixels(dataset, 5, images[5])


def test_a_folder_without_images_and_a_missing_table_are_refused(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImageError, match="empty: no image in it"):
        samples("images", [tmp_path / "empty"], joints=table(folder, range(N)))
    with pytest.raises(DatasetError, match=r"nothing.csv: the table cannot be read"):
        samples("images", [folder], joints=str(tmp_path / "nothing.csv"))
    with pytest.raises(DatasetError, match="its options: joints, board='8x6'"):
        samples("images", [folder])


def test_the_excluded_corners_are_named(folder, images):
    image = images[0].image.copy()
    u, v = np.round(images[0].pixels[17]).astype(int)
    image[v - 4 : v + 5, u - 4 : u + 5] = images[0].image[v - 4 : v + 5, u - 7 : u + 2]
    cv2.imwrite(str(folder / name_of(0)), image)
    dataset = samples("images", [folder], joints=table(folder, range(N)))
    assert np.isnan(dataset.conditions[f"{READING}camera.17.u"][0])
    assert any(f"{name_of(0)} corner 17" in warning for warning in dataset.warnings)


def test_the_document_of_the_import_counts_every_channel(folder, capsys, tmp_path):
    words = ["import", "images", str(folder), "--joints", table(folder, range(N)), "--json"]
    with pytest.raises(SystemExit, match="0"):
        cli.main([*words, "-o", str(tmp_path / "s.json")])
    document = json.loads(capsys.readouterr().out)
    assert document["samples"] == N
    assert document["readings"]["camera.17.v"] >= N - 1
