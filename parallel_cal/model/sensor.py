"""The base class of sensors: what a sensor shows at a pose, and its own parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, cast

import casadi as ca
import numpy as np

from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable


@dataclass(frozen=True)
class View:
    """Poses that a sensor's readings would show if its options were those of `sensor`.

    As with a pose device: `r` (N, 3) m and `R` (N, 3, 3) are those of the part on the platform in
    the frame of the part on the base; `seen` (N,) marks the samples with a pose.
    """

    sensor: Sensor
    r: np.ndarray
    R: np.ndarray
    seen: np.ndarray


class Sensor(ABC):
    """Base class of a measuring set-up (chapter 4 of the thesis).

    Write a subclass that is a frozen dataclass, in a file of its own. The file name is the
    name of the class in a model file, and by default the name of the sensor. The fields of the
    dataclass are the options in the model file (nominal geometry, uncertainty).

    A sensor adds its parameters to the model. It also adds one equation for each channel to the
    closure: the reading that the model predicts at the pose, minus the recorded reading, is zero.
    If a sample has no reading of a channel, this equation has no influence on the fit.

    Attributes
    ----------
    physics : str
        What the set-up measures, in words.
    source : str
        Where the numbers come from.
    fixed : tuple of str
        Name patterns of its parameters that are known constants. A fit does not identify them.
        Default none.
    sigma : float, optional
        Standard deviation of one reading, in the unit of the readings. None: unknown. 0 (default):
        the reading is exact.
    guessed_sigma : float
        Standard deviation with which the readings are weighted if `sigma` is None, in the unit of
        the readings. A fit then corrects it by the rms of the residuals. Default 2e-5.
    relative : bool
        Whether only differences of a channel's readings measure anything, because their common
        value depends on where a part was placed. Errors are then those without their mean over the
        judged samples. Default False.
    unit : str
        Unit of the readings, `m`, `rad` or `px`. Default `m`.
    shows_pose : bool
        Whether the readings of one sample determine the pose of the platform, as the corners in
        one image do. If True: (1) a recording may lack some of the channels altogether;
        (2) `views` supplies the start values that the options do not state; (3) pose errors are
        estimated from the readings. Default False.
    reads_always : bool
        Whether it reads wherever the robot moves, without a contact or a part to place. A simulated
        session then contains its readings. Default False.
    stated_length : str
        Name of the option (m) from which all lengths follow that the readings show; empty (default)
        if the readings themselves are lengths.
    scale_parameters : tuple of str
        Parameters that correct `stated_length`, if a fit identifies them. Default none.
    base_part, platform_part : str
        A measuring set-up has a part on the base and a part on the platform (camera and board, for
        example). Name patterns of the parameters that state the place of each part. Default none.
    """

    physics: ClassVar[str]
    source: ClassVar[str]
    fixed: tuple[str, ...] = ()
    sigma: float | None = 0.0
    guessed_sigma: ClassVar[float] = 20e-6
    relative: ClassVar[bool] = False
    unit: ClassVar[str] = "m"
    shows_pose: ClassVar[bool] = False
    reads_always: ClassVar[bool] = False
    needs_each_contact: ClassVar[bool] = True  # a recording that lacks one is refused
    stated_length: ClassVar[str] = ""
    scale_parameters: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        """Return its parameters, named without the sensor's own name (`hole1.x`)."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of its channels, one row each; the recorded topic `constraint` uses these names."""
        return ()

    @property
    def contacts(self) -> Mapping[str, tuple[str, ...]]:
        """Contacts of the platform with something on the base, by name: while a contact is made,
        its channels read zero. Recordings name the contact. Default: none."""
        return {}

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        """Return the reading of each channel at the pose (r, R) of {P} in {B}, a column."""
        return ca.SX(0, 1)

    def readings_with_passive(self, r: Any, R: Any, u: Mapping[str, Any], s: Named) -> Any:
        """Return the readings of a sensor that reads passive coordinates: `u` are the values of all
        of the mechanism's, by name. By default they do not matter."""
        return self.readings(r, R, s)

    def points(self, r: Any, R: Any, s: Named) -> Any:
        """Return a column of intermediate coordinates, from which `show` computes the readings.

        Implement `points` and `show` if there are many readings: the derivatives then need less
        time. None (default): `readings` computes the readings in one step.
        """
        return None

    def show(self, points: Any, s: Named) -> Any:
        """Return the readings for the intermediate coordinates that `points` returned."""
        raise NotImplementedError

    def find_visible(self, readings: np.ndarray) -> np.ndarray:
        """Return a mask (N, n_channels): which predicted readings the sensor can see. For a camera,
        these are the pixels inside the image."""
        return np.ones(readings.shape, dtype=bool)

    @property
    def base_part(self) -> str:
        """Name pattern of the parameters of its part on the base; empty by default."""
        return ""

    @property
    def platform_part(self) -> str:
        """Name pattern of the parameters of its part on the platform; empty by default."""
        return ""

    @property
    def is_placed(self) -> bool:
        """Whether its options contain all start values. If False, a fit finds them with `views` and
        `placed`."""
        return True

    def views(self, reading: np.ndarray) -> Iterator[View]:
        """Yield a View for each set of options that may be true.

        Several sets of options may fit the readings (N, n_channels). Each View has one set, and the
        poses that the readings show with it. A fit starts from the set whose poses agree best with
        the poses of the robot.
        """
        return iter(())

    def variants(self) -> Iterator[tuple[str, Sensor]]:
        """Yield sensors with options that are often confused with the present ones.

        Each comes as a pair (text, sensor): the text describes its options. If the readings agree
        much better with it, a fit refuses the present sensor and shows the text.
        """
        return iter(())

    def placed(
        self, f: np.ndarray, F: np.ndarray, t: np.ndarray, T: np.ndarray, R: np.ndarray
    ) -> Sensor:
        """Return a copy of the sensor whose parts have these start poses: position f and rotation F
        of the part on the base, in {B}; t and T of the part on the platform, in {P}. R is the mean
        rotation of the platform. Stated positions are kept."""
        return self

    def pose(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        """Return the pose of {P} in {B} if a device that measures poses shows (r, R)."""
        return r, R

    def shown(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        """Return the pose that the device shows if {P} is at (r, R) in {B}; inverse of `pose`."""
        return r, R

    def tolerances(self, table: ParameterTable, mechanism: Mechanism) -> Mapping[str, float]:
        """Return tolerances that replace those of the catalogue, by full parameter name.

        Example: the certificate of a pose device states how large errors of the device can be.
        """
        return {}

    @property
    def weighing_sigma(self) -> float:
        """Standard deviation that weights its readings, stated or guessed, in their unit."""
        return self.guessed_sigma if self.sigma is None else self.sigma

    @property
    def class_name(self) -> str:
        """Name of its class in a model file."""
        return type(self).__module__.removeprefix("parallel_cal.sensors.")

    @property
    def name(self) -> str:
        """Name of the sensor in the model, the prefix of its parameters' names.

        Default: its class name. An option `name` distinguishes several sensors of one class.
        """
        return self.class_name

    @property
    def options(self) -> dict[str, Any]:
        """Fields that describe this set-up and differ from their defaults."""
        own = [(f.name, getattr(self, f.name), f.default) for f in fields(cast(Any, self))]
        return {name: value for name, value, default in own if value != default}

    def table(self, mechanism: Mechanism) -> ParameterTable:
        """Return its parameters under their full names (`plane_spheres.hole1.x`)."""
        return ParameterTable(
            replace(p, name=f"{self.name}.{p.name}", group="sensor")
            for p in self.parameters(mechanism)
        )

    def fixed_patterns(self) -> list[str]:
        """Return the patterns of its fixed parameters under their full names."""
        return [f"{self.name}.{pattern}" for pattern in self.fixed]


def apply_sensor_tolerances(
    sensors: Iterable[Sensor], table: ParameterTable, mechanism: Mechanism
) -> ParameterTable:
    """Return an effect's table with the tolerances that the sensors replace."""
    for sensor in sensors:
        table = table.with_tolerances(sensor.tolerances(table, mechanism))
    return table


def point_on_platform(r: Any, R: Any, s: Named, name: str = "tip") -> Any:
    """Return a point of the platform in {B}, given in {P} by three parameters."""
    return r + R @ s.vector(*[f"{name}.{axis}" for axis in "xyz"])


def point_parameters(
    name: str, point: Sequence[float], tolerance: float, axes: str = "xyz"
) -> list[Parameter]:
    """Return the coordinates of a point as parameters (m)."""
    pairs = zip(axes, point, strict=True)
    return [Parameter(f"{name}.{axis}", "m", float(v), tolerance) for axis, v in pairs]
