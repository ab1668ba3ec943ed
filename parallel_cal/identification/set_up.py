"""Place what stands on the table, such as sockets, before a model is judged by touches of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


def place_set_up(model: Model, dataset: Dataset, options: FitOptions) -> Model:
    """Return the model with the free parameters of its sensors with contacts fitted alone.

    Nobody measured where sockets or an edge stand: without this, their place would be an error of
    the given model, and any fit of the robot would look better. The robot is as given. All samples
    place the set-up, those that are held out later, too: that favours the given model.
    """
    if not find_set_up(model).any():
        return model
    return place(model, observe(model, dataset, options.joint_sigma, options.insist))


def find_set_up(model: Model) -> np.ndarray:
    """The mask of the free parameters that state where sockets, edges and the like stand."""
    names = tuple(f"{sensor.name}." for sensor in model.sensors if sensor.contacts)
    own = np.array([bool(names) and p.name.startswith(names) for p in model.table], dtype=bool)
    return np.asarray(own & ~np.asarray(model.fixed))


def place(model: Model, observations: Observations) -> Model:
    """Return the model with its set-up placed by these samples."""
    found = estimate(model, observations, find_set_up(model), prior=True)
    return replace(model, values=found.values)
