"""Read regular files of limited size, and write files atomically."""

from __future__ import annotations

import codecs
import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

MEGABYTE = 1 << 20
NOT_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")  # any byte is a letter or a sign in Latin-1
BACKUP_SUFFIX = ".previous"  # appended to the name of a file that was replaced


def read_bytes(path: str | Path, most: int = 16 * MEGABYTE) -> bytes:
    """Read a regular file of at most `most` bytes.

    A pipe or a device could block or never end: it raises OSError, as does a file that is too
    large.
    """
    # Open the file before checking it, so that another process cannot exchange it in between.
    # With O_NONBLOCK, opening a pipe does not wait for a writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as stream:
        state = os.fstat(handle)
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        content = stream.read(most + 1)
    if len(content) > most:
        words = f"it is larger than {most // MEGABYTE} MB"
        raise OSError(errno.EFBIG, words, str(path))
    return content


def read_text(
    path: str | Path, most: int = 16 * MEGABYTE, encoding: str = "utf-8", errors: str = "strict"
) -> str:
    """Read a text file, with the limits of `read_bytes`; UnicodeDecodeError if it is not text."""
    return read_bytes(path, most).decode(encoding, errors)


def read_foreign_text(path: str | Path, most: int = 16 * MEGABYTE) -> str:
    """Read a text file of another program, with the limits of `read_bytes`; lines end with LF.

    A byte order mark states UTF-8 or UTF-16. A text without one is UTF-8, or else Latin-1 as
    Windows writes it (code page 1252), in which a tracker writes `°` and `µm`.
    UnicodeDecodeError if the file is neither.
    """
    content = read_bytes(path, most)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252")
            if found := NOT_TEXT.search(text):
                at = found.start()
                raise UnicodeDecodeError("cp1252", content, at, at + 1, "not text") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def write_atomically(path: str | Path, text: str | bytes, like: str | Path | None = None) -> None:
    """Replace a file in one step: a reader sees the old or the new text, even after a power cut.

    The file gets the permission bits of the file `like`, by default its previous ones. A symbolic
    link keeps its target. OSError with the name of the file if the folder cannot be written.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    model = Path(like or target)
    if model.exists():
        permissions = stat.S_IMODE(model.stat().st_mode)
    else:
        # A new file gets what the user's mask allows; the mask can only be read by setting it.
        mask = os.umask(0)
        os.umask(mask)
        permissions = 0o666 & ~mask
    try:
        _replace(target, text, permissions)
    except OSError as error:  # it names the temporary file
        raise OSError(error.errno, error.strerror, str(path)) from None
    # Make the new name survive a power cut; some file systems cannot, which is no error.
    with contextlib.suppress(OSError):
        handle = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def open_locked(path: Path) -> int | None:
    """Open a file to read and append, creating it if needed; None if another process holds it."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    file = os.open(path, flags, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        return None
    return file


def append_lines(file: int, lines: Iterable[str]) -> None:
    """Append all lines or none, and flush them to the disk; OSError if that fails. If a crash cut
    off the last line of the file, start a new line first."""
    end = os.lseek(file, 0, os.SEEK_END)
    cut = b"" if end == 0 or os.pread(file, 1, end - 1) == b"\n" else b"\n"
    text = cut + "".join(line + "\n" for line in lines).encode()
    try:
        while text:
            text = text[os.write(file, text) :]
        os.fsync(file)
    except OSError:
        with contextlib.suppress(OSError):
            os.ftruncate(file, end)
        raise


def json_lines(path: str | Path, most: int) -> Iterator[dict[str, Any]]:
    """Yield the JSON objects of a file with one object per line. Skip damaged lines: a crash may
    leave a line that is cut off or not text."""
    for line in read_text(path, most, errors="replace").splitlines():
        # A number of thousands of digits is a ValueError, a thousand brackets a RecursionError.
        with contextlib.suppress(ValueError, RecursionError):
            said = json.loads(line)
            if isinstance(said, dict) and "\ufffd" not in line:
                yield said


def cache_folder() -> Path:
    """Return the folder for files that can be computed again."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "parallel_cal"


def state_folder() -> Path:
    """Return the folder for what the program remembers of a user from session to session."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "parallel_cal"


def load_or_compute(sources: Iterable[Path], make: Callable[[], Any]) -> Any:
    """Return the JSON document of `make`, or the stored one if these files have not changed."""
    digest = hashlib.sha256()
    for path in sources:
        digest.update(f"{path.name}\0".encode() + path.read_bytes())
    name = f"{digest.hexdigest()[:32]}.json"
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        # Nothing stored yet, no home folder, or a damaged document.
        return json.loads(read_text(cache_folder() / name))
    document = make()
    with contextlib.suppress(OSError, RuntimeError):
        cache_folder().mkdir(parents=True, exist_ok=True)
        write_atomically(cache_folder() / name, json.dumps(document))
    return document


def _replace(target: Path, text: str | bytes, permissions: int) -> None:
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(text if isinstance(text, bytes) else text.encode("utf-8"))
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(name, permissions)
        os.replace(name, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        raise
