"""One BLAS thread inside every public entry, and afterwards as many as the process had before."""

import contextlib
import signal
import subprocess
import sys
from functools import partial
from threading import Barrier, Thread
from types import FunctionType

import fleets
import numpy as np
import pytest
import scipy.optimize  # brings a BLAS of its own, which is to be limited, too
from datasets import measured
from marks import keep
from threadpoolctl import ThreadpoolController, threadpool_limits

import parallel_cal as pc
from parallel_cal.base import threads
from parallel_cal.base.worker import Worker
from parallel_cal.exporting.export import export
from parallel_cal.fleet.jobs import FleetOptions, Job
from parallel_cal.fleet.judging import judge_recording
from parallel_cal.identification.noise_floor import noise_floor
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.planning.plan import expected_at
from parallel_cal.reporting.report import report_of
from parallel_cal.study import session as study
from parallel_cal.study.tolerance import tolerances
from parallel_cal.virtual import robot as vr

BLAS = ThreadpoolController().select(user_api="blas")
PATCHED = "cholesky eig eigh inv lstsq pinv qr solve svd".split()
MODEL = pc.read_model(fleets.NOMINAL)
TRIED = ["backlash", "device_axes"]


def blas_threads():
    """How many threads each BLAS of this process may use."""
    return {library.num_threads for library in BLAS.lib_controllers}


@pytest.fixture
def solves(monkeypatch):
    """Threads at every call of NumPy's linear algebra, in a process that allows two."""
    counts = []

    def recorded(function, *args, **options):
        counts.append(blas_threads())
        return function(*args, **options)

    for name in PATCHED:
        monkeypatch.setattr(np.linalg, name, partial(recorded, getattr(np.linalg, name)))
    with threadpool_limits(2, user_api="blas"):
        assert blas_threads() == {2}
        yield counts


@pytest.fixture(scope="module")
def data():
    return measured(0, effects=[vr.Backlash((0.6e-3, 0.5e-3, 0.4e-3))])


@pytest.fixture(scope="module")
def backlash(data):
    return pc.add(MODEL, "backlash", data)


@pytest.fixture(scope="module")
def diagnosis(data):
    return pc.diagnose(MODEL, data, effects=TRIED)


def check_one_thread(solves):
    assert solves, "nothing was solved: the test sees nothing"
    assert set().union(*solves) == {1}
    assert blas_threads() == {2}


def test_without_an_entry_the_process_solves_with_its_own_number_of_threads(solves):
    np.linalg.solve(np.eye(2), np.ones(2))
    assert solves == [{2}]


@pytest.mark.wide
@pytest.mark.parametrize(
    "call",
    [
        lambda data: pc.fit(MODEL, data, hold_out=0),
        lambda data: pc.add(MODEL, "backlash", data),
        lambda data: pc.add(MODEL, "backlash", data, loss="huber"),
        lambda data: pc.diagnose(MODEL, data, effects=TRIED),
        lambda data: pc.report(MODEL, data, effects=TRIED, against=pc.new_model("delta54")),
        lambda data: pc.compare(MODEL, data).noise,
        lambda data: noise_floor(MODEL, pc.compare(MODEL, data).observations),
        lambda data: pc.plan(MODEL, 20, pool=60),
        lambda data: expected_at(MODEL, data.q),
        lambda data: tolerances(MODEL, robots=2, poses=4),
    ],
    ids=(
        "fit add add_robust diagnose report compare noise_floor plan expected_at tolerances"
    ).split(),
)
def test_a_function_of_the_library_solves_with_one_thread(call, data, solves):
    call(data)
    check_one_thread(solves)


@pytest.mark.parametrize(
    "part", ["field", "residual_profiles", "regions", "structure", "odd_samples"]
)
def test_what_a_comparison_computes_when_it_is_asked_is_solved_with_one_thread(part, data, solves):
    compared = pc.compare(MODEL, data)
    solves.clear()
    getattr(compared, part)
    check_one_thread(solves)


def test_what_a_step_computes_when_it_is_asked_is_solved_with_one_thread(backlash, solves):
    backlash.__dict__.pop("platform_shift", None)
    backlash.result.__dict__.pop("noise_floor", None)
    backlash.result.__dict__.pop("budgets", None)
    backlash.document()
    pc.show(backlash)
    check_one_thread(solves)


def test_an_effect_is_taken_out_with_one_thread(backlash, data, solves):
    pc.remove(backlash.model, "backlash", data, force=True)
    check_one_thread(solves)


def test_a_page_is_drawn_with_one_thread(diagnosis, solves):
    pc.page(report_of(diagnosis, {}), library="here.js")
    check_one_thread(solves)


@pytest.mark.wide
def test_what_a_dask_worker_is_sent_solves_with_one_thread(solves):
    recording = fleets.ROOT / "bags" / "delta_backlash"
    job, asked = Job("a", "monday", fleets.NOMINAL, recording), FleetOptions(effects=("backlash",))
    row, _ = judge_recording(job, asked, "inputs")
    assert not row["reason"]
    check_one_thread(solves)
    planned = pc.load_dataset(recording)
    question = study.Question(dump_model(MODEL), planned)
    assert not study.diagnose_session(question, study.PlantedEffect("", 0.0, 0))["reason"]
    check_one_thread(solves)


