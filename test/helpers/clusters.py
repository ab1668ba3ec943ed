"""A Dask cluster on this machine, started as a user would: one scheduler, some workers."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path


class Cluster:
    """`dask scheduler` and `dask worker` processes, each of which can be killed."""

    def __init__(self, folder):
        self.file = Path(folder) / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0")
        while not self.file.exists() or not self.file.read_text().endswith("}"):
            time.sleep(0.05)
        self.address = json.loads(self.file.read_text())["address"]
        self.workers = []

    def add(self, n, nanny=True):
        self.workers += [
            self._start("worker", "--nthreads", "1", "--nanny" if nanny else "--no-nanny")
            for _ in range(n)
        ]

    def _start(self, what, *options):
        command = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self.file)]
        return subprocess.Popen(
            [*command, "--host", "127.0.0.1", *options, "--no-dashboard"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )

    def kill(self, process):
        """At once, with all that it started."""
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def end(self):
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                self.kill(process)


@contextmanager
def cluster(folder, workers=1, nanny=True):
    started = Cluster(folder)
    try:
        started.add(workers, nanny)
        yield started
    finally:
        started.end()
