"""`parallel-cal workbench` as a person starts it, and a real browser to look at it with."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
LONG = 240.0  # s that anything may take on a busy machine


def until(condition, what):
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def command(*arguments, port):
    """`parallel-cal workbench` as a person starts it."""
    code = "import sys; from parallel_cal.cli.main import main; main(sys.argv[1:])"
    given = [*arguments, "--port", port, "--no-open"]
    return [sys.executable, "-c", code, "workbench", *map(str, given)]


def beside_a_played_robot(folder, told, port):
    """The page on a session beside test/helpers/campaign_page.py's robot."""
    program = Path(__file__).with_name("campaign_page.py")
    return [sys.executable, str(program), str(folder), str(told), str(port)]


class Served:
    """A server of the page, by default `parallel-cal workbench`."""

    def __init__(self, *arguments, log=None, command=command):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        self.process = subprocess.Popen(
            command(*arguments, port=self.port),
            stderr=log or subprocess.DEVNULL,
            env={k: v for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST"},
        )
        until(self._answers, "the server's first answer")

    def _answers(self):
        assert self.process.poll() is None
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0

    def end(self, how=signal.SIGTERM):
        self.process.send_signal(how)
        self.process.wait(60)


@contextmanager
def opened():
    """A browser's context; skips where there is none."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
        one = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield one
        one.close()
