"""One BLAS thread in every test: results do not change, and workers do not fight for cores.

Nodes keep their journals out of the home folder, and the page what it remembers of its user. Ctrl-C
reaches the tests however they are started. Tests and helpers import each other by name, whichever
folder they are in.
"""

import gc
import os
import signal
import sys
import tempfile
from copy import deepcopy
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, and nothing stored on disk; more of them where wide tests run,
# and most in `make nightly`.
settings.register_profile("quick", deadline=None, derandomize=True, database=None, max_examples=30)
settings.register_profile("wide", settings.get_profile("quick"), max_examples=100)
settings.register_profile("nightly", settings.get_profile("quick"), max_examples=1000)


def pytest_configure(config):
    marks = config.getoption("markexpr", "")
    if not marks or "not wide" in marks:
        settings.load_profile("quick")
    else:
        settings.load_profile("wide" if "wide" in marks or "not slow" in marks else "nightly")


def pytest_collection_finish():
    """What stands now stays: the collector of garbage need not go through it again and again."""
    gc.collect()
    gc.freeze()


def pytest_ignore_collect(collection_path, config):
    """To start the tests that start nodes, the few files that have some need to be imported."""
    terms = config.getoption("markexpr", "").split(" and ")
    if "ros" not in terms or not collection_path.match("test_*.py"):
        return None
    return None if "mark.ros" in collection_path.read_text() else True


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config, items):
    for path in {item.path for item in items if item.get_closest_marker("ros")}:
        if "mark.ros" not in path.read_text():
            raise pytest.UsageError(f"{path}: `pytest -m ros` would not find a test of mark.ros")
    yield  # the tests that the marks deselect are gone
    if hasattr(config, "workerinput"):
        from longest_first import sort_by_duration

        sort_by_duration(items)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup():
    """No node of a fixture that fails is left running: it would load the machine until the end, and
    answer the tests that follow."""
    started = _list_started_nodes()
    count = len(started)
    try:
        return (yield)
    except BaseException:
        _end(started[count:])
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    started = _list_started_nodes()
    count = len(started)
    try:
        return (yield)
    finally:
        item.started_nodes = started[count:]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    """Nor is one that a test started itself and its fixtures do not end, such as that of a test
    that is skipped where a browser lacks."""
    try:
        return (yield)
    finally:
        _end(getattr(item, "started_nodes", []))


def _list_started_nodes():
    helpers = sys.modules.get("ros_helpers")
    return helpers.STARTED if helpers else []


def _end(nodes):
    for node in nodes:
        node.kill()


sys.path[:0] = map(str, sorted(Path(__file__).parent.glob("*/")))

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# A shell without job control ignores SIGINT for its background jobs ("make check &"), and every
# child of such a job inherits that. Tests that send SIGINT would then wait for nothing.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def bags_are_read_once():
    """Many tests load the same few bags: each reads a copy of what the first one read, as long as
    the files are the same. Tests of the reader itself call `read_bag`, which keeps nothing."""
    from parallel_cal.recordings import loading

    read, kept = loading.read_bag, {}

    def read_once(path, options=None, progress=None):
        root = Path(path)
        files = sorted(root.rglob("*")) if root.is_dir() else [root]
        stats = [(str(f), f.stat()) for f in files if f.exists()]
        state = [(name, s.st_ino, s.st_mtime_ns, s.st_size) for name, s in stats]
        asked = None
        if options:  # of the robot, the names decide what is read
            names = (options.joint_names, options.passive_joints)
            asked = (names, repr(options.with_values(mechanism=None)))
        key = (os.getcwd(), str(path), asked, *state)
        if key not in kept:
            found = read(path, options, progress)
            if len(kept) >= 32:  # bags that a test wrote for itself
                kept.pop(next(iter(kept)))
            kept[key] = found
        return deepcopy(kept[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loading, "read_bag", read_once)
        yield


@pytest.fixture
def run_cli(capsys):
    """What the command line prints in this process, which must end well."""
    from parallel_cal.cli.main import main

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main([str(a) for a in arguments])
        assert not stopped.value.code
        return capsys.readouterr().out

    return run


@pytest.fixture(scope="session", autouse=True)
def temporary_folders(tmp_path_factory):
    """Temporary files, logs and states of all tests, and of the programs that they start, lie where
    pytest removes them."""
    tempfile.tempdir = os.environ["TMPDIR"] = str(tmp_path_factory.mktemp("t"))
    os.environ["ROS_HOME"] = tempfile.mkdtemp(prefix="ros_home")
    os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="state")
