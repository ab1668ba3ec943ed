"""Kinematic calibration of parallel robots; names are loaded when they are first used.

`effects`, `mechanisms` and `sensors` are the shelves themselves: `effects.names()` says what is on
one, `effects.load("backlash")` takes it down.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# where a name lives: a module, a function that is called otherwise there, or a shelf itself
_HOME = {
    "Campaign": "campaign.campaign",
    "Channel": "recordings.channels",
    "Dataset": "recordings.dataset",
    "Effect": "model.effect",
    "Goal": "campaign.campaign",
    "Home": "model.mechanism",
    "Kinematics": "kinematics.kinematics",
    "Mechanism": "model.mechanism",
    "Model": "model.model",
    "Parameter": "model.parameters",
    "ParameterTable": "model.parameters",
    "ParallelCalError": "base.errors",
    "Sample": "campaign.cell",
    "Sensor": "model.sensor",
    "Status": "kinematics.solutions",
    "Workspace": "model.mechanism",
    "add": "session.steps:added",
    "compare": "diagnosis.comparison",
    "diagnose": "diagnosis.diagnose",
    "figure": "reporting.pictures",
    "fit": "identification.fit",
    "load_dataset": "recordings.loading",
    "load_sessions": "recordings.loading",
    "model_hash": "model.file.modelfile",
    "new_model": "model.model",
    "page": "reporting.page",
    "plan": "planning.plan",
    "read_model": "model.file.modelfile",
    "remove": "session.steps:removed",
    "report": "reporting.report",
    "show": "reporting.text",
    "simulate": "recordings.simulate",
    "write_bag": "recordings.writer",
    "write_model": "model.file.modelfile",
}
_SHELVES = ("effects", "mechanisms", "sensors")
__all__ = sorted((*_HOME, *_SHELVES))


def __getattr__(name: str) -> Any:
    if name in _SHELVES:
        return import_module(f"parallel_cal.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'parallel_cal' has no attribute '{name}'")
    module, _, called = _HOME[name].partition(":")
    return getattr(import_module(f"parallel_cal.{module}"), called or name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
