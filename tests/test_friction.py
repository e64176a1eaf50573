"""What is known of friction, and what slips teach."""

import numpy as np
import pytest
from scipy import stats
from there import there

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


def test_slips_in_any_order_teach_alike_and_exact_friction_stays():
    prior = Friction.between(0.2, 1.2)
    one, reverse = prior.update(0.5, 0.1).update(0.6, 0.05), prior.update(0.6, 0.05).update(0.5, 0.1)
    assert (one.mean, one.sigma) == pytest.approx((reverse.mean, reverse.sigma))
    assert Friction(0.62).update(0.3, 0.05).mean == 0.62


def test_many_slips_leave_the_spread_of_one_grasp(rng: np.random.Generator):
    slips = 0.6 * (1 + 0.06 * rng.standard_normal(400))
    learnt = Friction.from_slips(slips, sigma=0.01)
    assert learnt.mean == pytest.approx(0.6, rel=0.02)
    assert learnt.sigma == pytest.approx(0.6 * 0.06, rel=0.05)
    one = Friction.from_slips([0.6], sigma=0.01)
    # twice the spread of a grasp: that of the slip and that of the next one
    assert one.sigma == pytest.approx(0.6 * 0.06 * np.sqrt(2), rel=0.05)
    assert Friction.from_slips([]).sigma > 0.3  # everything is possible


@pytest.mark.parametrize(
    ("told", "mean"), [(0.62, 0.62), ("0.62", 0.62), ((0.5, 0.8), 0.65), ("0.5..0.8", 0.65), (Friction(0.4), 0.4)]
)
def test_friction_is_told_in_many_ways(told: object, mean: float):
    assert as_friction(told).mean == pytest.approx(mean)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "told", ["steel", "0.1..0.2..0.3", "", "0.8..0.5", "0.5+-0.6", "0.5+-", "0.6+-0", "-0.2", "nan", 0.0, (0.5, 0.5)]
)
def test_what_is_no_friction_is_refused(told: object):
    with pytest.raises(InputError, match=r"friction"):
        as_friction(told)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("ratio", "sigma"), [(0.0, 0.1), (0.5, 0.0), (np.nan, 0.1)])
def test_impossible_slips_and_weights_are_refused(ratio: float, sigma: float):
    with pytest.raises(InputError, match="a slip needs a positive ratio"):
        Friction.between(0.2, 1.0).update(ratio, sigma)
    with pytest.raises(InputError, match="2 values of friction need as many weights"):
        Friction(np.array([0.5, 0.6]), np.array([1.0, -1.0]))


@pytest.mark.parametrize("value", [62.0, 0.0, -0.6, float("nan")])
def test_a_slip_teaches_no_friction_that_cannot_be_given(value: float):
    with pytest.raises(InputError) as given:
        Friction(value)
    with pytest.raises(InputError) as learnt:
        Friction.from_slips([0.6, value])
    assert str(given.value) == str(learnt.value)


def rising(learner: SlipLearner, *, until: float, sigma: float = 0.03) -> float:
    """Read a ratio that rises by 0.6 a second from 0; gives the time at its end."""
    times = np.arange(0, until / 0.6 + 1e-9, 1 / 60)
    for time_s in times.tolist():
        learner.note(0.6 * time_s, sigma=sigma, time_s=time_s)
    return float(times[-1])


def slip_at(learner: SlipLearner, ratio: float, *, sigma: float = 0.03) -> None:
    """Grasp, slip at a ratio that was read, and let go."""
    learner.note(ratio, sigma=sigma, time_s=0.0)
    learner.update(0.1, slipping_s=0.05)
    learner.update(0.2, slipping_s=None, touches=False)


def test_a_slip_teaches_what_was_read_as_it_began():
    prior, learner = Friction.between(0.2, 1.0), SlipLearner(Friction.between(0.2, 1.0))
    end_s = rising(learner, until=0.5)
    for late in range(3):  # the same slip, told again and again
        learner.update(end_s + 0.05 * late, slipping_s=0.1 + 0.05 * late)
    began = 0.6 * (end_s - 0.1)
    assert there(learner.friction).mean == pytest.approx(prior.update(began, 0.03).mean, abs=0.011)  # a frame before


def test_ten_slips_of_one_contact_teach_as_the_first():
    """What a network reads wrong of a contact it reads wrong at each: as independent they would leave 0.016."""
    learner = SlipLearner(Friction.between(0.2, 1.0), same_object=True)
    end_s = rising(learner, until=0.5, sigma=0.05)
    for number in range(10):
        learner.update(end_s + number, slipping_s=number + 0.05)
        assert there(learner.friction).sigma == pytest.approx(0.05, rel=0.02)
        learner.update(end_s + number + 0.5, slipping_s=None)
    assert learner.slips == 1
    learner.release()
    before = there(learner.friction)
    learner.note(0.5, sigma=0.05, time_s=21.0)
    learner.update(21.2, slipping_s=0.1)
    assert there(learner.friction).sigma < before.sigma  # another contact teaches again
    assert learner.slips == 2


