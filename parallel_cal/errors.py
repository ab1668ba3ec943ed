"""The errors that cross the package's border; inside, failure is data (a status per sample).

Every message names the file, key, topic or sample, the value, what was expected and what to do.
"""


class ParallelCalError(Exception):
    """Base of every error the package raises on purpose; one readable sentence."""


class BagError(ParallelCalError):
    """A recording cannot be opened, or a whole stream in it cannot be used."""


class DatasetError(ParallelCalError):
    """No usable samples can be made from a recording or a saved sample file."""


class ModelFileError(ParallelCalError):
    """A model file cannot be read or written: unknown key, wrong unit, implausible value."""


class ModelError(ParallelCalError):
    """A model is put together wrongly: unknown mechanism, effect, parameter or condition."""


class SolveError(ParallelCalError):
    """A direct or inverse problem cannot be posed (unsolved samples are a status, not this)."""


class FitError(ParallelCalError):
    """An identification cannot be carried out or must not be trusted."""
