"""Directions of the pull: margins outside those of the training are withheld, inside they are not."""

from dataclasses import replace

import numpy as np
import pytest
from pulled import pulled_frames
from scripted import source_of

import sliplens as sl
from sliplens.live.health import HealthMonitor
from sliplens.live.reading import Reading
from sliplens.models import Network
from sliplens.shear import FULL_CIRCLE

TURNS = {
    "as it is": lambda images: images,
    "turned": lambda images: images[..., ::-1, ::-1, :],
    "mirrored": lambda images: images[..., ::-1, :],
    "upside down": lambda images: images[..., ::-1, :, :],
}
ASTRAY, IN_RANGE = (0.02, 0.15, 0.25), (0.02, 0.25, 0.6, 1.0)
"""Margins of the frames: without shear there is no direction, so that all of the first show theirs."""
CASES = [
    *((0.0, "as it is", ASTRAY), (270.0, "as it is", ASTRAY), (90.0, "upside down", ASTRAY)),
    *((90.0, "as it is", IN_RANGE), (90.0, "mirrored", IN_RANGE), (270.0, "turned", IN_RANGE)),
]


@pytest.fixture(scope="module")
def pulled_down() -> Network:
    """Network of the package that was trained on pulls of 75 to 105 degrees, whatever its manifest says."""
    network = sl.load("chromatouch-pair")
    return replace(network, manifest=replace(network.manifest, pull_direction_deg=(75.0, 105.0), novelty=None))


def turned_frames(direction_deg: float, turn: str, *, margins: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    reference, frames = pulled_frames(direction_deg, 1, margins=margins)
    return np.ascontiguousarray(TURNS[turn](reference)), np.ascontiguousarray(TURNS[turn](frames))


def read_live(network: Network, reference: np.ndarray, frames: np.ndarray) -> list[Reading]:
    """Read frames as a running sensor's, none of them dropped."""
    return source_of(frames).all_readings(network, reference=reference, health=HealthMonitor)


def withheld_by(network: Network, reference: np.ndarray, frames: np.ndarray, *, live: bool) -> list[bool]:
    if live:
        return [
            any(check.name == "direction" and not check.ok for check in reading.health) and reading.margin is None
            for reading in read_live(network, reference, frames)
        ]
    table = sl.predict(network, frames, reference=reference, engine="torch").to_arrow()
    hidden = [reason is not None for reason in table["withheld"].to_pylist()]
    assert [margin is None for margin in table["prediction"].to_pylist()] == hidden
    return hidden


@pytest.mark.parametrize("live", [False, True], ids=["files", "live"])
@pytest.mark.parametrize(("direction_deg", "turn", "margins"), CASES)
def test_a_margin_is_withheld_where_the_pull_is_in_another_direction(
    pulled_down: Network, direction_deg: float, turn: str, margins: tuple[float, ...], live: bool
):
    reference, frames = turned_frames(direction_deg, turn, margins=margins)
    assert set(withheld_by(pulled_down, reference, frames, live=live)) == {margins == ASTRAY}


@pytest.mark.parametrize("live", [False, True], ids=["files", "live"])
def test_a_network_of_all_directions_withholds_none(pulled_down: Network, live: bool):
    reference, frames = turned_frames(270.0, "as it is", margins=(0.02,))
    for directions in (FULL_CIRCLE, None):
        network = replace(pulled_down, manifest=replace(pulled_down.manifest, pull_direction_deg=directions))
        assert not any(withheld_by(network, reference, frames, live=live))
