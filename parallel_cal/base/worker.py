"""A separate process for work that may take long, need much memory or crash.

It has its own interpreter, a lower priority and, on request, a memory limit, so that streams and
windows of this process stay responsive. It is stopped when its time is over or its work is no
longer wanted. The next work starts a new process.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from parallel_cal.base.errors import ParallelCalError

MEGABYTE = 1 << 20
STARTUP_TIMEOUT_S = 60.0  # s that a new process may take on a busy machine; not counted as work
NICENESS_INCREMENT = 5  # added to the process' niceness
POLL_INTERVAL_S = 0.05  # s between two looks at whether the work is still wanted


class TimeBudgetExceeded(ParallelCalError):
    """The time for a piece of work is over."""


class WorkCancelled(ParallelCalError):
    """A piece of work was stopped because it was no longer wanted."""


class WorkError(ParallelCalError):
    """A piece of work failed, or its process crashed."""


class Worker:
    """Does one piece of work at a time; other callers wait for their turn."""

    def __init__(self, memory: int | None = None, first: Callable[[], None] | None = None):
        """Create a worker; its process starts with its first work.

        `memory` is in MB, in addition to what the process has after `first`, which a new process
        runs before anything else.
        """
        self._memory, self._first = memory, first
        self._turn, self._ended = Lock(), False
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self.ended_early = 0  # number of processes that ended before their work did

    def _start(self) -> None:
        self._pipe, theirs = Pipe()
        # The new process imports from the same folders, not from the working folder.
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; "
            f"serve({theirs.fileno()}, {self._memory})"
        )
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        theirs.close()
        self._pipe.send(self._first)

    def work(
        self,
        function: Callable[..., Any],
        *given: Any,
        seconds: float = math.inf,
        tell: Callable[..., None] | None = None,
        wanted: Callable[[], bool] = lambda: True,
    ) -> Any:
        """Return the result of `function(*given)` in the process; arguments and result are pickled.

        With `tell`, the function gets a keyword argument `tell`, whose calls are forwarded to
        this one.

        Raises
        ------
        TimeBudgetExceeded
            If the work takes longer than `seconds`.
        WorkCancelled
            Soon after `wanted()` is False.
        WorkError
            With what the work raised, or how its process ended, or that it did not start.
        """
        with self._turn:
            if self._ended:
                raise WorkError("the node is shutting down")
            if self._process is None:
                self._start()
            try:
                return self._await_result(
                    (function, given, tell is not None), seconds, tell, wanted
                )
            except WorkError:
                raise
            except BaseException as error:
                crashed = isinstance(error, (EOFError, OSError))  # the process ended by itself
                how = self._kill(patience=1.0 if crashed else 0.0)
                self.ended_early += 1
                if not self._ended:
                    self._start()
                if crashed:
                    raise WorkError("the node is shutting down" if self._ended else how) from None
                raise

    def _await_result(
        self,
        asked: tuple[Any, ...],
        seconds: float,
        tell: Callable[..., None] | None,
        wanted: Callable[[], bool],
    ) -> Any:
        assert self._pipe is not None
        end, started = time.monotonic() + STARTUP_TIMEOUT_S, False
        while True:
            left = end - time.monotonic()
            if left <= 0 and not started:  # it goes on starting, for the next work
                raise WorkError(
                    f"the process for the work did not start within {STARTUP_TIMEOUT_S:g} s: the "
                    "computer is busy; try again"
                )
            if left <= 0:
                raise TimeBudgetExceeded("over budget")
            if not wanted():
                raise WorkCancelled("cancelled before it was done")
            if self._ended:
                raise EOFError
            if not self._pipe.poll(min(left, POLL_INTERVAL_S)):
                continue
            kind, value = self._pipe.recv()
            if kind == "ready":
                self._pipe.send(asked)
                end, started = time.monotonic() + seconds, True
            elif kind == "told" and tell is not None:
                tell(*value)
            elif kind == "failed":
                raise WorkError(value)
            elif kind == "done":
                return value

    def _kill(self, patience: float = 0.0) -> str:
        """Stop the process after `patience` (s); return how it ended, in words."""
        assert self._process is not None
        assert self._pipe is not None
        self._pipe.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience)
        status = self._process.returncode
        self._process.kill()
        self._process.wait()
        self._process = None
        if status is None:
            return "the process that did the work was stopped"
        if status < 0:  # minus the number of the signal
            return f"the process that did the work crashed ({signal.Signals(-status).name})"
        return f"the process that did the work ended with status {status}"

    def end(self) -> None:
        """Stop the process at once; a waiting caller gets a WorkError."""
        self._ended = True
        process = self._process
        if process is not None:
            process.kill()
        with self._turn:
            if self._process is not None:
                self._kill()


def serve(descriptor: int, memory: int | None) -> None:
    """Do the work from the pipe until the parent process is gone; this runs in the new process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends its worker
    os.nice(NICENESS_INCREMENT)
    pipe = Connection(descriptor)
    parent = os.getppid()
    Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()
    if first := pipe.recv():
        first()
    if memory is not None:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = taken + memory * MEGABYTE
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    while True:
        pipe.send(("ready", None))
        try:
            function, given, telling = pipe.recv()
        except (EOFError, ConnectionResetError):  # the other end is gone, or was killed
            return
        pipe.send(_execute(pipe, function, given, telling))


def _execute(
    pipe: Connection, function: Callable[..., Any], given: tuple[Any, ...], telling: bool
) -> tuple[str, Any]:
    def tell(*said: Any) -> None:
        pipe.send(("told", said))

    try:
        return "done", function(*given, **({"tell": tell} if telling else {}))
    except ParallelCalError as error:
        return "failed", str(error)
    except MemoryError:
        return "failed", "it needs more memory than its limit"
    except Exception as error:  # a user's own mechanism may raise anything
        return "failed", f"{type(error).__name__}: {error}"


def _exit_with_parent(parent: int) -> None:
    """Exit when the parent is gone: a killed parent cannot send a message."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
