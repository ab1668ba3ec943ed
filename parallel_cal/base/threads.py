"""Limit linear algebra to one thread: on small matrices a second thread costs more than it saves.

It costs much more while other processes run: threads of OpenBLAS wait for each other by spinning,
and a solve of 0.1 ms then takes a whole time slice of the processor.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

# The number of BLAS threads belongs to the process, not to a Python thread: the first caller limits
# it, and the last one to leave restores it.
_lock = Lock()
_inside = 0
_limits: list[Any] = []
_modules = 0  # number of loaded modules at the last search for BLAS libraries ...
_libraries: Any = None  # ... and the controller of those that were found


@contextmanager
def single_threaded() -> Iterator[None]:
    """Use one BLAS thread, as a context or as a decorator of a public function; then restore.

    Entering takes tens of microseconds, or one inside another one; a millisecond if modules were
    loaded since. Use it for a fit or a diagnosis, not for the direct problem of one pose.
    """
    _enter()
    try:
        yield
    finally:
        _leave()


def _enter() -> None:
    global _inside, _modules, _libraries
    with _lock:
        # Modules loaded since then, such as SciPy's, may have brought another BLAS.
        found = _modules != len(sys.modules)
        if found or not _inside:
            from threadpoolctl import ThreadpoolController

            _let_any_thread_set_limits()
            _libraries = ThreadpoolController() if found or _libraries is None else _libraries
            _limits.append(_libraries.limit(limits=1))
            _let_any_thread_set_limits()
            _modules = len(sys.modules)
        _inside += 1


def _leave() -> None:
    global _inside
    with _lock:
        _inside -= 1
        if _inside:
            return
        _let_any_thread_set_limits()
        while _limits:  # the latest first: it recorded the limits that earlier ones had set
            _limits.pop().restore_original_limits()
        _let_any_thread_set_limits()


def _let_any_thread_set_limits() -> None:
    """Let the present thread set limits.

    Since version 3.8, threadpoolctl silently ignores every thread except the first that set a
    limit, but another thread may restore ours. The lock of the callers prevents conflicts.
    """
    from threadpoolctl import OpenBLASController

    if hasattr(OpenBLASController, "clear_controlling_thread"):
        OpenBLASController.clear_controlling_thread(force=True)
