"""Kinematic calibration of parallel robots; names are loaded when they are first used."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Dataset": "dataset",
    "Kinematics": "kinematics",
    "Model": "model",
    "ParallelCalError": "errors",
    "Status": "kinematics",
    "compare": "identification",
    "fit": "identification",
    "load_dataset": "dataset",
    "model_hash": "modelfile",
    "new_model": "model",
    "read_model": "modelfile",
    "write_model": "modelfile",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'parallel_cal' has no attribute '{name}'")
    return getattr(import_module(f"parallel_cal.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
