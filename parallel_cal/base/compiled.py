"""Call CasADi functions on NumPy arrays in place, and compile them to cached machine code."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from threading import Lock

import casadi as ca
import numpy as np

from parallel_cal.base.files import cache_folder
from parallel_cal.base.parallel import count_cores

log = logging.getLogger(__name__)

BATCH_SIZE = 512  # samples that one call of compiled code takes
EARLIER = 100  # times fewer samples pay for looking whether compiled code is there
MIN_SAMPLES_PER_CORE = 10_000  # with fewer samples, another thread costs more than it saves
# In a larger function the search for common subexpressions takes longer than it saves.
MAX_INSTRUCTIONS_FOR_CSE = 10_000
# -fno-semantic-interposition lets the compiler inline CasADi's helpers for x * x and |x|.
# -ffp-contract=off makes a loop round a product exactly as the same code outside it.
FLAGS = ("-O2", "-fPIC", "-shared", "-fno-semantic-interposition", "-ffp-contract=off")


class Single:
    """A function of vectors that is called through one buffer: microseconds a call, thread-safe.

    A thread that holds the `lock` may fill `arguments` and `evaluate` into `results` in place. The
    `arguments` may be arrays that another function reads or writes: then nothing is copied.
    `output` is the memory of all results, one after the other.
    """

    def __init__(self, function: ca.Function, arguments: Sequence[np.ndarray] = ()):
        self._buffer, self.evaluate = function.buffer()
        self.lock = Lock()
        sizes = range(function.n_in())
        self.arguments = list(arguments) or [np.zeros(function.numel_in(i)) for i in sizes]
        ends = np.cumsum([function.numel_out(i) for i in range(function.n_out())])
        self.output = np.zeros(ends[-1])
        self.results = np.split(self.output, ends[:-1])
        for i, array in enumerate(self.arguments):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self.results):
            self._buffer.set_res(i, array.data)

    def __call__(self, *arguments: np.ndarray | Sequence[float]) -> list[np.ndarray]:
        """Return the outputs as flat arrays (column-major if the function returns a matrix)."""
        with self.lock:
            for array, argument in zip(self.arguments, arguments, strict=True):
                array[:] = argument
            self.evaluate()
            return [array.copy() for array in self.results]


class Batch:
    """A function of vectors evaluated on N samples: (N, size) arrays in and out.

    Samples are evaluated in chunks of fixed sizes, in place: nothing is built, copied or converted
    for a new N. Large batches are spread over the cores. Each sample is computed separately, so the
    result does not depend on N. A function is compiled after so many samples (`compile_after`;
    never if it is None), or loaded much earlier if another process has compiled it.
    """

    SIZES = (BATCH_SIZE, 64, 16, 4, 1)

    def __init__(self, function: ca.Function, compile_after: int | None = None):
        self.function = function
        self._many: ca.Function | None = None
        self._chunks: dict[tuple[int, int, tuple[int, ...]], _Chunk] = {}
        self._lock = Lock()
        self._evaluated = 0
        # Numbers of samples after which to look for compiled code, and whether to compile it.
        self._awaited = list[tuple[int, bool]]()
        if compile_after is not None:
            self._awaited = [(compile_after // EARLIER, False), (compile_after, True)]
        self._use_machine_code(0)

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Evaluate the samples; each argument is (N, size), or (size,) for all samples."""
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
        n = next(len(a) for a in given if a.ndim == 2)
        room = -(-n // self.SIZES[-1]) * self.SIZES[-1]
        out = [np.empty((room, self.function.numel_out(i))) for i in range(self.function.n_out())]
        with self._lock:
            self._use_machine_code(n)
            self._evaluated += n
            cores = min(count_cores(), n // MIN_SAMPLES_PER_CORE)
            if cores < 2:
                self._evaluate_range(0, given, out, 0, n)
            else:
                from concurrent.futures import ThreadPoolExecutor

                share = -(-n // (cores * self.SIZES[0])) * self.SIZES[0]
                with ThreadPoolExecutor(cores) as pool:
                    parts = [
                        pool.submit(
                            self._evaluate_range, i, given, out, begin, min(begin + share, n)
                        )
                        for i, begin in enumerate(range(0, n, share))
                    ]
                for part in parts:
                    part.result()
        return [array[:n] for array in out]

    def _use_machine_code(self, n: int) -> None:
        """Load or compile the function if enough samples were evaluated, or n more are enough."""
        while self._awaited and max(self._evaluated, n) >= self._awaited[0][0]:
            _, may_compile = self._awaited.pop(0)
            plain = self.function
            code = _load_external(plain, plain, may_compile)
            if code is not plain:
                # One library contains the function for one sample and for BATCH_SIZE samples.
                self.function, self._many = code, _load_external(plain, _map_function(plain))
                self._awaited, self._chunks = [], {}

    def _evaluate_range(
        self, core: int, given: list[np.ndarray], out: list[np.ndarray], begin: int, end: int
    ) -> None:
        """Evaluate the samples from `begin` to `end` with the buffers of this core."""
        f = self.function
        shared = tuple(i for i, a in enumerate(given) if a.ndim == 1)
        while begin < end:
            size = next((s for s in self.SIZES if end - begin >= s), self.SIZES[-1])
            key = core, size, shared
            if key not in self._chunks:
                if self._many is not None and (size, shared) == (BATCH_SIZE, _shared_by_all(f)):
                    many = self._many
                else:
                    many = f.map(f"many{size}", "serial", size, list(shared), [])
                self._chunks[key] = _Chunk(many)
            rows = [a if a.ndim == 1 else _rows(a, begin, size) for a in given]
            self._chunks[key](rows, [a[begin : begin + size] for a in out])
            begin += size


class _Chunk:
    """A function that is called on arrays in place."""

    def __init__(self, function: ca.Function):
        self._buffer, self._evaluate = function.buffer()

    def __call__(self, given: list[np.ndarray], out: list[np.ndarray]) -> None:
        for i, array in enumerate(given):
            self._buffer.set_arg(i, array.reshape(-1).data)
        for i, array in enumerate(out):
            self._buffer.set_res(i, array.reshape(-1).data)
        self._evaluate()


def _rows(array: np.ndarray, begin: int, size: int) -> np.ndarray:
    """Return `size` rows from `begin`, filled with zeros behind the end of the array."""
    rows = array[begin : begin + size]
    if len(rows) == size:
        return rows
    padded = np.zeros((size, array.shape[1]))
    padded[: len(rows)] = rows
    return padded


def dense(name: str, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> ca.Function:
    """Create a function with dense outputs; share common parts if it is small."""
    plain = ca.Function(name, list(inputs), [ca.densify(o) for o in outputs])
    if plain.n_instructions() > MAX_INSTRUCTIONS_FOR_CSE:
        return plain
    return ca.Function(name, list(inputs), [ca.densify(o) for o in ca.cse(list(outputs))])


def compile_function(function: ca.Function) -> ca.Function:
    """Return the function as machine code; unchanged if it cannot be compiled or loaded."""
    return _load_external(function, function)


def _shared_by_all(function: ca.Function) -> tuple[int, ...]:
    """The argument that all samples of a batch share: the last one, of several."""
    return (function.n_in() - 1,) if function.n_in() > 1 else ()


def _map_function(function: ca.Function) -> ca.Function:
    """Map the function over BATCH_SIZE samples."""
    name = f"{function.name()}_many"
    return function.map(name, "serial", BATCH_SIZE, list(_shared_by_all(function)), [])


def _load_external(
    function: ca.Function, wanted: ca.Function, may_compile: bool = True
) -> ca.Function:
    """Return `wanted` from the compiled library of `function`; unchanged if there is none, and it
    cannot or may not be compiled."""
    if os.environ.get("PARALLEL_CAL_COMPILE") == "never":
        return wanted
    try:
        text = f"{ca.__version__} {os.uname().machine} {FLAGS} {function.serialize()}"
        fingerprint = hashlib.sha256(text.encode()).hexdigest()[:32]
        library = cache_folder() / f"{fingerprint}.so"
        if not library.exists():
            if not may_compile:
                return wanted
            _compile(function, library)
        return ca.external(wanted.name(), str(library))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        # No compiler, no home folder, no permission, or a cache from another machine.
        log.info("no compiled code for %s (%s); CasADi's virtual machine is used", wanted, error)
        return wanted


def _compile(function: ca.Function, library: Path) -> None:
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc")
    if compiler is None:
        raise FileNotFoundError("no C compiler")
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        # CasADi writes its C file into the given folder; the name carries no directory.
        code = ca.CodeGenerator("code.c")
        code.add(function)
        code.add(_map_function(function))  # a loop over the same code
        code.generate(f"{folder}{os.sep}")
        built = Path(folder, "code.so")
        command = [compiler, *FLAGS, f"{folder}/code.c", "-o", str(built), "-lm"]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        built.replace(library)  # atomic: another process never loads half a library
