"""A process beside a node for what may take long, take memory or crash; knows nothing of ROS.

The node's streams never wait for it: it has an interpreter of its own, a lower priority, a limit to
its memory, and is ended when its time is over. What is asked of it next starts another one.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.model.shelf import forbid_foreign

MEGABYTE = 1 << 20
START = 60.0  # s that a new process may take on a busy machine; not counted as work
POLITE = 5  # added to the process' niceness
PROMPT = 0.05  # s between two looks at whether the node ends


class OverBudget(ParallelCalError):
    """The time for a piece of work is over."""


class WorkError(ParallelCalError):
    """A piece of work failed, or ended the process that did it."""


class Worker:
    """Does one piece of work at a time; whoever comes meanwhile waits for its turn."""

    def __init__(self, memory: int, *modules: str, foreign: bool = True):
        """`memory` in MB; `modules` are imported while nobody waits for them yet, `foreign` ones
        only where that is true."""
        self._memory, self._modules, self._foreign = memory, modules, foreign
        self._turn, self._ended = Lock(), False
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self.ended_early = 0  # processes that were ended, or ended by themselves, before their work
        self._start()

    def _start(self) -> None:
        self._pipe, theirs = Pipe()
        # The same path as here, and nothing of the folder that the node happens to stand in.
        code = (
            f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; "
            f"serve({theirs.fileno()}, {self._memory}, {self._modules!r}, {self._foreign})"
        )
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        theirs.close()

    def work(
        self, seconds: float, make: Callable[..., Iterator[Any]], *given: Any
    ) -> Iterator[Any]:
        """What the generator `make(*given)` yields there, as it comes.

        OverBudget when the time is over, WorkError with what it raised or how its process ended.
        """
        with self._turn:
            if self._ended:
                raise WorkError("the node ends")
            if self._process is None:
                self._start()
            try:
                yield from self._parts(seconds, make, given)
            except (OverBudget, EOFError, OSError, GeneratorExit) as error:
                how = self._kill(patience=0.0 if isinstance(error, OverBudget) else 1.0)
                self.ended_early += 1
                if not self._ended:
                    self._start()
                if isinstance(error, (OverBudget, GeneratorExit)):
                    raise
                raise WorkError("the node ends" if self._ended else how) from None

    def _parts(
        self, seconds: float, make: Callable[..., Iterator[Any]], given: tuple[Any, ...]
    ) -> Iterator[Any]:
        assert self._pipe is not None
        self._pipe.send((make, given))
        end = time.monotonic() + START
        while True:
            left = end - time.monotonic()
            if left <= 0:
                raise OverBudget("over budget")
            if self._ended:
                raise EOFError
            if not self._pipe.poll(min(left, PROMPT)):
                continue
            kind, value = self._pipe.recv()
            if kind == "begun":
                end = time.monotonic() + seconds
                continue
            if kind == "failed":
                raise WorkError(value)
            if kind == "done":
                return
            yield value

    def _kill(self, patience: float = 0.0) -> str:
        """End the process, unless it does so itself (s); how it ended, in words."""
        assert self._process is not None
        assert self._pipe is not None
        self._pipe.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience)
        with_status = self._process.returncode
        self._process.kill()
        self._process.wait()
        self._process = None
        if with_status is None:
            return "the process that did the work was ended"
        if with_status < 0:
            return f"the process that did the work crashed ({signal.Signals(-with_status).name})"
        return f"the process that did the work ended with status {with_status}"

    def end(self) -> None:
        """Stop at once, whatever it does; who waits for it gets a WorkError."""
        self._ended = True
        process = self._process
        if process is not None:
            process.kill()
        with self._turn:
            if self._process is not None:
                self._kill()


def serve(descriptor: int, memory: int, modules: tuple[str, ...], foreign: bool) -> None:
    """The worker's side: do what comes down the pipe until the node is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the node, which ends its worker
    os.nice(POLITE)
    pipe = Connection(descriptor)
    parent = os.getppid()
    Thread(target=_end_with, args=(parent,), daemon=True).start()
    for name in modules:
        import_module(name)
    if not foreign:
        forbid_foreign()
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = taken + memory * MEGABYTE
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    while True:
        try:
            make, given = pipe.recv()
        except EOFError:
            return
        pipe.send(("begun", ""))
        pipe.send(_done(pipe, make, given))


def _done(
    pipe: Connection, make: Callable[..., Iterator[Any]], given: tuple[Any, ...]
) -> tuple[str, str]:
    try:
        for part in make(*given):
            pipe.send(("part", part))
    except ParallelCalError as error:
        return "failed", str(error)
    except MemoryError:
        return "failed", "it takes more memory than it may"
    except Exception as error:  # a user's own mechanism may raise anything
        return "failed", str(error) or type(error).__name__
    return "done", ""


def _end_with(parent: int) -> None:
    """A node that was killed tells nobody."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
