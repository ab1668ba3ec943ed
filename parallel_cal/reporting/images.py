"""What a camera measured: corners and their residuals over the image, the lens, and the robot's
error without the noise of the images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.image_poses import (
    add_joint_noise,
    estimate_robot_error,
    find_shown_poses,
)
from parallel_cal.identification.observations import UNMEASURED
from parallel_cal.identification.position_uncertainty import compute_shape_sigma
from parallel_cal.identification.prediction_errors import Errors
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.reporting.blocks import Block, Number, Table
from parallel_cal.reporting.readable import format_fixed
from parallel_cal.sensors.camera import Camera

GRID = (8, 6)  # cells of the image that count for its coverage
MAX_TOLD_SHARE = 0.5  # of its tolerance: an estimate with a larger sigma comes from the tolerance


@dataclass(frozen=True)
class CameraImages:
    """Corners (n, 2) px that one camera saw, their residuals (n, 2) px, measured minus predicted at
    poses that were held out if there are any, and the sample (n,) of each."""

    camera: Camera
    corners: np.ndarray
    residuals: np.ndarray
    sample: np.ndarray
    images: int
    held_out: bool

    @property
    def rms(self) -> float:
        """Rms distance (px) of a corner from its prediction."""
        return float(np.sqrt(np.nanmean(np.sum(self.residuals**2, axis=1))))

    @property
    def coverage(self) -> float:
        """Share of the cells of the image with at least one corner."""
        cells = np.floor(self.corners / np.array(self.camera.image_size) * GRID).astype(int)
        inside = np.clip(cells, 0, np.array(GRID) - 1)
        return len(np.unique(inside, axis=0)) / (GRID[0] * GRID[1])


def list_cameras(result: FitResult) -> list[Camera]:
    """List the cameras of a fit."""
    return [sensor for sensor in result.model.sensors if isinstance(sensor, Camera)]


def list_images(result: FitResult) -> list[CameraImages]:
    """List the cameras of a fit with what they saw."""
    found: list[CameraImages] = []
    errors: Errors = result.judged_errors
    channels, reading = np.array(result.model.structure.channels), result.observations.reading
    for camera in list_cameras(result):
        own = np.isin(channels, camera.channels)
        pixels, left = (a[:, own].reshape(len(a), -1, 2) for a in (reading, errors.pixel))
        seen = np.isfinite(pixels).all(axis=2)
        sample = np.nonzero(seen)[0]
        found.append(
            CameraImages(
                camera,
                pixels[seen],
                left[seen],
                result.dataset.numbers[sample],
                int(seen.any(axis=1).sum()),
                bool(result.held_out.judged.any()),
            )
        )
    return found


def describe_images(result: FitResult) -> Iterator[Block]:
    """Describe the cameras of a fit, their lenses, and the robot's error without their noise."""
    for one in list_images(result):
        name = one.camera.name
        where = "held-out poses" if one.held_out else "all poses"
        yield (
            f"{name}: {one.images} images with {len(one.corners)} corners, "
            f"{format_fixed(one.rms)} px rms of a corner at {where}; corners in "
            f"{100 * one.coverage:.0f} % of the image"
        )
        yield lens_table(result, one.camera)
    yield from describe_robot_error(result)
    for camera in list_cameras(result):
        if stated := describe_stated_length(result, camera):
            yield stated


def describe_robot_error(result: FitResult) -> Iterator[str]:
    """Describe the robot's position error without the noise of the images, and the uncertainty of
    the positions; nothing without a camera."""
    if not list_cameras(result):
        return
    model, observations = result.model, result.observations
    x = predict_configurations(model, observations)
    shown = find_shown_poses(model, observations, x)
    if shown is None:
        return
    errors = result.judged_errors
    change = np.hstack([errors.position, errors.orientation])
    change = np.where(np.isfinite(change), change, np.where(shown.known[:, None], 0.0, np.nan))
    judged = np.isfinite(errors.position).all(axis=1)
    shown = replace(shown, change=np.where(judged[:, None], change, np.nan))
    if (own := estimate_robot_error(shown)) is not None:
        text = (
            "position error of the robot without the noise of the images: "
            f"{_format_micrometres(own)} rms at "
            f"{'held-out' if result.held_out.judged.any() else 'all'} poses"
        )
        if observations.noise_from["joint"] in UNMEASURED:
            text += (
                ". It contains the noise of the joint readings. If you know this noise, state it "
                "(--joint-sigma)"
            )
        elif alone := estimate_robot_error(add_joint_noise(shown, model, observations, x)):
            text += f"; without the noise of the joint readings, too: {_format_micrometres(alone)}"
        yield f"{text}. The images do not show an error that camera and robot share"
    if (sigma := compute_shape_sigma(model, observations)) is not None:
        yield (
            f"uncertainty of the identified positions, with that of the lens: "
            f"{format_fixed(sigma, 1e6, 0)} um rms, whatever the frames of base and platform"
        )


def _format_micrometres(estimate: tuple[float, float]) -> str:
    value, sigma = (format_fixed(each, 1e6, 0) for each in estimate)
    return f"{value} +- {sigma} um"


def describe_stated_length(result: FitResult, camera: Camera) -> str:
    """Say which lengths follow from the stated size of the board; empty if the fit corrects it."""
    name = f"{camera.name}.scale"
    if not result.parameters()[name].fixed:
        return ""
    if "m" in result.model.mechanism.joint_units:
        return (
            f"{camera.name}: square: {camera.square:g} m and the lengths that the joints read must "
            f"agree. If the print was not measured, let the fit correct it (--free {name})"
        )
    return (
        f"{camera.name}: neither angles nor images contain a length. All lengths of the robot "
        f"follow from square: {camera.square:g} m; 0.1 % of it is 0.1 % of the robot"
    )


def lens_table(result: FitResult, camera: Camera) -> Table:
    """List the parameters of a lens, and whether the data or their tolerances determine them."""
    rows: list[tuple[str | Number, ...]] = []
    table, estimates = result.model.table, result.parameters()
    for name in camera.lens_parameters:
        full = f"{camera.name}.{name}"
        one, tolerance = estimates[full], table[full].tolerance
        told = one.sigma is not None and one.sigma < MAX_TOLD_SHARE * tolerance
        by = "fixed" if one.fixed else "the data" if told else "its tolerance"
        decimals = 2 if one.unit == "px" else 5
        rows.append(
            (
                full,
                Number(one.value, 1.0, decimals, 6, one.sigma),
                Number(None if one.fixed else one.sigma, 1.0, decimals, 2),
                one.unit.replace("1", ""),
                by,
            )
        )
    return Table((f"lens of {camera.name}", "value", "sigma", "unit", "determined by"), rows)
