"""Run independent parts of one computation on the cores of this machine."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from typing import Any, Protocol

PARTS_AHEAD_PER_CORE = 2  # parts that wait or are computed: more would only fill the memory


class Runner(Protocol):
    """Runs independent parts of one computation.

    `run(do, shared, items)` yields `do(shared, item)` of each item, in the order of the items. The
    results do not depend on the runner. Closing the iterator ends the work.
    """

    def __call__(
        self, do: Callable[[Any, Any], Any], shared: Any, items: Iterable[Any]
    ) -> Iterator[Any]: ...


def count_cores() -> int:
    """The number of cores to use: those that this process may use, unless OMP_NUM_THREADS states
    it, as for other libraries."""
    return int(os.environ.get("OMP_NUM_THREADS") or len(os.sched_getaffinity(0)))


def run_on_cores(do: Callable[[Any, Any], Any], shared: Any, items: Iterable[Any]) -> Iterator[Any]:
    """Run the parts in one thread per core: NumPy and CasADi compute outside of Python's lock."""
    cores = count_cores()
    if cores < 2:
        yield from (do(shared, item) for item in items)
        return
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(cores, thread_name_prefix="part") as pool:
        left, waiting = iter(items), deque[Any]()
        try:
            for item in left:
                waiting.append(pool.submit(do, shared, item))
                if len(waiting) >= PARTS_AHEAD_PER_CORE * cores:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def running(
    run: Runner, do: Callable[[Any, Any], Any], shared: Any, items: Iterable[Any]
) -> Iterator[Iterator[Any]]:
    """The results of a runner, whose work ends with the block, also if the block raises."""
    results = run(do, shared, items)
    with closing(results):  # type: ignore[type-var]
        yield results
