"""Plant faults in the package, one at a time, and report which of them the nearest tests find.

A test suite is worth what it finds. Each mutant below is one plausible mistake: a guard that is
gone, a sign, a unit, a limit. It is planted in a copy of the repository, and the tests nearest to
it run there; the working tree is not touched. A mutant that survives needs a test.

    python test/project/mutants.py                all of them, by the tests of `make test`
    python test/project/mutants.py --wide         those that survive, by the tests of `make wide`
    python test/project/mutants.py journal prior  those whose file or words have one of these
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "parallel_cal"
QUICK, WIDE = "not slow and not wide", "wide and not slow"
# Neither sources nor data of tests.
NOT_COPIED = (".git", ".venv", "build", "install", "log", "*_cache", "__pycache__", ".hypothesis")
KILLED, SURVIVED, NOT_JUDGED = "killed", "SURVIVED", "NOT JUDGED"
PASSED, NO_TESTS = 0, 5  # exit statuses of pytest
MAX_SECONDS = 600.0  # for the tests of one mutant: a fault that never ends is found, too


class MutantError(Exception):
    """A mutant cannot be planted, or its tests cannot run."""


@dataclass(frozen=True)
class Mutant:
    """A fault: in `file` of the package, `old` becomes `new`. `breaks` says what is lost. `tests`
    are the nearest ones, by file anywhere in test/, with `::name` for one of them."""

    file: str
    old: str
    new: str
    breaks: str
    tests: str

    def __str__(self) -> str:
        return f"{self.file}: {self.breaks}"

    @property
    def room(self) -> str:
        return self.file.split("/")[0]

    def apply(self, text: str) -> str:
        """Return the text of the file with the fault; MutantError unless it has one place."""
        places = text.count(self.old)
        if places != 1:
            raise MutantError(
                f"{PACKAGE}/{self.file}: expected once the text of the mutant "
                f"'{self.breaks}', found it {places} times. The code has changed: state the fault "
                f"anew in test/project/mutants.py. The text was:\n{self.old}"
            )
        return text.replace(self.old, self.new)

    def find_tests(self, root: Path) -> list[str]:
        """Return the paths of the tests in the repository at `root`; MutantError without one."""
        found = []
        for test in self.tests.split():
            file, *name = test.split("::")
            paths = list((root / "test").rglob(file))
            if len(paths) != 1:
                raise MutantError(f"{self}: expected one {file} in test/, found {len(paths)}")
            found.append("::".join([str(paths[0].relative_to(root)), *name]))
        return found


MUTANTS = (
    Mutant(
        "mechanisms/chain.py",
        "        if self._chose_controls and not inside.all():\n",
        "        if False:\n",
        "a workspace in metres is one of angles",
        "test_chain_controls.py",
    ),
    Mutant(
        "mechanisms/chain.py",
        "        if regular[0] < MIN_REGULARITY * regular.max():\n",
        "        if False:\n",
        "a chain begins where two assembly modes meet",
        "test_chain.py test_closed_chain_files.py",
    ),
    Mutant(
        "model/structure.py",
        "        return self.phi + self.beyond\n",
        "        return self.phi\n",
        "a wrist with open loops is a solution",
        "test_redundant_loops.py",
    ),
    Mutant(
        "exporting/targets/mjcf.py",
        "        if np.abs(apart).max() > ROUNDING_TOLERANCE:\n            raise",
        "        if False:\n            raise",
        "the target moves the end of a loop that has the same site",
        "test_closed_chain_files.py",
    ),
    Mutant(
        "base/rotation.py",
        "    q /= np.where(w < 0, -size, size)[:, None]\n",
        "    q /= size[:, None]\n",
        "quaternions of many matrices may have w < 0",
        "test_rotation.py",
    ),
    Mutant(
        "base/keyed_warning.py",
        "return warning.kind, warning.subject",
        'return warning.kind, ""',
        "a warning about one joint hides that about another",
        "test_keyed_warning.py test_health.py",
    ),
    Mutant(
        "campaign/deviation.py",
        "limit = max(MAX_PATH_DEVIATION, 0.5 * first)",
        "limit = MAX_PATH_DEVIATION",
        "a joint that another one drags along is blamed, too",
        "test_deviation.py",
    ),
    Mutant(
        "campaign/cartesian.py",
        "np.maximum(np.abs(v).max(axis=0), np.abs(turning).max(axis=0))",
        "np.abs(v).max(axis=0)",
        "a joint exceeds its velocity between two points of a path",
        "test_cartesian_path.py",
    ),
    Mutant(
        "campaign/cartesian.py",
        "    for order in (1, -1):\n        x, d, b",
        "    for order in (1,):\n        x, d, b",
        "a path is not timed backwards from its end: it cannot stop there",
        "test_cartesian_path.py",
    ),
    Mutant(
        "campaign/cartesian.py",
        "return Trajectory(stretch * time, q, velocities / stretch)",
        "return Trajectory(time, q, velocities)",
        "the cubics between the points of a path exceed the limits",
        "test_cartesian_path.py",
    ),
    Mutant(
        "campaign/path_guard.py",
        "if (why := self.find_violation(self.points(a, b))) is None:",
        "if (why := self.find_violation(np.stack([a, b]))) is None:",
        "only the ends of a path are checked",
        "test_campaign_way.py test_way.py",
    ),
    Mutant(
        "campaign/path_guard.py",
        "found.append(BACKLASH_SAFETY_FACTOR * backlash or DEFAULT_BACKLASH[unit])",
        "found.append(DEFAULT_BACKLASH[unit])",
        "a known backlash does not lengthen the approach",
        "test_campaign_way.py test_way.py test_campaign.py",
    ),
    Mutant(
        "campaign/judging.py",
        "if before is None or self.suspected or set(self.doubt) - set(self.untold):",
        "if before is None or self.suspected:",
        "a campaign ends although poses would resolve a doubt",
        "test_campaign_checking.py test_campaign.py test_campaign_laws.py",
    ),
    Mutant(
        "causes/effects.py",
        "prior = LOG_PRIOR - np.log(FORMS) if effect.found_in_data else LOG_ODDS",
        "prior = LOG_ODDS",
        "a law found in the data does not pay for the forms that were tried",
        "test_posterior.py test_discovery.py",
    ),
    Mutant(
        "causes/effects.py",
        "settings = [known[name]] if known.get(name) else settings",
        "settings = list(settings)",
        "an effect whose ratio the owner states is tested with all others",
        "test_posterior.py test_diagnosing.py",
    ),
    Mutant(
        "cli/main.py",
        'return bool([float(part) for part in word.split(",")])',
        "return bool(float(word))",
        "values with commas are refused, and so is a zero",
        "test_cli.py test_front_door.py",
    ),
    Mutant(
        "diagnosis/addition.py",
        "            doubtful, doubt = self._find_doubt()\n",
        "            pass\n",
        "`add` accepts an effect that the device may cause",
        "test_diagnosis_and_add.py test_robot_or_device.py",
    ),
    Mutant(
        "diagnosis/comparison.py",
        "doubts = filter(None, (given.observations.doubts, given.doubted_columns))",
        "doubts = filter(None, (given.observations.doubts,))",
        "a comparison is silent about exchanged columns",
        "test_implausible_readings.py::test_a_comparison_warns_in_the_words_with_which_a_fit_refuses",
    ),
    Mutant(
        "diagnosis/device.py",
        "return [name for name in doubtful if among_all.get(name, 0.0) < CREDIBLE]",
        "return doubtful",
        "an effect is doubted although it is certain among all causes",
        "test_robot_or_device.py",
    ),
    Mutant(
        "diagnosis/noise.py",
        "if variance is None or (structured if variance > 1 else correlated):",
        "if variance is None or (structured and variance > 1):",
        "visits that share their noise make it smaller than stated",
        "test_diagnosis_noise.py test_noise_shape.py",
    ),
    Mutant(
        "diagnosis/noise_shape.py",
        "return certain and self.inflation > MIN_INFLATION",
        "return certain",
        "correlation that changes no sigma is reported",
        "test_noise_shape.py test_diagnosis_noise.py",
    ),
    Mutant(
        "diagnosis/patterns.py",
        "    return frozenset(numbers) - guilty\n",
        "    return frozenset()\n",
        "a sample that an effect explains stays excluded",
        "test_diagnosis_and_add.py::test_what_only_another_model_took_for_knocked_is_taken_back",
    ),
    Mutant(
        "discovery/proof.py",
        "if not against and not choice.is_clear:",
        "if False:",
        "a law whose form the held-out poses chose is accepted",
        "test_discovery.py test_discovery_doors.py",
    ),
    Mutant(
        "effects/payload_sag.py",
        'weight = at["payload"] * ca.DM(mechanism.gravity)',
        "weight = ca.DM(mechanism.gravity)",
        "the frame sinks without a payload, and no deeper with one",
        "test_effects_load.py test_effects.py",
    ),
    Mutant(
        "effects/_statics.py",
        "seen.with_q(seen.q + ca.vertcat(*twists))",
        "seen.with_q(seen.q - ca.vertcat(*twists))",
        "a shaft turns against its load",
        "test_effects_load.py",
    ),
    Mutant(
        "effects/base_drift.py",
        "undo_shift_and_turn(seen, e, at.time)",
        "undo_shift_and_turn(seen, e, at.time / 3600)",
        "drift per second is taken per hour",
        "test_effects_joint.py test_drift.py",
    ),
    Mutant(
        "effects/hysteresis.py",
        'at["travel"][joint] / e[joint].width',
        'at["travel"][joint] * e[joint].width',
        "the lag builds up over the inverse of its width",
        "test_effects_joint.py",
    ),
    Mutant(
        "effects/_statics.py",
        "moment = sum((length * (foot + head) / 2 for",
        "moment = sum((length * head for",
        "a link weighs at its end, not in its middle",
        "test_effects_arm.py test_effects_load.py",
    ),
    Mutant(
        "exporting/bed_fit.py",
        "moves = np.where(unreached, 0.0, self.moves(firmware, places))",
        "moves = self.moves(firmware, places)",
        "a point beyond the reach of the new numbers ends an export",
        "test_export_bed_fit.py test_export_heights.py",
    ),
    Mutant(
        "exporting/heights.py",
        "return self.before is not None and self.after > self.before + ROUNDING",
        "return False",
        "an export that makes the bed worse is written",
        "test_export_heights.py",
    ),
    Mutant(
        "exporting/targets/klipper.py",
        '% 360, "position_endstop": heights / MM}',
        '% 360, "position_endstop": heights}',
        "end-stops in m in a file of mm",
        "test_export_klipper.py test_export_firmware.py test_export_forward.py",
    ),
    Mutant(
        "fleet/drift.py",
        "return Trend(k, rate / span, sigma * scatter**0.5 / span, gain, min(1.0, p * n_tested))",
        "return Trend(k, rate / span, sigma / span, gain, min(1.0, p * n_tested))",
        "the sigma of a drift ignores that recordings scatter",
        "test_fleet_population.py",
    ),
    Mutant(
        "fleet/drift.py",
        "gain, min(1.0, p * n_tested))",
        "gain, p)",
        "a drift is as significant as if one parameter had been tested",
        "test_fleet_population.py",
    ),
    Mutant(
        "identification/registration.py",
        "return bool(significant and smaller and (identified or self.are_far_apart(found)))",
        "return bool(smaller and (identified or self.are_far_apart(found)))",
        "chance moves the frame of a device",
        "test_registration.py test_stations.py test_registration_planar.py test_base_frame.py",
    ),
    Mutant(
        "identification/acceptance.py",
        "    if harm <= MAX_HARM:",
        "    if True:",
        "an update that may make the robot worse is written",
        "test_recheck.py",
    ),
    Mutant(
        "identification/acceptance.py",
        "    if chi2 <= usual * chi2_band(new.estimate.dof)[1]:",
        "    if True:",
        "a knocked sample is taken for a drift",
        "test_recheck.py",
    ),
    Mutant(
        "identification/acceptance.py",
        "clearly = rise > 0 or fall.mean() > uncertainty",
        "clearly = True",
        "a fall of the error within its uncertainty is accepted",
        "test_acceptance.py",
    ),
    Mutant(
        "identification/acceptance.py",
        "        clearly = exceeds_noise and change.mean() > change.std() / np.sqrt(len(change))",
        "        clearly = False",
        "the position error may fall at the cost of the orientation error",
        "test_acceptance.py",
    ),
    Mutant(
        "identification/column_doubts.py",
        "numbers = few.x, few.S,",
        "numbers = few.S,",
        "what other samples may mean is said of these",
        "test_column_doubts.py::test_guesses_about_other_samples_are_judged_anew",
    ),
    Mutant(
        "identification/column_doubts.py",
        "        if error * MIN_GUESS_ERROR_RATIO < before\n",
        "        if error < before\n",
        "another machine is taken for one whose motors are in the wrong columns",
        "test_column_doubts.py::test_no_other_meaning_is_named_that_explains_hardly_more_than_the_given_one",
    ),
    Mutant(
        "identification/column_doubts.py",
        "        and poses.find_unexplained_share() < MAX_GUESS_SHARE\n",
        "",
        "a guess is named that leaves most of the motion unexplained",
        "test_column_doubts.py",
    ),
    Mutant(
        "identification/column_doubts.py",
        '>= most:\n        return ""',
        '>= np.inf:\n        return ""',
        "exchanged columns are named although gains explain the samples better",
        "test_column_doubts.py",
    ),
    Mutant(
        "identification/column_doubts.py",
        "F = replace(given, measured=given.measured & PLACE).frames.F",
        "F = given.frames.F",
        "wrong orientations turn the device, too",
        "test_implausible_readings.py test_unexplained_motion.py",
    ),
    Mutant(
        "identification/outliers.py",
        "return found if few else found[:0], sizes",
        "return found, sizes",
        "half of the samples are outliers of the other half",
        "test_outliers.py test_machine_class.py",
    ),
    Mutant(
        "identification/fit_warnings.py",
        "    tail = SIGNIFICANCE_LEVEL / 2\n",
        "    tail = SIGNIFICANCE_LEVEL\n",
        "the band of chi2/dof holds 98 % of complete models",
        "test_identification.py test_verdicts.py test_diagnosis_noise.py",
    ),
    Mutant(
        "imaging/detection.py",
        "wrong = residuals > max(MIN_OUTLIER_PX, MIN_OUTLIER_SIGMAS * sigma)",
        "wrong = residuals > np.inf",
        "a displaced corner of a board is used",
        "test_detection.py",
    ),
    Mutant(
        "importing/deltas.py",
        "tops = np.asarray(heights) * MM + np.sqrt(long**2 - out**2)",
        "tops = np.asarray(heights) * MM + long",
        "carriages at the height of rods that hang straight",
        "test_import_klipper.py test_import_marlin.py test_import_printers.py",
    ),
    Mutant(
        "importing/deltas.py",
        "return np.where(np.abs(step).max(axis=1, keepdims=True) > CLOSE, np.nan, r)",
        "return r",
        "motors that the rods do not allow have a place, too",
        "test_import_distances.py test_export_bed_fit.py test_import_klipper.py",
    ),
    Mutant(
        "importing/importers/klipper.py",
        'read = next(k for k in itertools.count() if f"{TOUCHES} {name}{k}" not in stated)',
        'read = sum(f"{TOUCHES} {name}{k}" in stated for k in range(99))',
        "touches behind a gap are read under the wrong numbers",
        "test_import_klipper.py",
    ),
    Mutant(
        "kinematics/newton.py",
        "pivot = solver.pivot * solver.side",
        "pivot = solver.pivot",
        "a solution of another branch counts as solved",
        "test_branch.py test_kinematics.py test_singularity.py test_solvers_agree.py",
    ),
    Mutant(
        "mechanisms/five_bar.py",
        '("q0", "rad", 0.0, 1 * DEGREE, "encoder offset"),',
        '("q0", "rad", 0.0, 1 * MM, "encoder offset"),',
        "the tolerance of an encoder's zero is 0.06 degrees",
        "test_mechanisms_small.py test_every_mechanism.py",
    ),
    Mutant(
        "kinematics/problem.py",
        "        robot = model.structure.robot\n",
        "        robot = model.structure\n",
        "every place of a device has solvers of its own",
        "test_content.py",
    ),
    Mutant(
        "model/content.py",
        '        vars(self).pop("content", None)\n',
        "        pass\n",
        "a mechanism that is changed keeps the equations of the one before",
        "test_content.py",
    ),
    Mutant(
        "model/structure.py",
        "self.mechanism, self.content = copy(mechanism), mechanism.content",
        "self.mechanism, self.content = mechanism, mechanism.content",
        "a mechanism that is changed changes the equations of other models",
        "test_content.py",
    ),
    Mutant(
        "model/parameters.py",
        "low, high = (self.nominal + times * (v - self.nominal) for v in (self.low, self.high))",
        "low, high = self.low, self.high",
        "a smaller tolerance leaves the bounds of the larger one",
        "test_own_tolerances.py test_modelfile.py",
    ),
    Mutant(
        "model/parameters.py",
        "slack = RANGE_MARGIN_SIGMAS * sigma if sigma > 0 else 0.0",
        "slack = 0.0",
        "a zero backlash with noise is implausible",
        "test_own_tolerances.py test_unusual_sizes.py",
    ),
    Mutant(
        "nodes/live_samples.py",
        "            self._journal.keep(self.collector.entries())\n",
        "            pass\n",
        "the journal is never kept",
        "test_live_samples.py test_journal.py",
    ),
    Mutant(
        "nodes/journal.py",
        'if any("ended" in line for line in lines):',
        "if False:",
        "a session that ended in order is resumed by the next one",
        "test_journal.py",
    ),
    Mutant(
        "planning/plan.py",
        "return sets[int(np.argsort(costs)[RANDOM_SETS // 2])]",
        "return sets[int(np.argsort(costs)[-1])]",
        "a plan is compared with the worst random poses",
        "test_planning.py test_planned_measurements.py",
    ),
    Mutant(
        "posterior/search.py",
        "return float(LOG_ODDS) if self.stated and nu == UNKNOWN else 0.0",
        "return 0.0",
        "doubt of a stated noise costs nothing",
        "test_posterior.py test_diagnosis_noise.py test_noise_shape.py test_blocks.py",
    ),
    Mutant(
        "posterior/evidence.py",
        "return np.asarray(known - log_det / 2 - (nu + d) / 2 * rest)",
        "return np.asarray(known - (nu + d) / 2 * rest)",
        "a cause pays nothing for its freedom",
        "test_posterior.py test_blocks.py",
    ),
    Mutant(
        "recordings/replicates.py",
        "    fold = fold_of[np.searchsorted(names, groups)]\n",
        "    fold = np.arange(len(groups)) % count\n",
        "visits of one pose are in the fit and in the held-out poses",
        "test_dataset.py test_identification.py test_held_out_uncertainty.py",
    ),
    Mutant(
        "recordings/dwells.py",
        "return int(np.sign(level - before[begin + far[-1]]))",
        "return int(np.sign(before[begin + far[-1]] - level))",
        "joints come from the other side",
        "test_bag.py test_dataset.py test_simulate.py test_properties.py",
    ),
    Mutant(
        "recordings/bag.py",
        "connections=asked if stored else connections",
        "connections=connections",
        "rosbags passes over a topic whose quality of service was edited",
        "test_rosbag2_truth.py",
    ),
    Mutant(
        "importing/sdf.py",
        "if self.placement else placed",
        "if False else placed",
        "the placement_frame of an SDF is ignored",
        "test_sdf_truth.py",
    ),
    Mutant(
        "importing/importers/smoothieware.py",
        "if path not in included:",
        "if True:",
        "a file that is given and included counts behind the keys of config",
        "test_formats_truth.py::test_a_file_given_beside_the_config_that_includes_it_is_read_at_its_place",
    ),
    Mutant(
        "recordings/lagged.py",
        "behind = time_constant * (now - before) / step",
        "behind = 0.0",
        "a lagged temperature jumps at every sample",
        "test_lagged_conditions.py",
    ),
    Mutant(
        "reporting/certificate.py",
        "if self.error + self.expanded_uncertainty <= self.limit:",
        "if self.error <= self.limit:",
        "a robot within its uncertainty of the limit passes",
        "test_certificate.py",
    ),
    Mutant(
        "sensors/probe.py",
        "upright = ca.dot(turn[:, 2], R[:, 2]) if self.mounted else 1",
        "upright = 1",
        "a gauge on a tilted platform measures along the plate's normal",
        "test_effects_touch.py test_sensors.py",
    ),
    Mutant(
        "session/history.py",
        "self._move(record, record.state.parent, ahead)",
        "self._move(record, record.state.parent, [])",
        "an undone step cannot be redone",
        "test_session.py test_undo.py",
    ),
    Mutant(
        "session/saving.py",
        "    if state.against:\n        objections.append(state.against)\n",
        "",
        "a refused step is saved without a question",
        "test_session.py test_sessions.py test_undo.py",
    ),
    Mutant(
        "short_cut/combining.py",
        "lambda u: np.append(stacked(values(u))[0], u),",
        "lambda u: np.append(stacked(values(u))[0], 0 * u),",
        "loops are combined without the tolerances as priors",
        "test_short_cut.py",
    ),
    Mutant(
        "study/power.py",
        "            if one.share < share:\n                break\n",
        "            if one.share < share:\n                continue\n",
        "a size counts as detectable although a larger one is not found",
        "test_study_power.py",
    ),
    Mutant(
        "study/tolerance.py",
        "    values = np.where(values < low, 2 * low - values, values)\n",
        "",
        "half of the drawn robots have exactly no backlash",
        "test_study_tolerance.py",
    ),
    Mutant(
        "virtual/drive.py",
        "return a + rise * (b - a) + s * (1 - s) * ((1 - s) * va - s * vb)",
        "return a + rise * (b - a)",
        "set points stop at every point of a trajectory",
        "test_virtual_cell.py test_drives.py",
    ),
    Mutant(
        "workbench/next_step.py",
        'if offered := view["offered"]:',
        'if False and (offered := view["offered"]):',
        "the page does not offer the effect that is missing",
        "test_workbench.py test_first_screen.py",
    ),
    Mutant(
        "watch/changes.py",
        "    after = t[None, :] >= t[:, None]\n",
        "    after = t[None, :] > t[:, None]\n",
        "a change begins one recording after the one that shows it first",
        "test_watch.py",
    ),
    Mutant(
        "thesis/methods/linear.py",
        "    values[free] += step\n",
        "    values[free] -= step\n",
        "linear calibration steps away from the solution",
        "test_methods.py",
    ),
)


@contextmanager
def planted(mutant: Mutant, root: Path) -> Iterator[None]:
    """Have a mutant in the repository at `root`."""
    path = root / PACKAGE / mutant.file
    sound = path.read_text()
    path.write_text(mutant.apply(sound))
    try:
        yield
    finally:
        path.write_text(sound)


def run_tests(tests: Sequence[str], root: Path, marks: str = "") -> tuple[str, list[str]]:
    """Run tests with these marks in the repository at `root` until the first one fails; return
    whether one did, and its name."""
    options = ["-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", "-m", marks]
    environment = os.environ | {
        "PYTHONPATH": str(root),  # before the package that is installed
        "PYTHONDONTWRITEBYTECODE": "1",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    try:
        ran = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *tests],
            **{"cwd": root, "env": environment, "capture_output": True, "text": True},
            timeout=MAX_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return KILLED, []
    failed = re.findall(r"^(?:FAILED|ERROR) (test/.*?)(?: - .*)?$", ran.stdout, re.MULTILINE)
    if failed:
        return KILLED, failed
    if ran.returncode in (PASSED, NO_TESTS):
        return SURVIVED, []
    raise MutantError(f"pytest ended with {ran.returncode}\n{ran.stdout[-2000:]}{ran.stderr}")


def judge(mutant: Mutant, root: Path, marks: Sequence[str]) -> tuple[str, str]:
    """Return whether the mutant's tests with one of the marks find it, and which test does.

    MutantError if that test fails without the mutant, too."""
    tests = mutant.find_tests(root)
    for mark in marks:
        with planted(mutant, root):
            word, failed = run_tests(tests, root, mark)
        if word == SURVIVED:
            continue
        if failed and run_tests(failed, root)[0] == KILLED:
            raise MutantError(f"{mutant}: {failed[0]} fails without this mutant, too")
        return KILLED, failed[0] if failed else f"no end after {MAX_SECONDS:.0f} s"
    return SURVIVED, mutant.tests


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", help="only mutants whose file or words contain one")
    parser.add_argument("--wide", action="store_true", help="survivors also by the wide tests")
    asked = parser.parse_args()
    chosen = [m for m in MUTANTS if not asked.words or any(w in str(m) for w in asked.words)]
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / ROOT.name
        shutil.copytree(ROOT, root, ignore=shutil.ignore_patterns(*NOT_COPIED), symlinks=True)
        for number, mutant in enumerate(chosen, 1):
            start = time.monotonic()
            try:
                word, why = judge(mutant, root, (QUICK, WIDE) if asked.wide else (QUICK,))
            except MutantError as error:
                word, why = NOT_JUDGED, str(error)
            survivors += word != KILLED
            took = time.monotonic() - start
            print(f"{number:3d} {word:10s} {mutant} ({took:.0f} s, {why})", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} killed")
    return min(survivors, 1)


if __name__ == "__main__":
    sys.exit(main())
