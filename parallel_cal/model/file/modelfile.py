"""The YAML model file: every number is checked when read; it is written atomically."""

from __future__ import annotations

import hashlib
from pathlib import Path

from parallel_cal.base.arguments import check_arguments, require
from parallel_cal.base.errors import ModelError, ModelFileError
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

MAX_MODEL_FILE_BYTES = 4 * MEGABYTE  # a node takes 1 s per MB, and its streams wait


@check_arguments(ModelFileError)
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
    """Read the text of a model file; ModelFileError if it cannot be read or is not text."""
    try:
        return read_text(path, MAX_MODEL_FILE_BYTES)
    except OSError as error:
        hint = " (expected a model file, then recordings)" if Path(path).is_dir() else ""
        raise ModelFileError(f"{path}: cannot be read: {error.strerror}{hint}") from None
    except UnicodeDecodeError:
        raise ModelFileError(f"{path}:1: not YAML: the file is not text (UTF-8)") from None


def parse_model(text: str, name: str = "model", known: Model | None = None) -> Model:
    """Parse the text of a model file; errors (ModelFileError) call the file `name`.

    The functions of a mechanism are derived once and cached with it. A file that is read again and
    again would leave them each time: the model gets the mechanism of a `known` one that is equal.
    """
    from parallel_cal.model.file.reader import Reader  # pydantic costs 50 ms

    return Reader(parse_yaml(text, name), known).model()


@check_arguments(ModelFileError)
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
    """Write a model file like `write_model`; an existing file is kept as `PATH.previous`."""
    _write_beside_previous(path, readable_text(model, path))


def replace_text(path: str | Path, text: str) -> None:
    """Write a model file's text and keep the previous file, with its permissions, beside it.

    ModelFileError for a text that could not be read back; both files then stay unchanged.
    """
    parse_model(text, f"{path} (not written)")
    _write_beside_previous(path, text)


def _write_beside_previous(path: str | Path, text: str) -> None:
    """Write a text that was just checked; an existing file that differs is kept as
    `PATH.previous`."""
    if Path(path).exists():
        if (old := model_text(path)) == text:
            return
        write_text(f"{path}{BACKUP_SUFFIX}", old, like=path)
    write_text(path, text)


def readable_text(model: Model, name: str | Path) -> str:
    """Return the text of a model's file if the reader accepts it, else raise ModelFileError.

    The error calls the file `name`. Use this function to store a model: `dump_model` alone may
    return a text that the reader refuses.
    """
    text = dump_model(model)
    parse_model(text, f"{name} (not written)", model)
    return text


def write_text(path: str | Path, text: str, like: str | Path | None = None) -> None:
    """Write the text of a model file atomically, unchecked; ModelFileError if this fails.

    It is for text that was just checked, and for a copy of an existing file.
    """
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
    require("model", model, "Model | str | bytes", ModelError)
    text = dump_model(model) if isinstance(model, Model) else model
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()
