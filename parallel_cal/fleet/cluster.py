"""Run many jobs in parallel: on the cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from parallel_cal.base.parallel import Runner
from parallel_cal.base.threads import single_threaded
from parallel_cal.fleet.jobs import FleetError, FleetOptions, Job
from parallel_cal.fleet.judging import Page, Row, judge_recording

if TYPE_CHECKING:
    from distributed import Client, Future

SCHEDULER_TIMEOUT_S = 15  # s to wait for a scheduler to answer, and for its first worker
EXTRA = ("dask", "distributed", "pyarrow")
KILLED_WORKER_REASON = "it ended its worker several times: does the worker have enough memory?"


def check_extra_installed() -> None:
    """Raise FleetError if the libraries for fleets are not installed."""
    if missing := [name for name in EXTRA if find_spec(name) is None]:
        raise FleetError(
            f"fleets and studies need {' and '.join(missing)}: pip install 'parallel_cal[fleet]'"
        )


@contextmanager
def cluster(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """Connect to the cluster at an address, or start one process per core on this machine.

    Raises FleetError if no scheduler answers or if it has no workers.
    """
    from distributed import Client, LocalCluster
    from distributed.utils import LoopRunner

    for name in ("distributed", "distributed.client"):  # we report every fault ourselves
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler is None:
        with ExitStack() as here:
            with _without_ctrl_c():
                local = here.enter_context(
                    LocalCluster(
                        n_workers=workers or len(os.sched_getaffinity(0)),
                        threads_per_worker=1,
                        silence_logs=logging.CRITICAL,
                        dashboard_address="127.0.0.1:0",
                    )
                )
                client = here.enter_context(Client(local))
            yield client
        return
    try:
        LoopRunner().run_sync(_check_reachable, scheduler)
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S)
    except (ValueError, TypeError) as error:  # not an address, or TLS without certificates
        raise FleetError(f"--scheduler {scheduler}: expected tcp://HOST:PORT ({error})") from None
    except OSError as error:
        raise FleetError(
            f"{scheduler}: no Dask scheduler answers ({type(error).__name__}). Start one with "
            "'dask scheduler', and 'dask worker' with its address"
        ) from None
    try:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT_S)
        except TimeoutError:
            raise FleetError(
                f"{scheduler} has no workers: start 'dask worker {scheduler} --nthreads 1 "
                "--nworkers -1' on each machine on which parallel_cal is installed"
            ) from None
        yield client
    finally:
        client.close(timeout=1)


async def _check_reachable(scheduler: str) -> None:
    """Raise OSError if no scheduler answers.

    A Client would raise as well, but leave itself half started; closing it while another starts
    blocks forever."""
    from distributed.comm import connect
    from distributed.security import Security

    known = Security().get_connection_args("client")
    await (await connect(scheduler, timeout=SCHEDULER_TIMEOUT_S, **known)).close()


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Shield threads and processes that start meanwhile from Ctrl-C; receive it afterwards."""
    # Starting the resource tracker unblocks the signal again, so start it before.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def results(
    client: Client, jobs: Sequence[tuple[Job, str]], asked: FleetOptions, page: Page | None
) -> Iterator[tuple[Row, str]]:
    """Yield rows and pages as they are finished, in no order.

    A recording whose worker was killed yields a row with that reason."""
    calls = [(job, asked, inputs, page if job.last else None) for job, inputs in jobs]
    for k, answer in run_each(client, judge_recording, calls):
        job, inputs = jobs[k]
        yield answer or (
            {
                "robot": job.robot,
                "recording": job.recording,
                "inputs": inputs,
                "time": job.time,
                "reason": KILLED_WORKER_REASON,
                "seconds": None,
            },
            "",
        )


def run_each(
    client: Client, do: Callable[..., Any], calls: Sequence[tuple[Any, ...]]
) -> Generator[tuple[int, Any], None, None]:
    """Yield the number and the result of every call as it is finished, in no order.

    The result is None if the call killed its workers repeatedly. Closing the iterator cancels the
    calls that are left. Raises FleetError if the scheduler is lost or if a worker cannot run the
    call."""
    futures: dict[Future, int] = {
        client.submit(do, *call, pure=False): k for k, call in enumerate(calls)
    }
    try:
        yield from _collect(futures)
    except GeneratorExit:
        client.cancel(list(futures))
        raise


def _collect(futures: dict[Future, int]) -> Iterator[tuple[int, Any]]:
    """Yield the number and the result of every future as it is finished, and remove it."""
    from distributed import KilledWorker, as_completed

    for future in as_completed(list(futures)):
        k = futures.pop(future)
        if future.status == "finished":
            try:
                answer = future.result()
            except Exception:  # computed, but the connection to the result is lost
                raise _make_lost_error() from None
            yield k, answer
        elif future.status == "error" and isinstance(future.exception(), KilledWorker):
            yield k, None
        elif future.status == "error":
            error = future.exception()
            raise FleetError(
                f"a worker cannot do this task ({type(error).__name__}: {error}): workers "
                "need the same version of parallel_cal"
            )
        else:
            raise _make_lost_error()
        future.release()


def run_on_cluster(client: Client) -> Runner:
    """Run the parts of one computation, such as `discover`, on the workers of a cluster.

    FleetError if a part ends its worker repeatedly."""

    def run(do: Callable[[Any, Any], Any], shared: Any, items: Iterable[Any]) -> Iterator[Any]:
        (sent,) = client.scatter([shared], broadcast=True, hash=False)
        calls = [(do, sent, item) for item in items]
        results: dict[int, Any] = {}
        following = 0
        with closing(run_each(client, _compute_part, calls)) as finished:
            for k, answer in finished:
                if answer is None:
                    raise FleetError(f"part {k + 1} of {len(calls)}: {KILLED_WORKER_REASON}")
                (results[k],) = answer
                while following in results:
                    yield results.pop(following)
                    following += 1

    return run


@single_threaded()
def _compute_part(do: Callable[[Any, Any], Any], shared: Any, item: Any) -> tuple[Any]:
    """The result of a part, which may be None, as a tuple."""
    return (do(shared, item),)


def _make_lost_error() -> FleetError:
    return FleetError(
        "the connection to the scheduler is lost. Start the scheduler again, and "
        "give the same command: finished results in its folder are not computed "
        "again"
    )
