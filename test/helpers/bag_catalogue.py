"""Which recordings there are in `bags/`, and what is hidden in each; `make_bags.py` writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import virtual_sessions as days
from virtual_day import Clocks, Day
from virtual_effects_hidden import (
    BaseDrift,
    CrossTalk,
    GearRipple,
    JointCompliance,
    LateStamp,
    LeaningAxes,
    ThermalGrowth,
)

from parallel_cal.virtual.argos import TABLE_5_21
from parallel_cal.virtual.robot import (
    ARCSEC,
    MOCK_UP,
    TABLE_5_12,
    THESIS_NOISE,
    Backlash,
    Effect,
    EncoderEccentricity,
    Noise,
    Parameters,
    RodRobot,
)
from parallel_cal.virtual.stewart import Assembly


@dataclass(frozen=True, eq=False)
class Machine:
    """A robot before a measuring device, and what its controller believes."""

    robot: RodRobot | Assembly
    controller: Parameters
    joints: tuple[str, ...]
    noise: Noise
    sees_position: bool = True


@dataclass(frozen=True, eq=False)
class Bag:
    """One recording: its seed, its day, what is hidden in it, and how it is stored.

    `baseline` is the model file a user starts from. From there `verdict` is right: `found` are the
    package's names for what is hidden, with "|" between those that this day cannot tell apart.
    """

    about: str
    seed: int
    effects: tuple[Effect, ...]
    machine: Machine
    day: Callable[[int], Day]
    clocks: Clocks
    baseline: str
    verdict: str
    found: tuple[str, ...] = ()
    mode: str = "dwell"
    sqlite: bool = False


FINE = Noise(joint=5 * ARCSEC, position=2e-6, orientation=3 * ARCSEC)
# Section 2.4.2: a gimbal's steps of 2.7 arcmin.
GIMBAL = Noise(joint=25 * ARCSEC, orientation=2.7 * 60 / 12**0.5 * ARCSEC)

DELTA = Machine(MOCK_UP, TABLE_5_12, ("joint1", "joint2", "joint3"), THESIS_NOISE)
FINE_DELTA = replace(DELTA, noise=FINE)
# Without a stop every message has an error of its own.
MOVING_DELTA = replace(DELTA, noise=replace(THESIS_NOISE, jitter=1.0))
ARGOS = Machine(days.ARGOS, TABLE_5_21, DELTA.joints, GIMBAL, sees_position=False)
HEXAPOD = Machine(
    days.HEXAPOD,
    days.DESIGNED.parameters,
    tuple(days.HEXAPOD.legs),
    replace(THESIS_NOISE, joint=3e-6),
)

LIVELY = Clocks(joint=0.02, pose=0.1)
LEISURELY = Clocks(joint=0.2, pose=0.25, slow=5.0)
# A trigger lets the device and the encoders read at once.
TRIGGERED = Clocks(joint=0.01, pose=0.2, offset=0.0)

NOMINAL, FINE_NOMINAL = "config/delta_mockup_nominal.yaml", "bags/models/delta54_fine.yaml"
MODEL_24 = "bags/models/delta24.yaml"
STEEL, ALUMINIUM, CARBON = 11.7e-6, 23e-6, 1e-6  # 1/K


def delta(
    about: str,
    seed: int,
    *effects: Effect,
    machine: Machine = DELTA,
    day: Callable[[int], Day] = days.brisk,
    clocks: Clocks = LIVELY,
    baseline: str = NOMINAL,
    found: str = "",
) -> Bag:
    """A recording of the Delta robot; the effects to be found are named in one string."""
    verdict = "explained" if found else "at_noise"
    names = tuple(found.split())
    return Bag(about, seed, effects, machine, day, clocks, baseline, verdict, names)


def fine(about: str, seed: int, *effects: Effect, found: str, day: Callable[[int], Day]) -> Bag:
    """The same with finer instruments, which see what is less than the mock-up's noise."""
    clocks = LIVELY if day is days.wide else LEISURELY
    return delta(
        about,
        seed,
        *effects,
        machine=FINE_DELTA,
        day=day,
        clocks=clocks,
        baseline=FINE_NOMINAL,
        found=found,
    )


CLEAN = delta("geometry errors only", 1, clocks=Clocks())

