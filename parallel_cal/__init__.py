"""Kinematic calibration of parallel robots; names are loaded when they are first used."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Dataset": "recordings.dataset",
    "Kinematics": "kinematics.kinematics",
    "Model": "model.model",
    "ParallelCalError": "base.errors",
    "Status": "kinematics.solutions",
    "compare": "diagnosis.comparison",
    "fit": "identification.fit",
    "load_dataset": "recordings.loading",
    "model_hash": "model.file.modelfile",
    "new_model": "model.model",
    "read_model": "model.file.modelfile",
    "write_model": "model.file.modelfile",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'parallel_cal' has no attribute '{name}'")
    return getattr(import_module(f"parallel_cal.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
