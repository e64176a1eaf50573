"""Laws of the load: forces, friction, labels."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplens.mechanics import stick_ratio
from sliplens.recordings import ContactState
from sliplens.simulation.loading import load_grasp, slide
from sliplens.simulation.nuisances import Grasp, Nuisances, draw_day, draw_grasp

FRAMES = 800
FEW = settings(max_examples=25)


def drawn(seed, **changes):
    rng = np.random.default_rng(seed)
    nuisances = Nuisances()
    day = draw_day(nuisances, quantile=rng.uniform(), rng=rng)
    return replace(draw_grasp(nuisances, day=day, wet=bool(seed % 2), rng=rng), **changes)


def loaded(seed, *, release=False, frames=FRAMES, varied=False, **changes):
    rng = np.random.default_rng(seed)
    return load_grasp(drawn(seed, **changes), frames=frames, rng=rng, release=release, varied=varied)


def first_slip(loading):
    return int(np.argmax(loading.safety_margin == 0))


seeds = st.integers(0, 10_000)


@FEW
@given(seeds, st.booleans(), st.booleans())
def test_margin_is_one_minus_the_used_share_of_the_friction_that_holds(seed, release, varied):
    loading = loaded(seed, release=release, varied=varied)
    pressing = loading.normal_force_n > 0
    capacity = loading.friction_coefficient[pressing] * loading.normal_force_n[pressing]
    np.testing.assert_allclose(
        loading.safety_margin[pressing], 1 - loading.tangential_force_n[pressing] / capacity, atol=1e-12
    )
    assert np.all(np.isnan(loading.safety_margin[~pressing]))
    assert np.all(loading.tangential_force_n[~pressing] == 0)


@FEW
@given(seeds)
def test_margin_falls_from_one_to_zero_while_the_pull_grows(seed):
    loading = loaded(seed, normal_force_drift=0.0, friction_drift=0.0)
    touch, slip = int(np.argmin(np.isnan(loading.safety_margin))), first_slip(loading)
    margin, pull = loading.safety_margin[touch : slip + 1], loading.tangential_force_n[touch : slip + 1]
    assert margin[0] == 1
    assert np.all(np.diff(margin) <= 1e-12)
    assert np.all(np.diff(pull) >= -1e-12)
    # full slip begins exactly where the friction is used up
    assert margin[-1] == 0
    np.testing.assert_array_equal(loading.static_friction[: slip + 1], loading.friction_coefficient[: slip + 1])
    assert pull[-1] == pytest.approx(loading.friction_coefficient[slip] * loading.normal_force_n[slip], rel=1e-12)
    assert np.all(margin[:-1] > 0)
    # until then the stick ratio is that of a sphere
    np.testing.assert_array_equal(loading.stick_ratio[:slip], stick_ratio(loading.safety_margin[:slip]))
    assert np.all(loading.carried_friction[:slip] == 0)


@FEW
@given(seeds)
def test_a_varied_pull_slips_where_its_friction_is_used_up_and_nowhere_before(seed):
    loading = loaded(seed, varied=True, frames=300)
    touch, slip = int(np.argmin(np.isnan(loading.safety_margin))), first_slip(loading)
    assert np.all(loading.safety_margin[touch:slip] > 0)
    held = loading.friction_coefficient[slip] * loading.normal_force_n[slip]
    assert loading.tangential_force_n[slip] == pytest.approx(held, rel=1e-12)
    assert np.all((loading.retaken >= 0) & (loading.retaken <= loading.let_back + 1e-12) & (loading.let_back <= 1))
    # whatever happened on the way, the farthest pull grows
    farthest = 1 - loading.safety_margin[touch:slip] + (loading.let_back - loading.retaken)[touch:slip]
    assert np.all(np.diff(farthest) >= -1e-9)


def test_varied_pulls_have_speeds_over_a_decade_and_rest_jerk_and_are_let_back():
    durations, kinds = [], {"rest": 0, "jerk": 0, "let back": 0}
    for seed in range(100):
        loading = loaded(seed, varied=True, frames=400, normal_force_drift=0.0, friction_drift=0.0)
        slip = first_slip(loading)
        used = 1 - loading.safety_margin[:slip]
        begun = int(np.argmax(used > 0)) - 1
        duration_s = loading.time_s[slip] - loading.time_s[begun]
        durations.append(duration_s)
        rates = np.diff(used[begun:]) * duration_s / loading.time_s[1]  # 1 is that of an even pull
        kinds["rest"] += bool((np.abs(rates) < 1e-9).sum() > 5)
        kinds["jerk"] += bool(rates.max() > 3 * 3)
        kinds["let back"] += bool((rates < -1e-9).any())
    assert min(durations) < 0.9
    assert max(durations) > 7
    # evenly in the logarithm: half are below the geometric mean, give or take three standard errors
    assert abs(np.mean(np.array(durations) < np.sqrt(0.8 * 8)) - 0.5) < 3 * 0.5 / np.sqrt(100)
    assert min(durations) >= 0.8 * 0.95
    assert max(durations) <= 8 * 1.05  # phases round to frames, of 7 to 26 ms
    # four pulls in ten have each kind; short jerks hide between frames
    assert min(kinds.values()) > 10


@FEW
@given(seeds)
def test_sliding_friction_stays_between_kinetic_and_what_was_regained(seed):
    grasp = drawn(seed)
    loading = load_grasp(grasp, frames=FRAMES, rng=np.random.default_rng(seed))
    slip = first_slip(loading)
    # the fall from static to kinetic friction takes a few frames
    later = slice(slip + 10, None)
    used = loading.tangential_force_n[later] / loading.normal_force_n[later]
    static = grasp.friction * (1 + grasp.friction_drift * (2 * np.arange(FRAMES) / (FRAMES - 1) - 1))[later]
    kinetic = grasp.kinetic_ratio * static
    regained = kinetic + grasp.stick_slip_share * (static - kinetic)
    assert np.all(used >= kinetic * (1 - 1e-9))
    assert np.all(used <= regained * (1 + 1e-9))


def test_stick_slip_is_a_sawtooth_with_its_frequency():
    grasp = Grasp(friction=0.8, kinetic_ratio=0.75, stick_slip_share=0.5, stick_slip_hz=4.0)
    time_s = np.arange(0, 3, 0.001)
    full = np.ones(len(time_s))
    sliding = slide(time_s, used=full, static_friction=0.8 * full, grasp=grasp, stuck_until=10**6)
    assert sliding.coefficient[0] == 0.8
    assert sliding.slips[0]
    begins = np.flatnonzero(np.diff(sliding.slips.astype(int)) == -1)
    np.testing.assert_allclose(np.diff(time_s[begins]), 0.25, atol=0.0011)
    pull = sliding.used * sliding.coefficient
    stuck = ~sliding.slips
    # stuck, the spring reloads: force from kinetic friction to what was regained, and the margin falls with it
    assert pull[stuck].min() == pytest.approx(0.6, abs=1e-3)
    assert pull[stuck].max() == pytest.approx(0.7, abs=1e-3)
    assert np.all(sliding.used[sliding.slips] == 1)


@FEW
@given(seeds)
def test_a_release_ends_without_contact_and_slides_on_the_way(seed):
    loading = loaded(seed, release=True)
    assert np.isnan(loading.safety_margin[-1])
    assert loading.contact_state[-1] is ContactState.NO_CONTACT
    falling = np.flatnonzero(np.diff(loading.normal_force_n) < -1e-3 * loading.normal_force_n.max())
    assert falling.size
    assert np.all(np.nan_to_num(loading.safety_margin[falling + 1], nan=0.0) == 0)
