"""How far the predictions of two branches differ over the workspace; in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.position_uncertainty import solve_middle_planes
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Model
from parallel_cal.reporting import maps
from parallel_cal.reporting.readable import with_unit
from parallel_cal.session.history import History


def compare_predictions(folder: Path, one: str, other: str) -> dict[str, Any]:
    """Draw the predicted positions of branch `other` minus those of branch `one`."""
    states = History(folder).compared([one, other])
    models = [read_model(folder / states[name].model) for name in (one, other)]
    return draw_difference(models[0], models[1], one, other)


@single_threaded()
def draw_difference(first: Model, second: Model, one: str, other: str) -> dict[str, Any]:
    """Draw how far apart two models place the platform at the same joints, under neutral
    conditions, with the 1-sigma uncertainty of each; a sentence only if there is no map."""
    title = f"predictions of {other} minus those of {one}"
    grid = solve_middle_planes(first)
    if grid is None:
        return {"words": f"{title}: no map, because no plane of positions can be reached"}
    robots = [Kinematics(model.robot()) for model in (first, second)]
    reached = [robot.direct(grid.joints) for robot in robots]
    both = reached[0].solved & reached[1].solved
    if not both.any():
        return {"words": f"{title}: no map, because the models reach no common pose"}
    solved = [solutions[both] for solutions in reached]
    difference = solved[1].position - solved[0].position
    sizes = np.linalg.norm(difference, axis=1)
    sigmas = [
        f"1 sigma of {name} {_format_sigma(robot, model, solutions)}"
        for name, robot, model, solutions in zip(
            (one, other), robots, (first, second), solved, strict=True
        )
    ]
    places = solved[0].position
    figure, scale = maps.residuals(places, [difference], "position", np.arange(len(places)))
    for trace in figure["data"]:
        trace.pop("customdata", None)  # these are no samples that could be marked
    words = (
        f"{title}, magnified {scale:g} times: {with_unit(float(np.sqrt(np.mean(sizes**2))), 'm')} "
        f"rms over the workspace, at most {with_unit(float(sizes.max()), 'm')}; "
        f"{', '.join(sigmas)}"
    )
    return {"words": words, "figure": to_json_value(figure)}


def _format_sigma(robot: Kinematics, model: Model, solved: Any) -> str:
    """Format the rms uncertainty of the predicted positions; a model may have none."""
    if model.covariance is None:
        return "unknown"
    spread = robot.direct_covariance(solved)[:, :3, :3]
    return with_unit(float(np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2)))), "m")
