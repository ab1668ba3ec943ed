"""Redundant belts and lines calibrate their anchors by their own lengths, without a device."""

import json

import numpy as np
import pytest

from parallel_cal.cli.main import main
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset

DRAWN = {
    "plotter": np.array([[-1.5, 1.0], [1.5, 1.0], [1.5, -1.0], [-1.5, -1.0]]),
    "cables": np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-1.5, 1.5) for z in (-0.2, 2.2)]),
}
# What defines the frame {B}: one anchor, and the directions to two others.
FRAME = {
    "plotter": ("line4.A_?", "line3.A_y"),
    "cables": ("line1.A_?", "line5.A_y", "line5.A_z", "line3.A_z"),
}
SIGMA = 0.3e-3  # m, of one length


def run(words):
    """Exit status of a command."""
    with pytest.raises(SystemExit) as end:
        main(words)
    return end.value.code


def placed(true, drawn, names):
    """The true anchors in the frame that the fixed coordinates of the drawing define."""
    first, second, *third = names
    axis = (true[second] - true[first]) / np.linalg.norm(true[second] - true[first])
    if len(drawn[0]) == 2:
        along = np.sign(drawn[second, 0] - drawn[first, 0]) * axis
        turn = np.array([along, [-along[1], along[0]]])
    else:
        side = true[third[0]] - true[first]
        side = side - axis * (side @ axis)
        side /= np.linalg.norm(side)
        turn = np.array([axis, side, np.cross(axis, side)])
    return (true - true[first]) @ turn.T + drawn[first]


ORDER = {"plotter": (3, 2), "cables": (0, 4, 2)}


def lengths(machine, seed, n=40, sigma=SIGMA):
    """Anchors (lines, d) that strayed by 10 mm, and noisy lengths (n, lines) to unknown points."""
    rng, drawn = np.random.default_rng([seed, 11]), DRAWN[machine]
    true = drawn + rng.normal(0, 10e-3, drawn.shape)
    high = 0.7 * drawn.max(axis=0)
    points = rng.uniform(np.where(drawn.min(axis=0) < -1e-9, -high, 0.1), high, (n, len(high)))
    if len(high) == 3:
        points[:, 2] = rng.uniform(0.1, 1.6, n)
    return true, np.linalg.norm(points[:, None] - true, axis=2) + rng.normal(
        0, sigma, (n, len(drawn))
    )


def dataset(q, sigma=SIGMA):
    names = [f"line{i + 1}" for i in range(q.shape[1])]
    none = np.zeros((len(q), 6), bool)
    return Dataset.from_arrays(names, q, np.zeros((len(q), 3)), measured=none, joint_sigma=sigma)


def model(machine):
    return new_model(load_mechanism("cable", anchors=DRAWN[machine].tolist(), zero="anchors"))


def anchors(found, machine):
    axes = "xyz"[: DRAWN[machine].shape[1]]
    names = [f"line{i + 1}.A_{a}" for i in range(len(DRAWN[machine])) for a in axes]
    index = [found.model.table.index_of(name) for name in names]
    shape = DRAWN[machine].shape
    return found.model.values[index].reshape(shape), found.estimate.sigma[index].reshape(shape)


def z_scores(machine, seed):
    """Errors of the identified anchors in their own sigmas, and the held-out disagreement."""
    true, q = lengths(machine, seed)
    found = fit(model(machine), dataset(q), fix=["*.offset", *FRAME[machine]])
    estimate, sigma = anchors(found, machine)
    free = sigma > 0
    off = estimate - placed(true, DRAWN[machine], ORDER[machine])
    np.testing.assert_allclose(off[~free], 0, atol=1e-9)
    before, after = (e.summary.joint_rms for e in (found.held_out_before, found.held_out))
    return off[free] / sigma[free], before, after


def test_two_lines_that_are_too_long_disagree_by_what_least_squares_leave():
    """Four anchors at 3 m on the axes. Lengths 3 m and, on the x-axis, 3.01 m twice: no point is
    nearer to one than to the other, so 10 mm of each of the two are left."""
    cross = load_mechanism("cable", anchors=[[-3, 0], [3, 0], [0, 3], [0, -3]], zero="anchors")
    q = np.array([[3.01, 3.01, 3.0, 3.0]])
    found = compare(new_model(cross), dataset(np.repeat(q, 2, axis=0)))
    np.testing.assert_allclose(found.errors.joint, np.tile([0.01, 0.01, 0, 0], (2, 1)), atol=1e-6)


@pytest.mark.parametrize("machine", DRAWN)
def test_the_anchors_are_found_within_their_sigmas_without_a_device(machine):
    z, before, after = z_scores(machine, 0)
    assert np.abs(z).max() < 4
    assert before > 5e-3
    lines, freedoms = DRAWN[machine].shape
    assert after < 1.4 * SIGMA * np.sqrt(lines - freedoms)


@pytest.mark.wide
@pytest.mark.parametrize("machine", DRAWN)
def test_errors_of_the_anchors_are_as_large_as_stated_over_30_draws(machine):
    z = np.concatenate([z_scores(machine, seed)[0] for seed in range(30)])
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15


def test_a_table_of_lengths_is_all_that_the_command_line_needs(tmp_path, capsys):
    true, q = lengths("plotter", 1)
    table, columns = tmp_path / "belts.csv", tmp_path / "columns.yaml"
    np.savetxt(table, 1e3 * q, delimiter=",", header="tl,tr,br,bl", comments="", fmt="%.4f")
    joints = [
        f"  line{i}: {{column: {c}, unit: mm}}\n" for i, c in enumerate(("tl", "tr", "br", "bl"), 1)
    ]
    columns.write_text("joints_only: true\njoints:\n" + "".join(joints), encoding="utf-8")
    drawn, samples, found = (str(tmp_path / name) for name in ("m.yaml", "b.json", "f.yaml"))
    own = ["--option", f"anchors={DRAWN['plotter'].tolist()}", "--option", "zero=anchors"]
    assert run(["new", "cable", *own, "-o", drawn]) == 0
    assert run(["import-csv", str(table), "--columns", str(columns), "-o", samples]) == 0
    fixed = [word for pattern in ("*.offset", *FRAME["plotter"]) for word in ("--fix", pattern)]
    capsys.readouterr()
    noise = ["--joint-sigma", str(SIGMA)]
    assert run(["fit", drawn, samples, "-o", found, *noise, *fixed, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    wanted = placed(true, DRAWN["plotter"], ORDER["plotter"])
    for i in range(4):
        for k, axis in enumerate("xy"):
            if own := result["parameters"].get(f"line{i + 1}.A_{axis}"):
                assert own["value"] == pytest.approx(wanted[i, k], abs=max(4 * own["sigma"], 1e-9))
    assert result["held_out"]["after"]["joint_rms"] < 2 * SIGMA
    assert run(["diagnose", found, samples, *noise, "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert (verdict["verdict"], verdict["effects"]) == ("at_noise", [])


def test_a_table_of_joints_alone_must_say_that_nothing_else_was_measured(tmp_path, capsys):
    table, columns = tmp_path / "belts.csv", tmp_path / "columns.yaml"
    table.write_text("tl\n1000\n", encoding="utf-8")
    columns.write_text("joints:\n  line1: {column: tl, unit: mm}\n", encoding="utf-8")
    out = str(tmp_path / "b.json")
    assert run(["import-csv", str(table), "--columns", str(columns), "-o", out]) == 1
    assert "write 'joints_only: true'" in capsys.readouterr().err
