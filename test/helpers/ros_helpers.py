"""Nodes as processes on a domain of their own, and a client that hammers a service."""

import json
import signal
import subprocess
import sys
from contextlib import contextmanager
from threading import Event, Thread

from parallel_cal.nodes.client import Client, NodeError, Process

LONG = 240.0  # s that anything may take on a busy machine
STARTED = []  # every NodeProcess of this test process


class NodeProcess:
    """A node in a process of its own; ends by its id, and says how it ended."""

    def __init__(self, node, folder, namespace, *arguments, ros=(), before="", **parameters):
        self.node, self.log = node, folder / f"{node}{id(self)}.log"
        code = f"{before}\nimport sys; from parallel_cal.nodes.{node} import main; sys.exit(main())"
        ros = ["-r", f"__ns:={namespace}", *ros]
        for name, value in parameters.items():
            ros += ["-p", f"{name}:={json.dumps(value)}"]
        command = [sys.executable, "-c", code, *arguments, "--ros-args", *ros]
        with self.log.open("w") as output:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
            )
        STARTED.append(self)

    def kill(self):
        self._process.kill()
        self._process.wait()

    @property
    def said(self):
        return self.log.read_text()

    def check(self):
        """NodeError when it ended by itself with an error: what a client waits for never comes."""
        if self._process.poll():
            raise NodeError(f"{self.node} ended with {self._process.returncode}: {self.said}")

    def ended(self, patience=LONG):
        """Its exit status once it ends by itself."""
        return self._process.wait(timeout=patience)

    def end(self, by=signal.SIGINT):
        """Its exit status after a signal; a traceback is a failure whatever the status."""
        if self._process.poll() is None:
            self._process.send_signal(by)
        try:
            status = self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise
        finally:
            print(f"{self.node}:\n{self.said}")  # pytest shows it where the test fails
        assert "Traceback" not in self.said, self.said
        assert "never retrieved" not in self.said, self.said
        return status


@contextmanager
def calibrating(folder, namespace, **parameters):
    """A client beside a calibration node, which must end cleanly."""
    node = Process("calibration_node", folder, namespace, **parameters)
    client = Client("tester", namespace, [node])
    try:
        yield client
    finally:
        client.close()
        status = node.end()
    assert status == 0
    assert "Traceback" not in node.log.read_text()


class Hammer:
    """Calls one service again and again from a thread of its own; keeps (request, response)."""

    def __init__(self, namespace, type, name, requests):
        self.answers, self._error, self._stop = [], None, Event()
        self._work = (namespace, type, name, requests)
        self._thread = Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join(LONG)
        if self._error is not None:
            raise self._error

    def _run(self):
        namespace, type, name, requests = self._work
        client = Client("hammer", namespace, [])
        try:
            while not self._stop.is_set():
                fields = requests[len(self.answers) % len(requests)]
                self.answers.append((fields, client.call(type, name, **fields)))
        except Exception as error:
            self._error = error
        finally:
            client.close()