RECORDINGS: Mapping[str, Bag] = {
    "delta_clean": CLEAN,
    "delta_clean_sqlite": replace(
        CLEAN, about="the messages of `delta_clean`, stored as sqlite3", sqlite=True
    ),
    "delta_eccentricity": delta(
        "encoder discs off-centre by 2 mrad (40 um on a disc of 20 mm radius)",
        2,
        EncoderEccentricity(sin=(1.8e-3, -1.05e-3, 0.6e-3), cos=(-0.85e-3, 1.7e-3, 1.9e-3)),
        clocks=Clocks(),
        found="encoder_eccentricity|encoder_second_harmonic|encoder_gain",
    ),
    "delta_eccentricity_faint": delta(
        "encoder discs off-centre by 0.4 mrad, which the geometry reproduces within the noise",
        2,
        EncoderEccentricity(sin=(0.36e-3, -0.21e-3, 0.12e-3), cos=(-0.17e-3, 0.34e-3, 0.38e-3)),
        clocks=Clocks(),
    ),
    "delta_eccentricity_fine": fine(
        "encoder discs off-centre by 1 mrad, measured with finer instruments",
        18,
        EncoderEccentricity(sin=(0.9e-3, -0.52e-3, 0.3e-3), cos=(-0.42e-3, 0.85e-3, 0.95e-3)),
        day=days.wide,
        found="encoder_eccentricity|encoder_second_harmonic|encoder_gain",
    ),
    "delta_backlash": delta(
        "backlash of 0.2 to 0.3 mrad in the gears",
        3,
        Backlash(width=(0.30e-3, 0.20e-3, 0.25e-3)),
        clocks=Clocks(),
        found="backlash|hysteresis",
    ),
    "delta_gear_ripple": delta(
        "gear errors of 0.3 to 0.45 mrad, 23.7 periods per turn of the arm",
        17,
        GearRipple(amplitude=(0.45e-3, 0.30e-3, 0.38e-3), phase=(0.3, 1.9, -1.1), ratio=23.7),
        found="gear_transmission_error",
    ),
    "delta_compliance": delta(
        "shafts that twist by about 1 mrad/Nm; payloads of 0.2 and 1.2 kg in turn",
        5,
        JointCompliance(compliance=(1.0e-3, 0.8e-3, 1.2e-3)),
        day=days.loaded,
        found="joint_compliance|rod_compliance",
    ),
    "delta_thermal": fine(
        "arms of aluminium, rods of carbon fibre, a base of steel; temperature changes of 8 K",
        6,
        ThermalGrowth(arms=ALUMINIUM, rods=CARBON, base=STEEL),
        day=days.slow(days.wandering),
        found="thermal_expansion",
    ),
    "delta_drift": delta(
        "base drift of 90 um and 0.3 mrad; the temperature is constant",
        7,
        BaseDrift(v=(6e-8, -4e-8, 5e-8), w=(1.0e-7, -1.5e-7, 2.0e-7)),
        day=days.slow(days.steady),
        clocks=LEISURELY,
        found="base_drift",
    ),
    "delta_squareness": fine(
        "a device with squareness errors of 0.2 to 0.3 mrad; poses in the whole reach of the robot",
        8,
        LeaningAxes(xy=3.0e-4, xz=-2.4e-4, yz=1.8e-4),
        day=days.wide,
        found="device_axes",
    ),
    "delta_tilting": delta(
        "geometry errors only, including those that tilt the platform, which model 24 ignores",
        9,
        baseline=MODEL_24,
        found="parallelogram_errors",
    ),
    "delta_latency": replace(
        delta(
            "poses stamped 1 ms late, on a path without stops at 0.04 to 0.25 m/s",
            10,
            LateStamp(delay=1e-3),
            machine=MOVING_DELTA,
            day=days.Sweep,
            clocks=TRIGGERED,
            found="latency",
        ),
        mode="continuous",
    ),
    "delta_backlash_thermal": fine(
        "backlash of 0.04 to 0.06 mrad, and the materials of `delta_thermal`",
        11,
        Backlash(width=(0.06e-3, 0.04e-3, 0.05e-3)),
        ThermalGrowth(arms=ALUMINIUM, rods=CARBON, base=STEEL),
        day=days.slow(days.wandering, n_poses=90),
        found="thermal_expansion backlash|hysteresis",
    ),
    "delta_crosstalk": replace(
        delta(
            "reading errors periodic in the next joint's angle; no effect of the catalogue",
            20,
            CrossTalk(amplitude=(0.5e-3, 0.4e-3, 0.45e-3), waves=7.0),
        ),
        verdict="unexplained",
    ),
    "delta_warming": fine(
        "all parts of steel, warming up steadily by 7 K: thermal expansion looks like base drift",
        16,
        ThermalGrowth(arms=STEEL, rods=STEEL, base=STEEL),
        day=days.slow(days.warming),
        found="thermal_expansion|base_drift",
    ),
    "argos_gear_ripple": Bag(
        "Argos (table 5.22), orientations only; gear errors of 0.35 to 0.45 mrad",
        13,
        (GearRipple(amplitude=(0.45e-3, 0.35e-3, 0.40e-3), phase=(0.3, 1.9, -1.1), ratio=17.3),),
        ARGOS,
        days.turning,
        LIVELY,
        "bags/models/argos9.yaml",
        "explained",
        ("gear_transmission_error",),
    ),
    "stewart_backlash": Bag(
        "hexapod with balls off by 0.5 mm; backlash of 20 to 35 um in the spindles",
        14,
        (Backlash(width=(30e-6, 20e-6, 25e-6, 35e-6, 25e-6, 30e-6)),),
        HEXAPOD,
        days.climbing,
        LIVELY,
        "bags/models/stewart42.yaml",
        "explained",
        ("backlash|hysteresis",),
    ),
}