def test_the_next_grasp_of_a_slip_that_was_learnt_is_less_sure():
    learner = SlipLearner(Friction.between(0.2, 1.0), same_object=True)
    learner.update(rising(learner, until=0.5), slipping_s=0.05)
    held = there(learner.friction).sigma
    learner.update(5.0, slipping_s=None, touches=False)
    let_go = there(learner.friction).sigma
    assert let_go == pytest.approx(np.hypot(held, 0.06 * there(learner.friction).mean), rel=0.05)
    learner.update(6.0, slipping_s=None, touches=False)  # still nothing touches
    assert there(learner.friction).sigma == let_go
    assert learner.learnt is learner.friction


@pytest.mark.parametrize("told", [None, Friction.between(0.2, 1.0)])
def test_what_a_slip_taught_ends_with_its_grasp_unless_the_object_stays_the_same(told: Friction | None):
    learner = SlipLearner(told)
    for ratio in (0.5, 0.8):  # of two objects
        slip_at(learner, ratio)
        assert learner.friction is told
        assert learner.slips == 1
        # it can be told again, and is as unsure as the slip and two grasps are
        assert there(learner.learnt).mean == pytest.approx(ratio, rel=0.03)
        assert there(learner.learnt).sigma == pytest.approx(np.hypot(0.03, 0.06 * ratio), rel=0.1)


def test_where_nothing_was_told_a_slip_teaches_the_grasps_that_follow():
    learner = SlipLearner(same_object=True)
    learner.note(0.5, sigma=0.03, time_s=0.0)
    learner.update(0.1, slipping_s=0.05)
    assert learner.friction is None  # not this one
    learner.release()
    once = there(learner.friction)
    assert once.mean == pytest.approx(0.5, rel=0.03)
    for _ in range(3):
        slip_at(learner, 0.5)
    # the steady state of Kalman's filter: steps of 6 % of 0.5, each seen by a slip that is as wrong
    step, seen = (0.06 * 0.5) ** 2, 0.03**2
    steady = step / 2 + np.sqrt(step**2 / 4 + step * seen)
    assert there(learner.friction).sigma == pytest.approx(np.sqrt(steady), rel=0.1)
    assert there(learner.friction).sigma < once.sigma
    assert learner.slips == 4


def test_friction_is_told_again_as_it_was_learnt():
    learner = SlipLearner(same_object=True)
    slip_at(learner, 0.58)
    again = as_friction(there(learner.friction).text)
    # three and two digits are written
    assert again.mean == pytest.approx(there(learner.friction).mean, rel=0.005)
    assert again.sigma == pytest.approx(there(learner.friction).sigma, rel=0.05)
    assert as_friction(Friction(0.62).text).sigma == 0


def test_friction_about_a_mean_has_that_mean_and_spread():
    friction = Friction.about(0.6, 0.1)
    # cut at 4 standard deviations and summed in steps of a tenth of one
    assert friction.mean == pytest.approx(0.6, rel=1e-3)
    assert friction.sigma == pytest.approx(0.1, rel=1e-2)
    share = friction.nodes[1][friction.nodes[0] < 0.5].sum()
    shape = np.sqrt(np.log1p(1 / 36))
    assert share == pytest.approx(stats.lognorm(shape, scale=0.6 * np.exp(-(shape**2) / 2)).cdf(0.5), abs=0.03)


@pytest.mark.parametrize("friction", [Friction(0.6), Friction.between(0.3, 0.9), None])
def test_without_a_reading_or_a_doubt_a_slip_teaches_nothing(friction: Friction | None):
    learner = SlipLearner(friction, same_object=True)
    if friction is not None and friction.sigma == 0:
        rising(learner, until=0.5)
    learner.update(1.0, slipping_s=0.1)
    learner.update(2.0, slipping_s=None, touches=False)
    assert learner.friction is friction
    assert learner.learnt is None


def test_friction_of_any_size_stays_in_the_next_grasp_but_for_its_spread():
    assert Friction(0.5).sigma == 0
    for value in (0.02, 0.6, 3.0, 5.0):
        after = Friction(value).next_grasp()
        # a Gaussian share of 6 %, on a grid of steps of 2 % at most
        assert after.mean == pytest.approx(value, rel=0.01)
        assert after.sigma == pytest.approx(0.06 * value, rel=0.05)
    # what holds is what slipped, however grippy: the prior is even in the logarithm, which takes off s^2 of it
    learnt = Friction.from_slips([2.6], sigma=0.1)
    assert learnt.mean == pytest.approx(2.6, rel=0.02)


def test_a_ratio_from_long_before_the_slip_teaches_nothing():
    stale, fresh = (SlipLearner(Friction.between(0.2, 1.0)) for _ in range(2))
    for learner, read_s in ((stale, 0.4), (fresh, 9.7)):
        learner.note(0.25, sigma=0.03, time_s=read_s)
        learner.update(10.0, slipping_s=0.2)
    assert stale.slips == 0
    assert fresh.slips == 1


def test_friction_that_reads_alike_is_told_apart_by_its_digest():
    ends = 0.4 * 2**0.5
    two = Friction(np.array([0.2, 1.0]))
    three = Friction(np.array([0.6 - ends, 0.6, 0.6 + ends]), np.array([0.25, 0.5, 0.25]))
    assert str(two) == str(three)
    assert two.digest != three.digest
    assert Friction(0.8246).digest != Friction(0.8254).digest
    assert Friction(0.62).digest == Friction(np.array([0.62]), np.array([3.0])).digest
