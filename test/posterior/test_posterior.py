"""The sum over all sets of causes: its evidence against dense covariances, its probabilities
against counting, and what it says of sessions of another hand."""

from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
import pytest
import virtual_day as vd
import virtual_findings as vf
from datasets import as_dataset, measured
from findings import hiding
from marks import keep
from scipy.stats import multivariate_t

from parallel_cal.causes.effects import list_effect_blocks
from parallel_cal.causes.unknown_laws import smooth
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.effects.backlash import Backlash
from parallel_cal.identification.fit import fit
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import new_model
from parallel_cal.posterior.blocks import EFFECT, LAW, LOG_ODDS, Block, Stack
from parallel_cal.posterior.evidence import LOG_WEIGHTS, SIZES, STATED, UNKNOWN, Choice, Evidence
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import Sum
from parallel_cal.virtual import robot as vr

MODEL = new_model("delta54")


@dataclass
class Residual:
    """A scene without geometry: a residual, and nothing that could imitate a cause."""

    residual: np.ndarray

    @property
    def dof(self):
        return len(self.residual)

    def project_off_geometry(self, columns):
        return columns


def drawn(seed, n=40, causes=4, of=()):
    """A residual of white noise and the causes `of`, and blocks of one or two settings each."""
    rng = np.random.default_rng(seed)
    columns = [[rng.standard_normal((n, 2)) for _ in range(1 + k % 2)] for k in range(causes)]
    residual = rng.standard_normal(n)
    for k in of:
        residual += columns[k][0] @ rng.standard_normal(2)
    scene = Residual(residual)
    names = [f"cause {k}" for k in range(causes)]
    blocks = [
        Block.of(
            scene, name, EFFECT, np.log(0.1), own, [{"setting": float(i)} for i in range(len(own))]
        )
        for name, own in zip(names, columns, strict=True)
    ]
    return scene, blocks


def test_the_evidence_is_the_density_of_a_multivariate_t_distribution():
    """scipy's density, of the dense matrix 1 + sum s^2 B B'."""
    scene, blocks = drawn(0, of=(1,))
    squares = float(scene.residual @ scene.residual)
    chosen = (Choice(blocks[1], 0, 2), Choice(blocks[3], 1, 0))
    S = np.eye(scene.dof)
    for one in chosen:
        B = SIZES[one.size] * one.block.at(one.setting)
        S += B @ B.T
    for nu in (2.0, 200.0):
        found = Evidence(squares, scene.dof, nu, chosen)
        expected = multivariate_t(np.zeros(scene.dof), S, df=nu).logpdf(scene.residual)
        assert found.log_p - found.log_prior == pytest.approx(expected, rel=1e-10)
        beside = Evidence(squares, scene.dof, nu, chosen[:1]).weigh(blocks[3].alone)
        assert beside[1, 0] == pytest.approx(found.log_p, rel=1e-10)


def drawing():
    """The prior of the drawing, without correlations."""
    return Prior.of_drawing(MODEL.table)


def calibration():
    """A prior of some parameters, as an earlier fit knows them: away from nominal, correlated."""
    rng = np.random.default_rng(1)
    known = drawing()
    size = 0.3 * np.sqrt(np.diag(known.covariance))[2:]
    root = size[:, None] * rng.standard_normal((len(size), len(size))) / len(size) ** 0.5
    mean = known.mean[2:] + size * rng.standard_normal(len(size))
    return Prior(known.names[2:], mean, root @ root.T + np.diag(0.01 * size**2))


