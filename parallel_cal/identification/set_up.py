"""Place what stands on the table, such as sockets, before a model is judged by touches of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


def place_set_up(model: Model, dataset: Dataset, options: FitOptions) -> Model:
    """Return the model with the free parameters of its sensors with contacts fitted alone.

    Nobody measured where sockets or an edge stand: without this, their place would be an error of
    the given model, and any fit of the robot would look better. The robot is as given. All samples
    place the set-up, those that are held out later, too: that favours the given model.
    """
    names = [f"{sensor.name}." for sensor in model.sensors if sensor.contacts]
    own = np.array([p.name.startswith(tuple(names)) for p in model.table]) if names else None
    if own is None or not (own := own & ~np.asarray(model.fixed)).any():
        return model
    observations = observe(model, dataset, options.joint_sigma, options.insist)
    found = estimate(model, observations, own, prior=True)
    return replace(model, values=found.values)
