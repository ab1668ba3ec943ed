"""CasADi functions on NumPy arrays without conversions, and their compiled C, cached."""

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

log = logging.getLogger(__name__)

LARGE = 10_000  # instructions: looking for common ones would take longer than it saves
# Without the last one CasADi's x * x and |x| stay calls of functions that others might replace.
FLAGS = ("-O2", "-fPIC", "-shared", "-fno-semantic-interposition")


class Single:
    """A function of vectors, called through one buffer: microseconds a call, thread-safe."""

    def __init__(self, function: ca.Function):
        self._buffer, self._evaluate = function.buffer()
        self._lock = Lock()
        self._in = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self._out = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self._in):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self._out):
            self._buffer.set_res(i, array.data)

    def __call__(self, *arguments: np.ndarray | Sequence[float]) -> list[np.ndarray]:
        """Outputs as flat arrays (column-major where the function returns a matrix)."""
        with self._lock:
            for array, argument in zip(self._in, arguments, strict=True):
                array[:] = argument
            self._evaluate()
            return [array.copy() for array in self._out]


class Batch:
    """A function of vectors evaluated on N samples: (N, size) arrays in and out.

    Samples go through buffers of fixed sizes, made once: nothing is built or converted for
    a new N, and memory beyond the results stays small.
    """

    SIZES = (512, 16)

    def __init__(self, function: ca.Function):
        self._function = function
        self._chunks: dict[tuple[int, tuple[int, ...]], _Chunk] = {}
        self._lock = Lock()

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """Each argument (N, size), or (size,) to be the same for all samples."""
        f = self._function
        n = next(len(a) for a in arguments if np.ndim(a) == 2)
        shared = tuple(i for i, a in enumerate(arguments) if np.ndim(a) == 1)
        out = [np.empty((n, f.numel_out(i))) for i in range(f.n_out())]
        begin = 0
        with self._lock:
            while begin < n:
                size = next((s for s in self.SIZES if n - begin >= s), self.SIZES[-1])
                self._chunk(size, shared)(arguments, out, begin, min(begin + size, n))
                begin += size
        return out

    def _chunk(self, size: int, shared: tuple[int, ...]) -> _Chunk:
        if (size, shared) not in self._chunks:
            self._chunks[size, shared] = _Chunk(self._function, size, shared)
        return self._chunks[size, shared]


class _Chunk:
    """A fixed number of samples in one call."""

    def __init__(self, function: ca.Function, size: int, shared: tuple[int, ...]):
        mapped = function.map(f"many{size}", "serial", size, list(shared), [])
        self._buffer, self._evaluate = mapped.buffer()
        rows = [1 if i in shared else size for i in range(function.n_in())]
        self._in = [np.zeros((rows[i], function.numel_in(i))) for i in range(function.n_in())]
        self._out = [np.zeros((size, function.numel_out(i))) for i in range(function.n_out())]
        for i, array in enumerate(self._in):
            self._buffer.set_arg(i, array.reshape(-1).data)
        for i, array in enumerate(self._out):
            self._buffer.set_res(i, array.reshape(-1).data)

    def __call__(
        self, arguments: Sequence[np.ndarray], out: Sequence[np.ndarray], begin: int, end: int
    ) -> None:
        n = end - begin
        for array, argument in zip(self._in, arguments, strict=True):
            if np.ndim(argument) == 1:
                array[0] = argument
            else:
                array[:n] = argument[begin:end]  # rows beyond n hold old samples: harmless
        self._evaluate()
        for array, result in zip(self._out, out, strict=True):
            result[begin:end] = array[:n]


def dense(name: str, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> ca.Function:
    """A function with dense outputs; common sub-expressions shared where it is not too large."""
    plain = ca.Function(name, list(inputs), [ca.densify(o) for o in outputs])
    if plain.n_instructions() > LARGE:
        return plain
    return ca.Function(name, list(inputs), [ca.densify(o) for o in ca.cse(list(outputs))])


def compiled(function: ca.Function) -> ca.Function:
    """The function as machine code from the cache or the C compiler; itself without one."""
    if os.environ.get("PARALLEL_CAL_COMPILE") == "never":
        return function
    try:
        library = _cache_folder() / f"{_fingerprint(function)}.so"
        if not library.exists():
            _compile(function, library)
        return ca.external(function.name(), str(library))
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        # No compiler, no home, no right, a cache from another machine.
        log.info("no compiled code for %s (%s); CasADi's virtual machine serves", function, error)
        return function


def _compile(function: ca.Function, library: Path) -> None:
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc")
    if compiler is None:
        raise FileNotFoundError("no C compiler")
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        # CasADi writes its C file into the given folder; the name carries no directory.
        code = ca.CodeGenerator("code.c")
        code.add(function)
        code.generate(f"{folder}{os.sep}")
        built = Path(folder, "code.so")
        command = [compiler, *FLAGS, f"{folder}/code.c", "-o", str(built), "-lm"]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        built.replace(library)  # atomic: another process never loads half a library


def _fingerprint(function: ca.Function) -> str:
    text = f"{ca.__version__} {os.uname().machine} {FLAGS} {function.serialize()}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "parallel_cal"
