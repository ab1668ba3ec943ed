"""The numbers with which joint readings were computed, compared with those of a model.

A height map states where the nozzle was by the controller. An importer computes the joints from
these positions, with the controller's configuration. A model that was made from another
configuration counts its joints from other places.
"""

from __future__ import annotations

from collections.abc import Mapping

from parallel_cal.model.model import Model

END_STOP = ".end_stop"  # after the name of a joint: its reading at its end-stop
MAX_DIFFERENCE = 1e-6  # m or rad; less changes no joint reading by a motor's step


def numbers_of(model: Model) -> dict[str, float]:
    """Return the numbers of a model that a configuration may state, in m or rad."""
    m = model.mechanism
    switches = getattr(m, "switches", None) or [high for _, high in m.joint_limits]
    stops = {j + END_STOP: float(at) for j, at in zip(model.joints, switches, strict=True)}
    nominal = zip(model.table.names, map(float, model.table.nominal), strict=True)
    return dict(nominal) | stops


def explain_difference(one: Mapping[str, float], other: Mapping[str, float]) -> str:
    """Return a text with the first number that differs, as `NAME is ONE, but OTHER`; else empty."""
    for name in one:
        if name in other and abs(one[name] - other[name]) > MAX_DIFFERENCE:
            return f"{name} is {one[name]:.6f}, but {other[name]:.6f}"
    return ""


def explain_other_configuration(
    model: Model, configuration: Mapping[str, float], source: str
) -> str:
    """Return why samples do not belong to a model, by their configuration; empty if they do."""
    difference = explain_difference(configuration, numbers_of(model))
    if not difference:
        return ""
    return (
        f"{source}: imported with another configuration than the one from which the model was "
        f"made: {difference} in the model (m, rad). Import the samples again with the "
        "configuration of the model, or make the model anew (new --from) from the configuration "
        "with which the bed was probed"
    )