@pytest.mark.wide
@pytest.mark.parametrize(
    "command", keep(["compare", "fit", "diagnose", "add", "report"], "compare", "fit", "report")
)
def test_a_command_solves_with_one_thread(command, run_cli, data, solves, tmp_path):
    samples, model = tmp_path / "samples.json", fleets.NOMINAL
    data.to_json(samples)
    output = ["-o", tmp_path / "out"] if command in ("fit", "add", "report") else []
    if command == "report":
        output[1] = tmp_path / "out.html"
    effect = ["backlash"] if command == "add" else []
    run_cli(command, model, *effect, samples, *output)
    check_one_thread(solves)


def test_a_firmwares_numbers_are_fitted_with_one_thread(solves, tmp_path, monkeypatch):
    fitted = scipy.optimize.least_squares

    def recorded(*args, **options):
        solves.append(blas_threads())
        return fitted(*args, **options)

    monkeypatch.setattr(scipy.optimize, "least_squares", recorded)
    export(pc.new_model("linear_delta"), "klipper", tmp_path)
    check_one_thread(solves)


@pytest.mark.wide
def test_a_worker_process_begins_with_one_thread():
    worker = Worker()
    try:
        assert worker.work(blas_threads) == {1}
    finally:
        worker.end()


@pytest.mark.ros
def test_a_node_lives_with_one_thread(solves, monkeypatch):
    from parallel_cal.nodes.run import run

    monkeypatch.setattr(signal, "signal", lambda *_: None)  # pytest's own handler stays
    monkeypatch.setattr(sys, "setswitchinterval", lambda _: None)

    counts = []

    def make():
        counts.append(blas_threads())
        raise pc.ParallelCalError("no node is wanted")

    assert run(make, []) == 1
    assert counts == [{1}]
    assert blas_threads() == {2}


NO_LINEAR_ALGEBRA = {
    "figure",  # draws what others computed
    "load_dataset",  # it hands on to one that is limited
    "model_hash",
    "new_model",
    "read_model",
    "show",
    "write_bag",
    "write_model",
}


def is_limited(function):
    """Whether one of the wrappers of a function is that of a context, which is the limit's; the
    others check arguments."""
    while hasattr(function, "__wrapped__"):
        if function.__code__.co_filename == contextlib.__file__:
            return True
        function = function.__wrapped__
    return False


def test_every_function_at_the_packages_door_is_limited_or_known_to_solve_nothing():
    functions = {name: getattr(pc, name) for name in pc.__all__}
    free = {
        name
        for name, function in functions.items()
        if isinstance(function, FunctionType) and not is_limited(function)
    }
    assert free | {"figure", "show"} == NO_LINEAR_ALGEBRA


def test_one_pose_is_solved_without_looking_for_libraries(monkeypatch):
    """That takes longer than the pose."""
    kinematics = pc.Kinematics(MODEL)
    home = MODEL.mechanism.home
    monkeypatch.setattr(threads, "_enter", lambda: pytest.fail("libraries were looked for"))
    there = kinematics.direct(np.array(home.joints)[None])
    kinematics.inverse(there.position, there.rotation)


# --------------------------------------------------------------------------- the limit itself


def test_an_error_restores_the_number_of_threads(solves):
    @threads.single_threaded()
    def fail():
        assert blas_threads() == {1}
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert blas_threads() == {2}


def test_an_entry_inside_of_another_restores_nothing_yet(solves):
    with threads.single_threaded():
        with threads.single_threaded():
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_the_last_of_two_threads_at_once_restores_the_number(solves):
    """Each alone would restore what it found: the second one thread, for good. A third, this one,
    has set a limit, so that threadpoolctl ignores those that the two set."""
    both_inside, first_outside, seen = Barrier(2), Barrier(2), []

    def first():
        with threads.single_threaded():
            both_inside.wait(10)
        first_outside.wait(10)

    def second():
        with threads.single_threaded():
            both_inside.wait(10)
            first_outside.wait(10)
            seen.append(blas_threads())

    running = [Thread(target=first), Thread(target=second)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()
    assert seen == [{1}]
    assert blas_threads() == {2}


@pytest.mark.wide
def test_a_library_that_is_loaded_inside_is_limited_from_the_next_entry_on():
    code = (
        "import numpy\n"
        "from threadpoolctl import threadpool_info, threadpool_limits\n"
        "from parallel_cal.base.threads import single_threaded\n"
        "count = lambda: [one['num_threads'] for one in threadpool_info()]\n"
        "threadpool_limits(2)\n"
        "with single_threaded():\n"
        "    before = count()\n"
        "    import scipy.linalg\n"
        "    threadpool_limits({one['prefix']: 2 for one in threadpool_info()})\n"
        "    with single_threaded():\n"
        "        inside = count()\n"
        "after = count()\n"
        "print(before, inside, set(after))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[1] [1, 1] {2}"
