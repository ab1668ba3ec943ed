"""The YAML model file: read with every number checked, written whole or not at all."""

from __future__ import annotations

import hashlib
from pathlib import Path

from parallel_cal.base.errors import ModelFileError
from parallel_cal.base.files import BACKUP_SUFFIX, MEGABYTE, read_text, write_atomically
from parallel_cal.model.file.writer import dump_model
from parallel_cal.model.file.yamltext import parse_yaml
from parallel_cal.model.model import Model

__all__ = [
    "dump_model",
    "model_hash",
    "model_text",
    "parse_model",
    "read_model",
    "readable_text",
    "replace_model",
    "replace_text",
    "write_model",
    "write_text",
]

MAX_MODEL_FILE_BYTES = (
    4 * MEGABYTE
)  # of a file: a second each, in which streams of the node that reads it suffer


def read_model(path: str | Path) -> Model:
    """Read a model file.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Model

    Raises
    ------
    ModelFileError
        Names file, line, key, value and what is expected.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> pc.read_model("config/delta_mockup_nominal.yaml").mechanism.name
    'delta54'
    """
    return parse_model(model_text(path), str(path))


def model_text(path: str | Path) -> str:
    """The text of a model file; ModelFileError where it cannot be read or is none."""
    try:
        return read_text(path, MAX_MODEL_FILE_BYTES)
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ModelFileError(f"{path}:1: not YAML: the file is not text (UTF-8)") from None


def parse_model(text: str, name: str = "model") -> Model:
    """The model in a text; `name` stands for the file in errors (ModelFileError)."""
    from parallel_cal.model.file.reader import Reader  # pydantic costs 50 ms

    return Reader(parse_yaml(text, name)).model()


def write_model(model: Model, path: str | Path) -> None:
    """Write a model file atomically: the old file stays until the new one is complete.

    Parameters
    ----------
    model : Model
    path : str or Path

    Raises
    ------
    ModelFileError
        If `read_model` could not read the file back, or the folder cannot be written.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/robot.yaml"
    >>> pc.write_model(pc.new_model("delta24"), path)
    >>> pc.read_model(path)
    Model(delta24, 24 parameters)
    """
    write_text(path, readable_text(model, path))


def replace_model(model: Model, path: str | Path) -> None:
    """The same; a file that was there is laid aside as `PATH.previous`."""
    replace_text(path, readable_text(model, path))


def replace_text(path: str | Path, text: str) -> None:
    """Write a model file's text, and keep the one before beside it, with its permissions;
    ModelFileError, and both files as they were, for a text that could not be read back."""
    parse_model(text, f"{path} (not written)")
    if Path(path).exists():
        write_text(f"{path}{BACKUP_SUFFIX}", model_text(path), like=path)
    write_text(path, text)


def readable_text(model: Model, name: str | Path) -> str:
    """The text of a model's file, which the reader accepts; `name` stands for the file in the
    ModelFileError where it does not.

    Whatever stores a model takes its text from here: `dump_model` alone also gives texts that
    nobody can read back.
    """
    text = dump_model(model)
    parse_model(text, f"{name} (not written)")
    return text


def write_text(path: str | Path, text: str, like: str | Path | None = None) -> None:
    """Write the text of a model file in one step, unchecked: for one that was just read, or that
    is laid aside as it is. ModelFileError where the file cannot be written."""
    try:
        write_atomically(path, text, like)
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be written: {error.strerror}") from None


def model_hash(model: Model | str | bytes) -> str:
    """Compute the sha256 of a model's file text.

    Parameters
    ----------
    model : Model, str or bytes
        A model, or the text of a model file.

    Returns
    -------
    str
        Hexadecimal, equal to what `sha256sum` prints for the written file.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> len(pc.model_hash(pc.new_model("delta24")))
    64
    """
    text = dump_model(model) if isinstance(model, Model) else model
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()
