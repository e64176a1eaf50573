"""Episodes: the same draws for all, readings as they were measured, loops that close, folders that go on."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from constant_controller import Constant

import sliplens as sl
from sliplens.codec import load_result
from sliplens.errors import InputError
from sliplens.files import DEFAULT_NETWORK
from sliplens.friction import Friction, SlipLearner
from sliplens.grip import episodes as episodes_module
from sliplens.grip.controllers import Controller, MarginLaw, make_controller
from sliplens.grip.episodes import GripLoop, run_episodes, run_scripts
from sliplens.grip.fingertip import (
    FORCES_N,
    FRICTIONS,
    MARGINS,
    Fingertip,
    MarkerField,
    ReadingTable,
    RenderedSensor,
    TableSensor,
    load_readings,
)
from sliplens.grip.plant import EPISODE_S, OBJECTS, Plant, Scripts, draw_scripts, hand_motion
from sliplens.grip.records import Grip
from sliplens.models import Network


@pytest.fixture(scope="module")
def network() -> Network:
    return sl.load(DEFAULT_NETWORK)


@pytest.fixture(scope="module")
def table(network) -> ReadingTable:
    return load_readings(network)


def few(controller: str | Controller, condition: str = "dry", **options: Any) -> Grip:
    options = {"episodes": 40, "seed": 7} | options
    return run_episodes("cup", controller, condition=condition, **options)


def scripted(condition: str = "dry", *, episodes: int = 1, **columns: float) -> Scripts:
    """Episodes with some of their events set."""
    scripts = draw_scripts("cup", condition, episodes=episodes, seed=1)
    return replace(scripts, **{name: np.full(episodes, value) for name, value in columns.items()})


def test_a_fixed_grip_drops_what_weighs_more_than_its_friction_holds_and_no_other():
    force = 1.0
    limit = 2 * 0.5 * force / 9.81
    # the lift itself asks for 5 % more
    for mass, falls in ((0.9 * limit, False), (1.03 * limit, True)):
        scripts = scripted(kinetic_ratio=0.99, friction_gap=0.0, pull_n=0.0, friction=0.5, mass_kg=mass)
        loop = GripLoop(Plant(OBJECTS["cup"]), None, make_controller("fixed", {"force_n": force}))
        assert bool(run_scripts(loop, scripts).dropped[0]) is falls


def test_what_the_network_reads_of_a_fingertip_is_what_its_table_has(network, table):
    tip, margins = Fingertip(seed=table.seed), np.array(MARGINS[:-1])
    full = np.ones(len(margins))
    film = tip.film(FORCES_N[2] * full, friction=FRICTIONS[3] * full, margins=margins, held_s=full)
    read = network.predict(network.encode(film.draw_all(), tip.reference)).numpy()
    # of one state, twice filmed, the answers differ by the noise
    assert np.abs(read - table.margin[0, 3, 2, :-1]).max() < 5 * table.noise


def test_a_network_without_errors_reads_the_truth(table):
    plant = Plant(OBJECTS["cup"], episodes=20)
    eyes = TableSensor(table, fingertips=np.arange(20.0), rng=np.random.default_rng(0), error_scale=0.0)
    plant.state = replace(plant.state, force_n=np.full(20, 1.0), shear_n=np.full((20, 2), 0.3))
    sight = eyes.measure(plant.state, np.full(20, np.nan))
    assert sight.margin == pytest.approx(0.7)
    assert sight.low == pytest.approx(0.7)


def test_markers_between_the_states_of_the_grid_are_where_the_simulated_fingertip_has_them():
    field, rng, count = MarkerField([30, 34]), np.random.default_rng(0), 40
    which, force = rng.integers(2, size=count), rng.uniform(0.05, 4, count)
    friction, margins = rng.uniform(0.1, 1.3, (count, 2)), rng.uniform(0, 1, (count, 2))
    back = rng.random((count, 2)) < 0.5
    places = field.at(which, force, friction=friction, margins=margins, pulled_back=back)
    first = Fingertip(seed=34)
    for finger, tip in enumerate((first, Fingertip(seed=35, day=first.day))):
        rows = np.flatnonzero(which == 1)
        for row in rows:
            film = tip.film(
                force[[row]], friction=friction[[row], finger], margins=margins[[row], finger],
                held_s=np.ones(1), pulled_back=bool(back[row, finger]),
            )  # fmt: skip
            rest, exact = film.marker_rest_px, film.marker_px[0]
            nearest = np.linalg.norm(rest[:, None] - field.rest_px[1, finger], axis=2).argmin(axis=0)
            # two standard deviations of the noise with which markers are followed
            assert np.abs(places[row, finger] - exact[nearest]).max() < 0.2
    untouched = field.at(which, 0 * force, friction=friction, margins=margins, pulled_back=back)
    np.testing.assert_array_equal(untouched, field.rest_px[which])


@pytest.mark.parametrize("friction", [0.4, 0.9])
def test_the_loop_detects_slip_as_a_real_hold_does_and_only_where_an_object_slides(table, friction):
    """A fixed grip that holds, and one whose friction falls to half at 2.5 s, on the same fingertips."""
    for factor in (1.0, 0.5):
        weight_n = 2 * friction * 0.7 * 1.5  # 70 % of what friction holds
        scripts = scripted(
            episodes=6, mass_kg=weight_n / 9.81 / 1.1, friction=friction, friction_gap=0.0, pull_n=0.0,
            patch_factor=factor, patch_at_s=2.5,
        )  # fmt: skip
        eyes = TableSensor(table, fingertips=np.arange(6.0), rng=np.random.default_rng(0))
        loop = GripLoop(Plant(OBJECTS["cup"], episodes=6), eyes, make_controller("fixed", {"force_n": 1.5}))
        ticks = [loop.tick(scripts.world(loop.plant.state.time_s)) for _ in range(180)]
        slip, time_s = np.array([tick.slip for tick in ticks]), np.array([tick.state.time_s for tick in ticks])
        # as an object leaves the table, and as the hand stops at 2 s, it swings: the load falls, as in a slip
        assert not slip[(time_s > 2.2) & (time_s < 2.5)].any()
        assert slip[time_s > 2.5].any(axis=0).all() == (factor < 1)


def test_the_loop_closes_through_pixels(network):
    """A little of an episode: what is read follows what the plant does."""
    scripts = scripted(mass_kg=0.08, friction=0.6)
    eyes = RenderedSensor(network, seed=11, engine="torch")
    loop = GripLoop(Plant(OBJECTS["cup"]), eyes, make_controller("fixed", {"force_n": 1.2}))
    ticks = [loop.tick(scripts.world(loop.plant.state.time_s)) for _ in range(3)]
    assert ticks[-1].state.force_n[0] > 0.1  # touched
    plant = loop.plant
    near, far = (replace(plant.state, force_n=np.array([1.2]), shear_n=np.full((1, 2), s)) for s in (0.05, 0.65))
    reads = [eyes.measure(replace(one, friction=np.full((1, 2), 0.6)), np.full(1, np.nan)) for one in (near, far)]
    assert np.all(reads[0].margin > reads[1].margin + 0.3)
    assert np.all(reads[1].low <= reads[1].margin)


def test_a_reading_comes_as_late_as_is_said():
    for latency, ticks in ((0.0, 0), (0.02, 2), (0.1, 6)):
        scripts, controller = scripted(), Constant(force_n=1.0)
        loop = GripLoop(Plant(OBJECTS["cup"]), None, controller, latency_s=latency)
        after = [loop.tick(scripts.world(loop.plant.state.time_s)).state.force_n for _ in range(12)]
        given = [observation.force_n for observation in controller.observations]
        np.testing.assert_array_equal(given[ticks:], [np.zeros(1), *after][: 12 - ticks])


def test_the_hand_s_speed_is_the_slope_of_its_height_and_ends_at_rest():
    step = 1e-6
    for time_s in (0.2, 0.7, 1.1, 1.9, 3.0):
        low, high = hand_motion(time_s - step), hand_motion(time_s + step)
        assert hand_motion(time_s)[1] == pytest.approx((high[0] - low[0]) / (2 * step), abs=1e-6)
        assert hand_motion(time_s)[2] == pytest.approx((high[1] - low[1]) / (2 * step), abs=1e-5)
    assert hand_motion(EPISODE_S) == pytest.approx((0.2, 0.0, 0.0))


def test_a_lamp_that_goes_out_takes_one_finger_s_readings():
    grip = few("margin", "lamp", episodes=1)  # between 2 and 4 s
    assert np.isfinite(grip.trace.margin).all()  # the other finger still reads
    assert not grip.episodes.dropped[0]


def test_an_interrupted_run_goes_on_to_the_same_record(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(episodes_module, "_BATCH", 2)
    monkeypatch.setattr(episodes_module, "_TICKS", 60)
    whole = few("margin", episodes=6)
    made = []

    def breaks(done: int, total: int) -> None:
        made.append(done)
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        few("margin", episodes=6, out=tmp_path / "grip", on_progress=breaks)
    assert not (tmp_path / "grip").exists()
    again: list[int] = []
    found = few("margin", episodes=6, out=tmp_path / "grip", on_progress=lambda done, _: again.append(done))
    assert np.array_equal(found.episodes.mean_force_n, whole.episodes.mean_force_n)
    stored = load_result(tmp_path / "grip", Grip, command="sliplens grip")
    assert np.array_equal(stored.episodes.force_excess, whole.episodes.force_excess)
    assert not (tmp_path / "grip" / "parts").exists()


def ratio_sensor(table: ReadingTable, known: list[Friction], **options: float) -> TableSensor:
    """Sensor of three quarters of F_t / F_n, as if a network predicted it."""
    friction, _, margins = np.meshgrid(FRICTIONS, FORCES_N, MARGINS, indexing="ij")
    ratio = np.broadcast_to(0.75 * friction * (1 - margins), table.margin.shape).astype(np.float32)
    table = replace(table, ratio={"mean": ratio, "sigma": np.full_like(ratio, 0.02)}, ratio_noise=0.0)
    learners, rng = list(map(SlipLearner, known)), np.random.default_rng(0)
    return TableSensor(table, fingertips=np.arange(3.0), rng=rng, learners=learners, **options)


def pulled(friction: float, ratio: float) -> Plant:
    """Plant of three episodes that hold with 1 N and are pulled."""
    plant = Plant(OBJECTS["cup"], episodes=3)
    plant.state = replace(
        plant.state, force_n=np.ones(3), shear_n=np.full((3, 2), ratio), friction=np.full((3, 2), friction)
    )
    return plant


@pytest.mark.parametrize(("scale", "read"), [(0.0, 0.24), (1.0, 0.18)])
def test_a_friction_that_is_told_makes_the_margin_of_the_ratio(table, scale, read):
    known = [Friction(0.3), Friction(0.6), Friction.between(0.3, 0.9)]
    eyes = ratio_sensor(table, known, error_scale=scale)
    sight = eyes.measure(pulled(0.3, 0.24).state, np.full(3, np.nan))
    for row, friction in enumerate(known):
        values, weights = friction.nodes
        # the table is even in the logarithm of the friction between its nodes, and 0.3 is one
        assert sight.margin[row] == pytest.approx(weights @ np.clip(1 - read / values, 0, 1), abs=2e-3)
    assert np.all(sight.low <= sight.margin)
    width = sight.high - sight.low
    assert np.all(width[2] > width[1])


def test_a_slip_narrows_what_was_told_of_friction(table):
    eyes = ratio_sensor(table, [Friction.between(0.1, 0.9)] * 3)
    plant, none = pulled(0.3, 0.29), np.full(3, np.nan)
    before = eyes.measure(plant.state, none)
    plant.state = replace(plant.state, time_s=0.1)
    after = eyes.measure(plant.state, np.array([0.05, np.nan, np.nan]))
    # it slipped at what was read: there is no margin left, as far as that can be told
    assert after.margin[0].mean() < 0.1 < before.margin[0].mean()
    assert after.margin[1:] == pytest.approx(before.margin[1:])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"friction": 0.6, "network": "thesis-raw"}, "F_t / F_n"),
        ({"episodes": 0}, "0 episodes cannot be run"),
        ({"condition": "snow"}, "there is no condition named 'snow'"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, Any], told: str):
    with pytest.raises(InputError, match=told):
        few("margin", **options)


def test_each_batch_has_a_copy_of_a_controller_of_one_s_own(monkeypatch):
    monkeypatch.setattr(episodes_module, "_BATCH", 2)
    own, named = (few(law, "jolt", episodes=4).episodes for law in (MarginLaw(), "margin"))
    np.testing.assert_array_equal(own.mean_force_n, named.mean_force_n)
