"""A calibrated robot is followed through ordinary recordings. The true machine is a hexapod with a
seventh leg, made of points and distances (test_extra_legs)."""

import json
import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import test_extra_legs as hexapod

from parallel_cal.base.errors import DatasetError, FitError
from parallel_cal.base.files import open_locked
from parallel_cal.cli.main import main
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.watching import describe_watch, document_watch
from parallel_cal.watch import changes
from parallel_cal.watch.changes import (
    CHANGES,
    DRIFT,
    LOG_SCATTERS,
    MONTH,
    SCATTERS,
    STEP,
    Fit,
    Series,
    weigh,
)
from parallel_cal.watch.state import read_state, write_state
from parallel_cal.watch.visit import SIZES, Evidence, Innovation, Visit
from parallel_cal.watch.watch import DAY, Watch

START, LEGS = 1.7e9, 7  # s since 1970
NAMES = [f"leg{i + 1}" for i in range(LEGS)]


@cache
def calibrated():
    return hexapod.identified(LEGS, 0).model


def recording(day, jump=0.0, leg=2, loose=0.0, n=30):
    """Leg lengths of one day; the zero of a leg has jumped, or its joint is loose."""
    base, platform, zero = hexapod.built(LEGS, 0)
    rng = np.random.default_rng([day, 9])
    r, R = hexapod.poses(100 + day, n)
    q = hexapod.distances(base, platform, r, R) - zero + rng.normal(0, hexapod.SIGMA, (n, LEGS))
    q[:, leg] += rng.normal(0, loose, n) - jump
    conditions = {"time": START + DAY * day + np.arange(n)}
    return Dataset.from_arrays(
        NAMES,
        q,
        np.zeros((n, 3)),
        measured=np.zeros((n, 6), bool),
        joint_sigma=hexapod.SIGMA,
        conditions=conditions,
        source=f"day{day}",
    )


def followed(recordings, model=None):
    watch = Watch(model or calibrated())
    for day, dataset in enumerate(recordings):
        watch = watch.add(dataset, START + DAY * day)
    return watch


def bare_visit(time, pull, information=1.0, squares=None, rows=50):
    """One recording about one parameter."""
    pull = np.atleast_1d(pull).astype(float)
    A = information * np.eye(len(pull))
    names = tuple(f"leg{k}.zero" for k in range(len(pull)))
    none = np.zeros((len(pull) + 1, len(SIZES)))
    squares = float(rows) if squares is None else squares
    evidence, innovation = (
        Evidence(names, A, pull, squares, rows),
        Innovation(0.0, 0, none, none, 0),
    )
    return Visit(f"at {time}", "", time, rows, evidence, innovation, known_noise=True)


def series_of(*visits):
    return Series(tuple(visits), (np.eye(len(visits[0].names)),))


def test_the_bayes_factor_is_that_of_a_calculation_by_hand():
    """A = 1 in both recordings, pulls 0 and 6, prior variance 1: V = 1 / (1 + 2) = 1/3, so
    u = 6 - 6/3 = 4 and m = 1 - 1/3 = 2/3; C = 200 + 100 + 36 - 6^2/3 = 324, D = 300."""
    fit = Fit.of(
        series_of(bare_visit(0, 0), bare_visit(DAY, 6, squares=86.0)).absorb(0.0), np.eye(1)
    )
    u, m = fit.score(np.array([[0.0, 1.0]]))
    assert (u.item(), m.item()) == pytest.approx((4.0, 2 / 3))
    assert fit.D == 300
    assert abs(fit.C - (200 + 136 - 12)) < 1e-9
    k = list(CHANGES).index(1.0)
    by_hand = -np.log(5 / 3) / 2 - 150 * np.log(1 - 16 / (5 / 3) / 324)
    assert fit.log_bayes(u, m)[0, 0, k] == pytest.approx(by_hand)


def test_scatter_between_recordings_is_that_of_larger_noise():
    """One parameter with information 1: scatter w leaves 1 / (1 + w^2) of it."""
    fit = Fit.of(series_of(bare_visit(0, 2), bare_visit(DAY, 6)).absorb(3.0), np.eye(1))
    assert fit.information.ravel() == pytest.approx([0.1, 0.1])
    assert fit.pull.ravel() == pytest.approx([0.2, 0.6])


