"""Fleets: what is judged, what fails with a reason, and what survives when something dies."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import fleets
import numpy as np
import pytest
import virtual_fleet as vf
from clusters import cluster
from datasets import measured

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.fleet.cluster import cluster as on_this_machine
from parallel_cal.fleet.fleet import judge
from parallel_cal.fleet.jobs import FleetError, FleetOptions, Job, jobs_of
from parallel_cal.fleet.judging import judge_recording
from parallel_cal.fleet.rows import Rows
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset

pq = pytest.importorskip("pyarrow.parquet")
distributed = pytest.importorskip("distributed")

QUICK = FleetOptions(effects=("backlash",))
BAG = fleets.ROOT / "bags" / "delta_backlash"


@pytest.fixture
def folder(tmp_path):
    """Two robots: one with a model of its own, one with that beside the folders."""
    for robot, recordings in {"a": ("monday", "tuesday"), "b": ("monday",)}.items():
        (tmp_path / robot).mkdir()
        for name in recordings:
            (tmp_path / robot / name).symlink_to(BAG)
    shutil.copy(fleets.NOMINAL, tmp_path / "all.yaml")
    shutil.copy(fleets.NOMINAL, tmp_path / "a" / "own.yaml")
    return tmp_path


def listed(folder, *rows, header="robot,model,recording,time"):
    (folder / "list.csv").write_text("\n".join([header, *rows]))
    return folder / "list.csv"


def test_a_folder_for_each_robot_holds_its_recordings_and_its_model(folder):
    jobs = jobs_of(folder)
    assert [(j.robot, j.recording, j.model.name) for j in jobs] == [
        ("a", "monday", "own.yaml"),
        ("a", "tuesday", "own.yaml"),
        ("b", "monday", "all.yaml"),
    ]
    shutil.copy(fleets.NOMINAL, folder / "a" / "other.yaml")
    with pytest.raises(FleetError, match=r"a: expected one model file.*found other.yaml, own.yaml"):
        jobs_of(folder)


def test_a_list_says_when_a_recording_was(folder):
    (job,) = jobs_of(listed(folder, "x,all.yaml,a/monday,1970-01-02T00:00:05+00:00"))
    assert (job.robot, job.recording, job.time) == ("x", "a/monday", 86405.0)
    assert jobs_of(listed(folder, "x,all.yaml,a/monday,1970-01-02"))[0].time == 86400.0


def test_the_last_recording_is_the_last_by_time_or_by_number(folder):
    rows = ["x,all.yaml,a/monday,2026-01-08", "x,all.yaml,a/tuesday,2026-01-07"]
    rows += ["y,all.yaml,10,2026-01-01", "y,all.yaml,9,"]
    for name in ("9", "10"):
        (folder / name).symlink_to(BAG)
    jobs = jobs_of(listed(folder, *rows))
    assert [job.recording for job in jobs] == ["a/tuesday", "a/monday", "9", "10"]
    assert [job.recording for job in jobs if job.last] == ["a/monday", "10"]


@pytest.mark.parametrize("since", [1.78e9, 0.0])
def test_samples_that_count_from_1970_say_when_they_were_taken(folder, since):
    data = load_dataset(BAG)
    replace(data, time=data.time + since).to_json(folder / "samples.json")
    job = replace(jobs_of(folder)[0], data=folder / "samples.json")
    assert judge_recording(job, QUICK, "")[0]["time"] == (
        since + data.time.min() if since else None
    )


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["x,all.yaml,a/monday,", "x,a/own.yaml,a/tuesday,"], "two robots have the name 'x'"),
        (["x,all.yaml,a/monday,", "x,all.yaml,a/monday,"], "'x' has the recording a/monday twice"),
        (["x,all.yaml,a/monday,May"], r"list.csv:2: time is 'May', expected a time such as 2026"),
        (["x,,a/monday,"], "list.csv:2: no model"),
        ([], "expected a header line and rows"),
        (
            ["x,no.yaml,a/monday,", "x,no.yaml,b/1,"],
            r":2: no such .*no.yaml; .*:3: no .*; .*:3: .*b/1",
        ),
    ],
)
def test_a_wrong_list_is_refused_before_work_begins(folder, rows, words):
    with pytest.raises((DatasetError, FleetError), match=words):
        judge(listed(folder, *rows), folder / "out")
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("robot,model", "list.csv:1: no column recording"),
        ("robot,modle,recording", r":1: unknown column 'modle', expected robot.*mean 'model'\?"),
        (
            "robot,model,recording,tiem",
            "unknown column 'tiem', expected .*time; did you mean 'time'",
        ),
    ],
)
def test_a_list_with_other_columns_says_which(folder, header, words):
    with pytest.raises(FleetError, match=words):
        jobs_of(listed(folder, header.replace("robot", "x"), header=header))


@pytest.mark.parametrize("apart", ",;\t")
def test_a_list_may_come_from_any_spreadsheet(folder, apart):
    rows = ["\ufeffrobot,model,recording,", "x , all.yaml,a/monday ,"]
    (folder / "list.csv").write_text("\r\n".join(rows).replace(",", apart), encoding="utf-8")
    (job,) = jobs_of(folder / "list.csv")
    assert (job.robot, job.recording, job.model.name) == ("x", "a/monday", "all.yaml")


def test_a_list_may_be_latin_1_and_another_encoding_is_an_error(folder):
    text = "robot,model,recording\nMüller,all.yaml,a/monday"
    (folder / "list.csv").write_text(text, encoding="latin-1")
    assert [job.robot for job in jobs_of(folder / "list.csv")] == ["Müller"]
    (folder / "list.csv").write_bytes(b"\x93\x00\xe8" + text.encode("latin-1"))
    with pytest.raises(DatasetError, match=r"list.csv: not a CSV table: it is not text"):
        jobs_of(folder / "list.csv")


def test_the_folder_of_results_is_no_robot(folder):
    jobs = jobs_of(folder)
    Rows(folder / "out").gather([])
    for name in ("fleet.json", "next_robot.yaml"):
        (folder / "out" / name).touch()
    assert jobs_of(folder) == jobs


def test_results_go_into_a_folder_of_their_own(folder):
    (folder / "b" / "saved.json").touch()
    for out, words in ((folder / "b", "contains recordings"), (folder / "all.yaml", "is a file")):
        with pytest.raises(FleetError, match=words):
            judge(folder, out, QUICK)


def test_an_unknown_effect_is_refused_before_work_begins(folder):
    for asked in (FleetOptions(effects=("backlsh",)), FleetOptions(also=("backlsh",))):
        with pytest.raises(ModelError, match="did you mean 'backlash'"):
            judge(folder, folder / "out", asked)
    assert not (folder / "out").exists()


def test_what_cannot_be_judged_is_a_row_with_its_reason(folder):
    (folder / "cut.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    stewart = fleets.ROOT / "bags" / "stewart_backlash"
    cases = {folder / "cut.mcap": "truncated", folder / "none": "no such", stewart: "leg1"}
    for data, words in cases.items():
        row, _ = judge_recording(Job("x", "y", folder / "all.yaml", data, 3.0), QUICK, "0")
        assert words in row["reason"]
        assert (row["robot"], row["recording"], row["time"]) == ("x", "y", 3.0)
        assert "verdict" not in row
    row, _ = judge_recording(Job("x", "y", folder / "no.yaml", BAG), QUICK, "0")
    assert "no.yaml: cannot be read" in row["reason"]


def test_a_worker_of_another_version_does_nothing(folder):
    with pytest.raises(FleetError, match=r"but 9\.9 is needed"):
        judge_recording(Job("x", "y", folder / "all.yaml", BAG), FleetOptions(version="9.9"), "0")


def test_other_inputs_make_another_hash(folder):
    job = Job("x", "y", folder / "all.yaml", BAG)
    others = [
        job.hash_inputs(QUICK),
        job.hash_inputs(FleetOptions(options=FitOptions(hold_out=0.5))),
        Job("z", "y", folder / "all.yaml", BAG).hash_inputs(QUICK),
        Job("x", "y", folder / "all.yaml", fleets.ROOT / "bags" / "delta_clean").hash_inputs(QUICK),
    ]
    (folder / "all.yaml").write_text(fleets.NOMINAL.read_text() + "\n")
    assert len({*others, job.hash_inputs(QUICK)}) == 5


# ----------------------------------------------------------------------------- evidence


def test_evidence_of_well_seen_parameters_is_the_inverse_of_their_covariance():
    few = ["*"], ["chain?.Lb", "chain?.La_x"]
    found = fit(new_model("delta54"), measured(0), hold_out=0, fix=few[0], free=few[1])
    told = Evidence.of(found)
    free = found.free
    birge = max(1.0, found.estimate.chi2_per_dof)
    covariance = found.estimate.covariance[np.ix_(free, free)]
    assert told.information @ covariance * birge == pytest.approx(np.eye(6), abs=1e-6)
    assert told.pull == pytest.approx(np.zeros(6))
    two = told.marginalise(["chain1.Lb", "chain3.Lb"])
    own = [told.names.index(name) for name in two.names]
    assert np.linalg.inv(two.information) == pytest.approx(birge * covariance[np.ix_(own, own)])


def test_evidence_is_without_the_tolerances_that_held_an_estimate():
    """With priors throughout and without any, the data say the same."""
    data = measured(0, n_poses=30)
    free, fix = ["chain?.Lb", "chain?.La_?"], ["*"]
    one, other = (
        Evidence.of(fit(new_model("delta54"), data, hold_out=0, fix=fix, free=free, prior=prior))
        for prior in (True, False)
    )
    assert np.abs(one.centre - other.centre).max() > 1e-9
    ones, others = (e.recentre(e.names, np.zeros(9), np.full(9, 1e-4)) for e in (one, other))
    scale = np.sqrt(np.diag(others.information))
    assert ones.information == pytest.approx(others.information, rel=0.05, abs=0.01 * scale.max())
    assert np.linalg.solve(ones.information, ones.pull) == pytest.approx(
        np.linalg.solve(others.information, others.pull), abs=0.05
    )


def test_evidence_about_other_numbers_is_the_same_likelihood():
    """Worked by hand: p = 3 +- 0.5 of which a prior of pull 2 was taken out, seen from 1 in 0.1."""
    told = Evidence(("p",), np.array([3.0]), np.array([[4.0]]), np.array([2.0]))
    seen = told.recentre(("q", "p"), np.array([0.0, 1.0]), np.array([1.0, 0.1]))
    assert seen.information == pytest.approx(np.diag([0.0, 0.04]))
    assert seen.pull == pytest.approx([0.0, (2.0 + 4.0 * 2.0) * 0.1])


# ----------------------------------------------------------------------------- clusters


def tables(folder):
    return (folder / "rows.parquet").read_bytes()


@pytest.mark.slow
def test_rows_are_equal_to_the_last_bit_on_this_machine_and_on_a_cluster(tmp_path):
    fleet = fleets.written(tmp_path / "fleet", vf.drawn(3), 2, n_poses=24, n_replicates=4)
    here = judge(fleet, tmp_path / "here", QUICK, workers=2)
    with cluster(tmp_path, 3) as other:
        judge(fleet, tmp_path / "there", QUICK, scheduler=other.address)
    assert tables(tmp_path / "here") == tables(tmp_path / "there")
    assert len(here.judged) == 6
    table = pq.read_table(tmp_path / "here" / "rows.parquet")
    assert table.column("robot").to_pylist() == [f"robot{k:03d}" for k in (0, 0, 1, 1, 2, 2)]
    assert table.schema.field("chain1.theta.sigma").metadata == {b"unit": b"rad"}
    lengths = np.array(table.column("chain1.Lb"))
    assert lengths == pytest.approx(np.full(6, 0.24), abs=2e-3)
    assert len(set(lengths)) == 6


@pytest.mark.wide
def test_a_killed_worker_costs_no_row(tmp_path):
    fleet = fleets.written(tmp_path / "fleet", vf.drawn(2), 2, n_poses=24, n_replicates=4)
    with cluster(tmp_path, 2, nanny=False) as workers:

        def kill_one(row):
            if workers.workers[0].poll() is None:
                workers.kill(workers.workers[0])

        found = judge(fleet, tmp_path / "out", QUICK, scheduler=workers.address, on_row=kill_one)
        assert workers.workers[0].poll() is not None
    assert [row["reason"] for row in found.rows] == [""] * 4


@pytest.mark.slow
def test_a_killed_scheduler_costs_no_row_that_was_done(tmp_path):
    fleet = fleets.written(tmp_path / "fleet", vf.drawn(2), 2, n_poses=24, n_replicates=4)
    with cluster(tmp_path, 1) as first:

        def kill_it(row):
            if first.scheduler.poll() is None:
                first.kill(first.scheduler)

        with pytest.raises(FleetError, match=r"scheduler is lost.*give the same command"):
            judge(fleet, tmp_path / "out", QUICK, scheduler=first.address, on_row=kill_it)
    kept = len(list((tmp_path / "out" / "recordings").glob("*.json")))
    assert 1 <= kept < 4
    begun = []
    again = judge(
        fleet, tmp_path / "out", QUICK, workers=1, progress=lambda stage, done: begun.append(done)
    )
    assert begun[0] == kept / 4
    assert len(again.judged) == 4


@pytest.mark.wide
def test_ctrl_c_and_kill_keep_the_rows_that_were_done(tmp_path):
    # So many that it cannot be done before it is told to end.
    fleet = fleets.written(tmp_path / "fleet", vf.drawn(2), 2, n_poses=24, n_replicates=4)
    words = ["fleet", str(fleet), "-o", str(tmp_path / "out"), "--workers", "1"]
    command = [sys.executable, "-m", "parallel_cal.cli", *words, "--effect", "backlash"]
    recordings = tmp_path / "out" / "recordings"
    for how, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
        before = len(list(recordings.glob("*.json")))
        process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
        while len(list(recordings.glob("*.json"))) == before and process.poll() is None:
            time.sleep(0.01)
        os.killpg(process.pid, how)
        said = process.communicate()[1].decode()
        assert process.returncode == code, said
        assert how == signal.SIGKILL or said.startswith("stopped; the finished work is kept")
        assert len(list(recordings.glob("*.json"))) > before
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True)
    document = json.loads(done.stdout)
    assert (document["recordings"], document["failed"]) == (4, [])


@pytest.mark.wide
def test_ctrl_c_while_workers_start_is_not_theirs_and_waits_for_them(monkeypatch):
    begin, masks = distributed.LocalCluster, []

    def interrupted(**options):
        signal.raise_signal(signal.SIGINT)
        local = begin(**options)
        with distributed.Client(local) as client:
            masks.extend(client.run(signal.pthread_sigmask, signal.SIG_BLOCK, []).values())
        return local

    monkeypatch.setattr(distributed, "LocalCluster", interrupted)
    with pytest.raises(KeyboardInterrupt), on_this_machine(None, 1):
        pytest.fail("interrupted")
    assert masks == [{signal.SIGINT}]
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.wide
def test_tests_receive_ctrl_c_though_a_shell_started_them_in_the_background():
    """`sh -c 'pytest &'` ignores SIGINT, and so would every process that a test starts."""
    code = (
        "import signal; before = signal.getsignal(signal.SIGINT); import conftest; "
        "print(before.name, signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    )
    in_background = '"$0" -c "$1" & wait $!'
    done = subprocess.run(
        ["sh", "-c", in_background, sys.executable, code],
        cwd=fleets.ROOT / "test",
        capture_output=True,
        text=True,
    )
    assert done.stdout == "SIG_IGN True\n", done.stderr


@pytest.mark.wide
def test_an_address_without_a_scheduler_or_without_workers_is_a_clear_error(folder, monkeypatch):
    monkeypatch.setattr("parallel_cal.fleet.cluster.SCHEDULER_TIMEOUT_S", 0.5)
    with pytest.raises(FleetError, match="no Dask scheduler answers"):
        judge(folder, folder / "out", QUICK, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(FleetError, match="--scheduler first: expected tcp://HOST:PORT"):
        judge(folder, folder / "out", QUICK, scheduler="first")
    with cluster(folder, 0) as idle, pytest.raises(FleetError, match="has no workers"):
        judge(folder, folder / "out", QUICK, scheduler=idle.address)


def test_without_the_extra_a_fleet_says_so_in_one_line(folder):
    code = (
        "import sys; sys.modules['distributed'] = None; from parallel_cal.cli.main import main; "
        f"main(['fleet', {str(folder)!r}])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == (
        "error: fleets and studies need distributed: pip install 'parallel_cal[fleet]'\n"
    )
