"""One BLAS thread in every test: results do not change, and workers do not fight for cores.

Nodes keep their journals out of the home folder, and the page what it remembers of its user. Ctrl-C
reaches the tests however they are started. Tests and helpers import each other by name, whichever
folder they are in.
"""

import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, and nothing stored on disk; more of them where wide tests run,
# and most in `make nightly`.
settings.register_profile("quick", deadline=None, derandomize=True, database=None, max_examples=30)
settings.register_profile("wide", settings.get_profile("quick"), max_examples=200)
settings.register_profile("nightly", settings.get_profile("quick"), max_examples=1000)


def pytest_configure(config):
    marks = config.getoption("markexpr", "")
    if not marks or "not wide" in marks:
        settings.load_profile("quick")
    else:
        settings.load_profile("wide" if "wide" in marks else "nightly")


def pytest_ignore_collect(collection_path, config):
    """To start the tests that start nodes, the few files that have some need to be imported."""
    terms = config.getoption("markexpr", "").split(" and ")
    if "ros" not in terms or not collection_path.match("test_*.py"):
        return None
    return None if "mark.ros" in collection_path.read_text() else True


def pytest_collection_modifyitems(items):
    for path in {item.path for item in items if item.get_closest_marker("ros")}:
        if "mark.ros" not in path.read_text():
            raise pytest.UsageError(f"{path}: `pytest -m ros` would not find a test of mark.ros")


sys.path[:0] = map(str, sorted(Path(__file__).parent.glob("*/")))

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# A shell without job control ignores SIGINT for its background jobs ("make check &"), and every
# child of such a job inherits that. Tests that send SIGINT would then wait for nothing.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


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


os.environ["ROS_HOME"] = tempfile.mkdtemp(prefix="ros_home")
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="state")
