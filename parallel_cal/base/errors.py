"""The errors that users of the package see.

Inside the package, a sample that cannot be solved has a status; it raises no error. Every message
names the file, key, topic or sample, the value, what was expected and what to do.
"""

import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path


class ParallelCalError(Exception):
    """Base of every error the package raises on purpose; one readable sentence."""

    def __str__(self) -> str:
        # A message may quote a file, and a quoted cell or key may contain line breaks.
        return " ".join(super().__str__().splitlines())


class BagError(ParallelCalError):
    """A recording cannot be opened, or a whole stream in it cannot be used."""


class DatasetError(ParallelCalError):
    """No usable samples can be made from a recording or a saved sample file."""


class UnfitError(DatasetError):
    """The recording is unusable: more data of this kind will not yield samples."""


class ModelFileError(ParallelCalError):
    """A model file cannot be read or written: unknown key, wrong unit, implausible value."""


class ModelError(ParallelCalError):
    """A model is composed wrongly: unknown mechanism, effect, parameter or condition."""


class OpenLoopsError(ModelError):
    """The loops of a chain do not close with its driven joints at home, or it is singular there.

    `home` has a value for each coordinate of the joints where they do close and the chain is
    regular, and is empty if they close nowhere; `position` and `quaternion` are the pose of the
    platform there. `singular` is true if the loops close at the stated home.
    """

    def __init__(
        self,
        message: str,
        home: Mapping[str, float] | None = None,
        position: Sequence[float] = (),
        quaternion: Sequence[float] = (),
        singular: bool = False,
    ):
        super().__init__(message)
        self.home, self.singular = home or {}, singular
        self.position, self.quaternion = position, quaternion


def wrap_plugin_error(name: str, error: Exception) -> ModelError:
    """Return a one-line error that names the place where a user's plug-in failed."""
    if isinstance(error, ParallelCalError):
        return ModelError(f"{name}: {error}")
    frames = traceback.extract_tb(error.__traceback__)
    file, line = next((f.filename, f.lineno) for f in frames[::-1] if "casadi.py" not in f.filename)
    place = "" if file.startswith("<frozen") else f" ({Path(file).name}:{line})"
    return ModelError(f"{name}: {type(error).__name__}: {' '.join(str(error).split())}{place}")


def format_suggestion(word: str, known: list[str]) -> str:
    """Return `; did you mean 'backlash'?` if one of the known words is similar, else ""."""
    from difflib import get_close_matches

    return "".join(f"; did you mean '{n}'?" for n in get_close_matches(word, known, n=1))


class SolveError(ParallelCalError):
    """A direct or inverse problem cannot be posed; an unsolved sample has a status instead."""


class FitError(ParallelCalError):
    """An identification cannot be carried out or must not be trusted."""