def test_the_statistic_is_a_likelihood_ratio(monkeypatch):
    """With L = R(t) / t, the mean of 1 / L is 1 if everything unknown, and a change, is drawn from
    its prior. It means that the mean of L is 1 without a change, which is hard to see: most of that
    mean comes from rare events. Parts that scatter are left out: theirs is a lower bound."""
    monkeypatch.setattr(changes, "KINDS", {STEP: 2 / 3, DRIFT: 1 / 3})
    rng, days, A, inverse = np.random.default_rng(1), 4, 20.0, []
    for _ in range(800):
        noise = 200 / rng.chisquare(200)
        scatter = rng.choice(SCATTERS, p=np.exp(LOG_SCATTERS))
        drifts = rng.choice(2, p=[2 / 3, 1 / 3])
        size, onset, parameter = rng.choice(CHANGES), rng.integers(1, days), rng.integers(2)
        begins = np.maximum(np.arange(days) - onset + 1, 0) * (DAY / MONTH)
        change = rng.normal() * size * (begins if drifts else np.arange(days) >= onset)
        constant, visits = rng.normal(size=2), []
        for day in range(days):
            p = constant + scatter * rng.normal(size=2)
            p[parameter] += change[day]
            seen = A**0.5 * p + rng.normal(size=2)  # two of 50 residuals tell
            squares = noise * (seen @ seen + rng.chisquare(48))
            visits.append(bare_visit(day * DAY, (noise * A) ** 0.5 * seen, A, squares))
        inverse.append((days - 1) * DAY / np.exp(weigh(series_of(*visits)).log_statistic))
    spread = np.std(inverse) / len(inverse) ** 0.5
    assert np.mean(inverse) == pytest.approx(1, abs=3 * spread)
    assert spread < 0.03


def test_a_zero_that_jumps_is_named_with_its_size_and_its_day():
    watch = followed([recording(day, 150e-6 * (day >= 8)) for day in range(10)])
    assert watch.alarm.recording == "day8"
    part, probability = next(iter(watch.parts.items()))
    assert (part, probability > 0.95) == ("leg3", True)
    best = watch.suspects[0]
    assert (best.parameter, best.kind, best.unit) == ("leg3.L0", STEP, "m")
    assert abs(best.value - 150e-6) < 3 * best.sigma
    assert best.sigma < 20e-6
    assert watch.since("leg3") == (START + 7 * DAY, START + 8 * DAY)
    value, sigma = watch.estimate("leg3.L0")
    z = (value - 150e-6 * (np.arange(10) >= 8)) / sigma
    assert np.abs(z).max() < 3.5


def test_a_zero_that_the_fit_held_is_named_all_the_same():
    """Its value stands for others only until it changes: then no other part explains it."""
    model = calibrated()
    held = np.array(model.fixed)
    held[model.table.index_of("leg3.L0")] = True
    days = [recording(day, 150e-6 * (day >= 6)) for day in range(8)]
    watch = followed(days, replace(model, fixed=held))
    assert watch.alarm.recording == "day6"
    assert watch.parts["leg3"] > 0.95


def test_without_a_change_there_is_no_alarm():
    watch = followed([recording(day) for day in range(12)])
    assert watch.alarm is None
    assert watch.trend[-1].statistic < 30 * DAY


def test_residuals_larger_than_the_stated_noise_make_the_answer_doubtful():
    """Alarms are as rare as stated only if the model describes the robot down to its noise."""
    assert followed([recording(day) for day in range(3)]).misfit is None
    larger = []
    for day in range(3):
        one, rng = recording(day), np.random.default_rng([day, 77])
        larger.append(replace(one, q=one.q + rng.normal(0, 2 * hexapod.SIGMA, one.q.shape)))
    watch = followed(larger)
    assert watch.misfit.ratio == pytest.approx(5**0.5, rel=0.35)
    assert watch.misfit.p_value < 1e-6
    [doubt] = [b for b in describe_watch(watch) if isinstance(b, str) and "doubtful" in b]
    assert "the noise is stated too small" in doubt
    assert document_watch(watch)["misfit"]["ratio"] == watch.misfit.ratio


def test_noise_that_is_not_stated_is_learned_from_the_first_recording():
    silent = [
        replace(recording(day, 200e-6 * (day >= 6), n=80), joint_sigma=None) for day in range(8)
    ]
    watch = followed(silent)
    assert watch.alarm.recording == "day6"
    assert next(iter(watch.parts)) == "leg3"
    stated = followed([recording(0, n=80)]).visits[0]
    learned = watch.visits[0]
    assert learned.evidence.squares == pytest.approx(stated.evidence.squares, rel=0.5)
    with pytest.raises(FitError, match=r"day0: the noise of the joint readings is not stated, and"):
        followed([replace(recording(0, n=8), joint_sigma=None)])


def test_a_loose_joint_is_named():
    days = [recording(day, loose=100e-6 * (day >= 4), leg=0, n=120) for day in range(7)]
    watch = followed(days)
    assert watch.alarm.recording == "day4"
    assert next(iter(watch.parts)) == "leg1"
    best = watch.suspects[0]
    assert (best.parameter, best.kind) == ("leg1.L0", "scatter")
    assert best.value == pytest.approx(100e-6, rel=0.3)


