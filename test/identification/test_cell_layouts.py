"""How real cells differ from one robot in front of one device.

Several stations of a tracker, a second reflector, an anchor that two lines share, and winches that
ride on the platform. The machines are simulated here by points and distances, with no code of the
package.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from parallel_cal.identification.fit import fit
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.mechanisms.stewart42 import Stewart42
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset

pytestmark = pytest.mark.wide
BASE = [350.0, 10.0, 110.0, 130.0, 230.0, 250.0]  # degrees
PLATFORM = [310.0, 50.0, 70.0, 170.0, 190.0, 290.0]
JOINT_SIGMA, SIGMA, TURN_SIGMA = 5e-6, 1e-5, 2e-5  # m, m, rad


def ring(radius, degrees):
    a = np.radians(degrees)
    return np.column_stack([radius * np.cos(a), radius * np.sin(a), 0 * a])


def platform_on_lines(n, rng):
    """Lengths (n, 6) of six lines or legs of a machine that is 1 mm off its drawing, and poses."""
    feet, heads = ring(0.5, BASE), ring(0.25, PLATFORM)
    home = np.linalg.norm(heads + [0, 0, 0.6] - feet, axis=1)
    feet, heads = feet + rng.normal(0, 1e-3, (6, 3)), heads + rng.normal(0, 5e-4, (6, 3))
    r = rng.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.7], (n, 3))
    R = Rotation.from_rotvec(rng.uniform(-0.25, 0.25, (n, 3)))
    ends = np.einsum("nij,kj->nki", R.as_matrix(), heads) + r[:, None]
    lengths = np.linalg.norm(ends - feet, axis=2) - home - rng.normal(0, 1e-3, 6)
    return lengths + rng.normal(0, JOINT_SIGMA, lengths.shape), r, R


def hexapod():
    return new_model(
        Stewart42(
            base={"radius": 0.5, "angles": BASE},
            platform={"radius": 0.25, "angles": PLATFORM},
            height=0.6,
        )
    )


def write(tmp_path, names, columns, column_map):
    """A table and its column map."""
    head = ",".join(names)
    np.savetxt(tmp_path / "data.csv", columns, delimiter=",", header=head, comments="")
    turn = f", orientation: {TURN_SIGMA:.1e}" if "qw" in names else ""
    noise = f"noise: {{joint: {JOINT_SIGMA:.1e}, position: {SIGMA:.1e}{turn}}}\n"
    (tmp_path / "data.columns.yaml").write_text(column_map + noise)
    return tmp_path / "data.csv"


def test_one_table_holds_two_stations_and_two_reflectors(tmp_path):
    rng = np.random.default_rng(3)
    n = 120
    q, r, R = platform_on_lines(n, rng)
    reflectors = np.array([[0.05, 0.02, 0.03], [-0.1, 0.08, 0.06]])
    stations = [
        (np.array([2.0, 1.0, 0.5]), Rotation.from_rotvec([0.1, 0.2, 2.0])),
        (np.array([-1.0, 2.5, 0.4]), Rotation.from_rotvec([0.0, -0.1, -1.0])),
    ]
    session = np.arange(n) % 4  # station 1 and 2, each with reflector 1 and 2
    seen = np.empty((n, 3))
    for i, k in enumerate(session):
        place, turn = stations[k // 2]
        seen[i] = turn.inv().apply(R[i].apply(reflectors[k % 2]) + r[i] - place)
    seen += rng.normal(0, SIGMA, seen.shape)
    legs = [f"leg{k}" for k in range(1, 7)]
    joints = "joints: {" + ", ".join(f"{leg}: {{column: {leg}}}" for leg in legs) + "}\n"
    path = write(
        tmp_path,
        [*(f"{leg} [m]" for leg in legs), "x [m]", "y [m]", "z [m]", "set-up"],
        np.column_stack([q, seen, session]),
        joints + "position: {columns: [x, y, z]}\nconditions: {session: set-up}\n",
    )
    model = hexapod()
    found = fit(model, load_dataset(path, mechanism=model.mechanism))
    floor, error = found.noise_floor.position_rms, found.held_out.summary.position_rms
    assert error < 1.25 * floor
    assert found.before.summary.position_rms > 10 * floor


def test_winches_may_ride_on_the_platform(tmp_path):
    # A line leaves its winch through an eyelet on the platform and ends at a fixed anchor. The
    # motor winds in 70 mm of line a turn.
    rng = np.random.default_rng(5)
    q, r, R = platform_on_lines(80, rng)
    seen = r + rng.normal(0, SIGMA, r.shape)
    R = Rotation.from_rotvec(rng.normal(0, TURN_SIGMA, r.shape)) * R
    names = [*(f"winch{k}" for k in range(1, 7)), "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"]
    column = "{{column: winch{0}, unit: rev, per_rev: -70 mm}}"
    legs = ", ".join(f"leg{k}: {column.format(k)}" for k in range(1, 7))
    path = write(
        tmp_path,
        names,
        np.column_stack([-q / 0.07, seen, R.as_quat()]),
        f"joints: {{{legs}}}\nposition: {{columns: [x, y, z]}}\norientation: [qx, qy, qz, qw]\n",
    )
    model = hexapod()
    found = fit(model, load_dataset(path, mechanism=model.mechanism))
    assert found.held_out.summary.position_rms < 1.25 * found.noise_floor.position_rms


@pytest.mark.parametrize("shared", [0.0, 1.0], ids=["apart", "shared"])
def test_two_lines_may_share_an_anchor(tmp_path, shared):
    rng = np.random.default_rng(4)
    drawn = np.array([[-2, -2, 3], [2, -2, 3], [2, 2, 3], [-2, 2, 3], [2, 2, 0.0]])
    drawn[4] += shared * (drawn[2] - drawn[4])  # lines 3 and 5 start at one point
    true = drawn + rng.normal(0, 5e-3, drawn.shape)
    true[4] = true[2] if shared else true[4]
    r = rng.uniform([-1, -1, 0.5], [1, 1, 2.2], (60, 3))
    q = np.linalg.norm(r[:, None] - true, axis=2)
    names = [*(f"line{k} [m]" for k in range(1, 6)), "x [m]", "y [m]", "z [m]"]
    q = q + rng.normal(0, JOINT_SIGMA, q.shape)
    lines = ", ".join(f"line{k}: {{column: line{k}}}" for k in range(1, 6))
    path = write(
        tmp_path,
        names,
        np.column_stack([q, r + rng.normal(0, SIGMA, r.shape)]),
        f"joints: {{{lines}}}\nposition: {{columns: [x, y, z]}}\n",
    )
    model = new_model(Cable(anchors=drawn.tolist(), zero="anchors"))
    found = fit(model, load_dataset(path, mechanism=model.mechanism))
    assert found.held_out.summary.position_rms < 1.3 * found.noise_floor.position_rms
    if shared:
        anchors = [[found.model.value(f"line{k}.A_{a}") for a in "xyz"] for k in (3, 5)]
        np.testing.assert_allclose(*anchors, atol=2e-4)