@pytest.mark.parametrize("within", [drawing(), calibration()])
def test_a_scene_within_a_prior_has_its_covariance(within):
    """Against the dense covariance of all rows, with the noise as stated and four times as large;
    about another geometry, the same to first order. What the prior does not name may be anything.
    """
    data = measured(0)
    fitted = fit(MODEL, data, hold_out=0)
    seen, free = fitted.observations, fitted.free
    at = predict_configurations(MODEL, seen)
    system = Linearisation(MODEL, seen, free, True)(MODEL.values, at)
    names = [name for name, one in zip(MODEL.table.names, free, strict=True) if one]
    size = MODEL.table.prior_sigma[free]
    r, J = system.residual.ravel(), system.columns * size
    covariance = np.diag(np.full(len(names), 1e6))
    own = [i for i, name in enumerate(names) if name in within.names]
    there = [within.names.index(names[i]) for i in own]
    known = within.covariance[np.ix_(there, there)] / np.outer(size[own], size[own])
    covariance[np.ix_(own, own)] = known
    r = r + J[:, own] @ ((within.mean[there] - MODEL.values[free][own]) / size[own])
    B = np.random.default_rng(0).standard_normal((len(r), 3))
    scene = Scene.of(MODEL, data, seen, free, within=within)
    for variance in (1.0, 4.0):
        weight = np.linalg.inv(np.eye(len(r)) + J @ covariance @ J.T / variance)
        there = scene.in_units_of(variance)
        C = there.project_off_geometry(B)
        assert there.residual @ there.residual == pytest.approx(r @ weight @ r / variance, rel=1e-4)
        np.testing.assert_allclose(C.T @ C, B.T @ weight @ B, rtol=1e-4, atol=1e-4)
        onto = B.T @ weight @ r / variance**0.5
        np.testing.assert_allclose(C.T @ there.residual, onto, rtol=1e-3, atol=1e-3)
    near = Scene.of(fitted.model, data, seen, free, within=within)
    squares = [float(one.residual @ one.residual) for one in (near, scene)]
    assert squares[0] == pytest.approx(squares[1], rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_the_probabilities_are_those_of_counting_all_sets(seed):
    """Every set of up to four causes, with every setting and size."""
    hidden = {0: (), 1: (0,), 2: (0, 2), 3: (3,)}[seed]
    scene, blocks = drawn(seed, of=hidden)
    squares = float(scene.residual @ scene.residual)
    logs = dict[frozenset[str], float]()
    for count in range(3):
        for members in combinations(blocks, count):
            choices = [
                [Choice(b, i, s) for i in range(b.tried) for s in range(len(SIZES))]
                for b in members
            ]
            each = [Evidence(squares, scene.dof, STATED, one).log_p for one in product(*choices)]
            logs[frozenset(b.name for b in members)] = float(np.logaddexp.reduce(each))
    total = np.logaddexp.reduce(list(logs.values()))
    found = Sum(scene, Stack.of_alike(blocks), STATED).search()
    for block in blocks:
        within = [v for members, v in logs.items() if block.name in members]
        expected = float(np.exp(np.logaddexp.reduce(within) - total))
        assert found.probability[block.name] == pytest.approx(expected, abs=0.05)


def test_a_probability_is_the_share_of_true_statements():
    """500 residuals drawn from the priors of the sum itself, by three bins of probability."""
    stated, true = list[float](), list[bool]()
    for seed in range(500):
        rng = np.random.default_rng([seed, 7])
        scene, blocks = drawn(rng.integers(1 << 30), n=25, causes=3)
        for block in blocks:
            if there := rng.random() < 0.1:
                size = SIZES[rng.choice(len(SIZES), p=np.exp(LOG_WEIGHTS))]
                setting = rng.integers(block.tried)
                scene.residual += size * block.at(setting) @ rng.standard_normal(2)
            true.append(there)
        again = [
            Block.of(scene, b.name, b.kind, np.log(0.1 / 0.9), list(b.columns), b.settings)
            for b in blocks
        ]
        found = Sum(scene, Stack.of_alike(again), STATED).search()
        stated += [found.probability[block.name] for block in blocks]
    p, is_true = np.array(stated), np.array(true)
    for low, high in ((0.0, 0.05), (0.2, 0.8), (0.95, 1.01)):
        inside = (p >= low) & (p < high)
        expected, share = p[inside].mean(), is_true[inside].mean()
        chance = np.sqrt(expected * (1 - expected) / inside.sum())
        assert abs(share - expected) < 3 * chance + 0.01


def test_what_is_not_there_yet_is_added_before_another_cause_takes_its_place():
    """Alone, one of two causes is less likely than a third that imitates both."""
    rng = np.random.default_rng(3)
    first, second = rng.standard_normal((2, 40, 2))
    scene = Residual((first + second) @ [3.0, 2.0] + rng.standard_normal(40))
    both = first + second + 0.2 * rng.standard_normal((40, 2))
    blocks = [
        Block.of(scene, name, EFFECT, np.log(0.1), [own], [{}])
        for name, own in (("first", first), ("second", second), ("imitates both", both))
    ]
    made = Sum(scene, Stack.of_alike(blocks), STATED)
    near = made.choose(blocks[:1])
    alone, imitated = (made.evidence(made.choose([blocks[k]]), STATED).log_p for k in (0, 2))
    assert imitated > alone
    found = made.search(near)
    assert {one.block.name for one in found.chosen} == {"first", "second"}
    assert made.evidence(found.chosen, STATED).log_p > imitated


@pytest.mark.parametrize(("gain", "bend"), [(10.0, 5.0), (30.0, 15.0)])
def test_a_law_that_imitates_two_effects_gives_way_though_each_alone_hides_the_other(gain, bend):
    """Without the bend, only the largest gain is seen, in one joint alone; and beside that, no bend
    is likelier than a law that follows both (a hexapod on strings, whose spools fill)."""
    rng = np.random.default_rng(0)
    gains, bends = rng.standard_normal((2, 60, 3))
    residual = gains @ [gain, 1.0, -1.0] + bends @ [bend, -bend, bend] + rng.standard_normal(60)
    scene = Residual(residual)
    usual = [np.eye(3), *np.eye(3)[:, :, None]]  # in all joints, or in one
    effects = [
        Block.of(scene, name, EFFECT, np.log(0.1), [own], [{}] * 4, 1, usual, in_one=3)
        for name, own in (("gain", gains), ("bend", bends))
    ]
    follows = np.hstack([gains, bends, rng.standard_normal((60, 3))])
    law = Block.of(scene, "law", LAW, np.log(0.1), [follows], [{}])
    made = Sum(scene, Stack.of_alike([*effects, law]), UNKNOWN)
    both, imitated = (made.evidence(made.choose(one), UNKNOWN).log_p for one in (effects, [law]))
    assert both > imitated + 3
    found = made.search()
    assert {one.block.name for one in found.chosen} == {"gain", "bend"}
    assert min(found.probability["gain"], found.probability["bend"]) > 0.9


def test_a_smooth_function_has_variance_one_and_the_stated_correlation():
    x = np.linspace(-2, 2, 41)
    B = smooth(x, 0.8, 30)
    covariance = B @ B.T
    z = (x - x.mean()) / x.std()
    np.testing.assert_allclose(np.diag(covariance), 1, atol=1e-3)
    np.testing.assert_allclose(
        covariance, np.exp(-((z[:, None] - z) ** 2) / (2 * 0.8**2)), atol=5e-3
    )


def test_doubt_of_a_stated_noise_costs_as_much_as_a_cause():
    """Noise that a fit estimated itself is not doubted again."""
    residual, blocks = drawn(0)
    for nu, price in ((STATED, LOG_ODDS), (20.0, 0.0)):
        made = Sum(residual, Stack.of_alike(blocks), nu)
        assert made.total((), UNKNOWN) - made.evidence((), UNKNOWN).log_p == pytest.approx(price)
        assert made.total((), nu) == made.evidence((), nu).log_p


@pytest.fixture(scope="module")
def scene():
    """The residuals of the geometry of a Delta without effects."""
    return see(fit(MODEL, measured(0), hold_out=0))


def test_a_law_found_in_the_data_pays_for_the_forms_that_were_tried(scene, monkeypatch):
    """Among thousands of forms one fits well by chance; an effect of the catalogue is one of
    dozens."""
    (known,) = list_effect_blocks(scene, ["backlash"], {})
    monkeypatch.setattr(Backlash, "found_in_data", True)
    (found,) = list_effect_blocks(scene, ["backlash"], {})
    assert found.log_prior < known.log_prior - np.log(10_000)


def test_known_settings_of_an_effect_are_not_scanned_and_still_pay_for_the_scan(scene):
    ratio, name = {"ratio": 47.3}, "gear_transmission_error"
    (scanned,) = list_effect_blocks(scene, [name], {})
    (known,) = list_effect_blocks(scene, [name], {name: ratio})
    assert list(known.settings) == [ratio]
    assert known.tried == scanned.tried == len(scanned.settings) > 10


def test_two_answers_say_what_is_missing_and_whether_anything_is_left():
    found = diagnose(MODEL, hiding([vf.KINDS["joint compliance"]], 1.0, seed=1)[0])
    [cause] = found.missing
    assert cause["effects"][0] == "joint_compliance"
    assert cause["probability"] > 0.95
    assert found.left == "no"
    document = found.document()
    assert document["missing"] == [cause]
    assert document["left"] == "no"


def test_a_law_outside_the_catalogue_is_left_and_no_effect_is_certain():
    kind = vf.Kind((), vf.OUTSIDE["products of joints"], 0.5e-3)
    found = diagnose(MODEL, hiding([kind], 1.5, seed=3)[0])
    assert found.left == "yes"
    assert max(found.explanation.laws.values()) > 0.99
    assert all(cause["probability"] < 0.5 for cause in found.missing)


@pytest.mark.parametrize(
    "name", keep(["a dented joint", "a kinked joint", "a joint that jumps"], "a dented joint")
)
def test_a_law_of_one_joint_alone_is_no_wave_in_all_joints(name):
    """A gear or an encoder of some order follows a dent: one was certain, and nothing left."""
    found = diagnose(MODEL, hiding([vf.Kind((), vf.OUTSIDE[name], 0.5e-3)], 1.5, seed=3)[0])
    assert found.left == "yes"
    assert found.explanation.laws["law of joint1"] > 0.99
    assert all(cause["probability"] < 0.1 for cause in found.missing)


def test_a_wave_in_one_joint_alone_is_no_law_of_this_joint():
    wave = vf.Outside(vf.of_first(lambda q: np.sin(23 * q + 1)), 0.25e-3)
    found = diagnose(MODEL, hiding([vf.Kind((), lambda s, rng: wave, 1.0)], 1.0, seed=3)[0])
    [cause] = found.missing
    assert cause["effects"] == ["gear_transmission_error"]
    assert cause["probability"] > 0.99
    assert found.left == "no"


@pytest.mark.parametrize("saturates", [False, True])
def test_friction_that_saturates_with_the_velocity_is_not_latency(saturates):
    """Every joint lags by 2 ms times its velocity, or by as much at most as friction lets it."""
    samples = vd.dwell_samples(vr.MOCK_UP, seed=4, noise=vr.THESIS_NOISE, effects=())
    v = np.random.default_rng(4).uniform(-0.4, 0.4, samples["q"].shape)
    samples["q"] += 8e-4 * np.tanh(v / 0.05) if saturates else 2e-3 * v
    data = as_dataset(samples)
    speeds = {f"velocity.{name}": v[:, i] for i, name in enumerate(data.joint_names)}
    found = diagnose(MODEL, replace(data, conditions={**data.conditions, **speeds}))
    assert found.left == ("yes" if saturates else "no")
    assert ("law of velocity" in found.explanation.laws) == saturates
    if saturates:
        assert found.verdict.word == "partly_explained"
        assert "discover" in found.next_steps[0]
    else:
        assert {"latency", "servo_lag"} & {*found.missing[0]["effects"]}
        assert found.verdict.word == "explained"


def test_rows_that_say_nothing_are_left_out_and_change_no_sum():
    """Positions alone leave three of six rows of a serial arm or a Delta with orientations."""
    data, _ = hiding([vf.KINDS["backlash"]], 1.0, seed=3)
    data = replace(data, measured=data.measured & (np.arange(6) < 3))
    found = fit(new_model("delta54"), data, hold_out=0)
    scene = see(found)
    assert (scene.rows, set(scene.informative.tolist())) == (3, {3})
    assert scene.residual @ scene.residual == pytest.approx(found.estimate.chi2, rel=1e-3)
    assert scene.dof == 3 * len(data) - scene.basis.shape[1]
