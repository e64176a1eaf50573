"""What is known of friction, and what slips teach."""

import numpy as np
import pytest
from scipy import stats

from sliplens.errors import InputError
from sliplens.friction import Friction, SlipLearner, as_friction


def test_a_range_is_even():
    friction = Friction.between(0.5, 0.8)
    assert friction.mean == pytest.approx(0.65)
    # 41 middles of equal shares lack the variance within a share: one part in 41 squared
    assert friction.sigma == pytest.approx(0.3 / np.sqrt(12), rel=1e-3)
    assert friction.nodes[1].sum() == pytest.approx(1)


def test_a_slip_teaches_as_gaussians_multiply():
    values = np.linspace(0.2, 1.2, 2001)
    before = Friction(values, stats.norm.pdf(values, 0.7, 0.1))
    after = before.update(0.55, 0.05)
    # precisions add, and means weigh by them
    precision = 1 / 0.1**2 + 1 / 0.05**2
    assert after.mean == pytest.approx((0.7 / 0.1**2 + 0.55 / 0.05**2) / precision, abs=1e-4)
    assert after.sigma == pytest.approx(precision**-0.5, abs=1e-4)


def test_slips_in_any_order_teach_alike():
    prior = Friction.between(0.2, 1.2)
    one, other = (prior.update(*first).update(*second) for first, second in (((0.5, 0.1), (0.6, 0.05)),) * 2)
    reverse = prior.update(0.6, 0.05).update(0.5, 0.1)
    assert one.mean == pytest.approx(reverse.mean)
    assert other.sigma == pytest.approx(reverse.sigma)


def test_what_is_known_exactly_stays():
    assert Friction(0.62).update(0.3, 0.05).mean == 0.62


def test_another_grasp_is_less_sure_by_its_spread():
    same, next_one = Friction(0.5), Friction(0.5).next_grasp(0.06)
    assert same.sigma == 0
    assert next_one.mean == pytest.approx(0.5, rel=0.01)
    assert next_one.sigma == pytest.approx(0.5 * 0.06, rel=0.02)
    assert Friction(0.5).next_grasp(0.0).mean == 0.5


def test_many_slips_leave_the_spread_of_one_grasp(rng: np.random.Generator):
    slips = 0.6 * (1 + 0.06 * rng.standard_normal(400))
    learnt = Friction.from_slips(slips, sigma=0.01, grasp_spread=0.06)
    assert learnt.mean == pytest.approx(0.6, rel=0.02)
    assert learnt.sigma == pytest.approx(0.6 * 0.06, rel=0.05)
    one = Friction.from_slips([0.6], sigma=0.01, grasp_spread=0.06)
    # twice the spread of a grasp: that of the slip and that of the next one
    assert one.sigma == pytest.approx(0.6 * 0.06 * np.sqrt(2), rel=0.05)


def test_no_slip_leaves_everything_possible():
    assert Friction.from_slips([]).sigma > 0.3


@pytest.mark.parametrize(
    ("told", "mean"), [(0.62, 0.62), ("0.62", 0.62), ((0.5, 0.8), 0.65), ("0.5..0.8", 0.65), (Friction(0.4), 0.4)]
)
def test_friction_is_told_in_many_ways(told: object, mean: float):
    assert as_friction(told).mean == pytest.approx(mean)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("told", ["steel", "0.1..0.2..0.3", "", "0.8..0.5", "-0.2", "nan", 0.0, (0.5, 0.5)])
def test_what_is_no_friction_is_refused(told: object):
    with pytest.raises(InputError, match=r"friction"):
        as_friction(told)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("slip", [(0.0, 0.1), (0.5, 0.0), (float("nan"), 0.1)])
def test_what_is_no_slip_is_refused(slip: tuple[float, float]):
    with pytest.raises(InputError, match="a slip is told by a positive ratio"):
        Friction.between(0.2, 1.0).update(*slip)


def test_weights_must_fit():
    with pytest.raises(InputError, match="2 values of friction need as many weights"):
        Friction(np.array([0.5, 0.6]), np.array([1.0, -1.0]))
    with pytest.raises(InputError, match="share of the friction"):
        Friction(0.5).next_grasp(1.5)


def rising(learner: SlipLearner, *, until: float, sigma: float = 0.03) -> float:
    """Read a ratio that rises by 0.6 a second from 0; gives the time at its end."""
    times = np.arange(0, until / 0.6 + 1e-9, 1 / 60)
    for time_s in times.tolist():
        learner.note(0.6 * time_s, sigma=sigma, time_s=time_s)
    return float(times[-1])


def test_a_slip_teaches_what_was_read_as_it_began():
    prior, learner = Friction.between(0.2, 1.0), SlipLearner(Friction.between(0.2, 1.0))
    end_s = rising(learner, until=0.5)
    for late in range(3):  # the same slip, told again and again
        learner.update(end_s + 0.05 * late, slipping_s=0.1 + 0.05 * late)
    began = 0.6 * (end_s - 0.1)
    assert learner.friction.mean == pytest.approx(prior.update(began, 0.03).mean, abs=0.011)  # a frame before


def test_ten_slips_of_one_contact_teach_as_the_first():
    """What a network reads wrong of a contact it reads wrong at each: as independent they would leave 0.016."""
    learner = SlipLearner(Friction.between(0.2, 1.0))
    end_s = rising(learner, until=0.5, sigma=0.05)
    for number in range(10):
        learner.update(end_s + number, slipping_s=number + 0.05)
        assert learner.friction.sigma == pytest.approx(0.05, rel=0.02)
        learner.update(end_s + number + 0.5, slipping_s=None)
    learner.update(20.0, slipping_s=None, touches=False)
    before = learner.friction
    learner.note(0.5, sigma=0.05, time_s=21.0)
    learner.update(21.2, slipping_s=0.1)
    assert learner.friction.sigma < before.sigma  # another contact teaches again


def test_the_next_grasp_of_a_slip_that_was_learnt_is_less_sure():
    learner = SlipLearner(Friction.between(0.2, 1.0))
    learner.update(rising(learner, until=0.5), slipping_s=0.05)
    held = learner.friction.sigma
    learner.update(5.0, slipping_s=None, touches=False)
    let_go = learner.friction.sigma
    assert let_go == pytest.approx(np.hypot(held, 0.06 * learner.friction.mean), rel=0.05)
    learner.update(6.0, slipping_s=None, touches=False)  # still nothing touches
    assert learner.friction.sigma == let_go


@pytest.mark.parametrize("friction", [Friction(0.6), Friction.between(0.3, 0.9)])
def test_without_a_reading_or_a_doubt_a_slip_teaches_nothing(friction: Friction):
    learner = SlipLearner(friction)
    if friction.sigma == 0:
        rising(learner, until=0.5)
    learner.update(1.0, slipping_s=0.1)
    learner.update(2.0, slipping_s=None, touches=False)
    assert learner.friction is friction