def test_what_the_recordings_cannot_show_is_said_before():
    """A step that is stated as visible raises the alarm; half of it does not."""
    before = [recording(day) for day in range(8)]
    sight = {one.parameter: one.step for one in followed(before).sights}
    step = sight["leg1.L0"]
    assert followed([*before, recording(8, 1.3 * step, leg=0)]).alarm is not None
    assert followed([*before, recording(8, 0.5 * step, leg=0)]).alarm is None


def test_a_robot_that_measures_nothing_twice_is_refused():
    six = new_model("stewart42")
    q = np.tile(six.mechanism.home.joints, (3, 1))
    blind = Dataset.from_arrays(
        six.joints, q, np.zeros((3, 3)), measured=np.zeros((3, 6), bool), source="six.json"
    )
    with pytest.raises(FitError, match=r"six.json: no residuals: stewart42 has as many joint"):
        Watch(six).add(blind, START)


def test_recordings_come_in_order_of_time():
    watch = followed([recording(0)])
    with pytest.raises(DatasetError, match="day1 was recorded 2 days before day0"):
        watch.add(recording(1), START - 2 * DAY)
    with pytest.raises(DatasetError, match="day1 was recorded at the same time as day0"):
        watch.add(recording(1), START)


def test_a_state_continues_as_if_nothing_had_interrupted(tmp_path):
    half = followed([recording(day) for day in range(3)])
    write_state(half, tmp_path / "state.json")
    again = read_state(tmp_path / "state.json", calibrated())
    last = recording(3), START + 3 * DAY
    assert again.add(*last).trend == half.add(*last).trend
    assert read_state(tmp_path / "state.json", hexapod.drawn(LEGS)) is None
    assert write_state(half, tmp_path / "state.json") is None
    kept = write_state(Watch(hexapod.drawn(LEGS)), tmp_path / "state.json")
    assert kept == tmp_path / "state.1.json"  # of the other model: nothing is lost
    assert len(read_state(kept, calibrated()).visits) == 3
    (tmp_path / "state.json").write_text('{"parallel_cal_watch": 1}')
    with pytest.raises(DatasetError, match=r"is not the state of a watch .*Remove it"):
        read_state(tmp_path / "state.json", calibrated())


def test_the_command_continues_from_day_to_day(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_model(calibrated(), tmp_path / "hexa.yaml")
    for day in range(6):
        recording(day, 200e-6 * (day >= 5)).to_json(tmp_path / f"day{day}.json")

    def run(*words, expected=0):
        with pytest.raises(SystemExit) as ended:
            main(["watch", "hexa.yaml", *words])
        assert ended.value.code in (expected, None), capsys.readouterr().err
        return capsys.readouterr()

    assert run("day0.json").out.startswith("no answer yet")
    assert "no change: 5 recordings in 4 days" in run(*(f"day{d}.json" for d in range(1, 5))).out
    shown = run("day4.json", "day5.json", "-o", "page.html", "--confirm", "poses.csv")
    assert "day4.json was taken before" in shown.err
    assert "changed: alarm at day5.json" in shown.out
    assert "what changed: leg3 " in shown.out
    assert "to confirm: measure 3 poses" in shown.out
    assert "has it changed?" in (tmp_path / "page.html").read_text()
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 3 + 3  # and notes
    answer = json.loads(run("--json").out)
    assert answer["alarm"]["recording"] == "day5.json"
    assert answer["parts"][0]["since"] == ["2023-11-18T22:13:20+00:00", "2023-11-19T22:13:20+00:00"]
    wrong = run("day5.json", "--state", "new.json", "--time", "2099-01-01", expected=1).err
    assert "states that it was recorded on 2023-11-19T22:13:20+00:00" in wrong
    lock = open_locked(tmp_path / ".hexa.watch.json.lock")
    assert "another watch uses" in run("day5.json", expected=1).err
    os.close(lock)
    assert "expected a name that ends with .html" in run("-o", "page.pdf", expected=1).err
    last = json.loads(run("--json").out)["trend"]
    assert "taken back: " in run("--undo", "--json").err
    again = json.loads(run("--json").out)["trend"]
    assert again == last[:-1]
    with pytest.raises(DatasetError, match="could be taken back"):
        Watch(calibrated()).without_last()
    write_model(hexapod.drawn(LEGS), tmp_path / "drawn.yaml")
    with pytest.raises(SystemExit):
        main(["watch", "drawn.yaml", "day0.json", "--state", "drawn.json"])
    assert "drawn.yaml was never fitted" in capsys.readouterr().err
