"""Words of a reading follow its interval, its risk and its markers, and never contradict each other."""

from itertools import product

import pytest

from sliplens.live.reading import TARGET, MarkerReading, Reading, SlipState, Zone, describe_reading
from sliplens.recordings.trial import ContactState

LEAST, MOST = TARGET
SHARES = (0.0, 0.05, 0.15, 0.25, 0.35, 0.45, 0.7, 1.0)


def reading(margin: float | None = None, low: float | None = None, high: float | None = None, **more) -> Reading:
    return Reading(number=0, time_s=0.0, captured_s=0.0, margin=margin, low=low, high=high, **more)


READINGS = [
    reading(margin, low, high, risk=risk, slip=slip, contact_state=ContactState.INCIPIENT_SLIP)
    for low, margin, high in product(SHARES, repeat=3)
    if low <= margin <= high
    for risk in (None, 0.05, 0.3, 0.6)
    for slip in (None, *SlipState)
]
"""Of all intervals, risks and states of the markers."""


@pytest.mark.parametrize("margin", SHARES)
def test_the_zone_is_that_of_the_interval_wherever_the_margin_lies_in_it(margin: float):
    expected = {
        (0.0, 0.15): Zone.BELOW,
        (0.15, 0.7): Zone.UNCERTAIN,
        (0.25, 0.35): Zone.WITHIN,
        (0.35, 0.7): Zone.NOT_BELOW,
        (0.45, 1.0): Zone.ABOVE,
    }
    for (low, high), zone in expected.items():
        if low <= margin <= high:
            assert describe_reading(reading(margin, low, high)).zone is zone


def test_a_grip_is_tight_enough_only_where_all_of_the_interval_is():
    for one in READINGS:
        words = describe_reading(one)
        assert one.low is not None
        assert one.high is not None
        if words.zone in {Zone.WITHIN, Zone.NOT_BELOW, Zone.ABOVE}:
            assert one.low >= LEAST
        if words.zone is Zone.ABOVE:
            assert one.low >= MOST
        if words.zone is Zone.BELOW:
            assert one.high < LEAST or one.slip is SlipState.SLIP


def test_a_higher_risk_says_less_and_never_more():
    for one in READINGS:
        if one.slip is SlipState.SLIP:
            continue
        sure = describe_reading(reading(one.margin, one.low, one.high)).zone
        zone = describe_reading(one).zone
        assert zone in {sure, Zone.UNCERTAIN} or (sure in {Zone.WITHIN, Zone.ABOVE} and zone is Zone.NOT_BELOW)
        if one.risk == 0.6:
            assert zone is Zone.UNCERTAIN


def test_a_slip_that_the_markers_show_is_never_called_safe():
    for one in READINGS:
        words = describe_reading(one)
        if one.slip is SlipState.SLIP:
            assert words.zone in {Zone.BELOW, Zone.UNCERTAIN}
            assert words.contact in {ContactState.FULL_SLIP, ContactState.UNKNOWN}
        else:
            certain = (one.risk or 0) <= 0.5
            expected = {ContactState.CONTACT, ContactState.INCIPIENT_SLIP} if certain else {ContactState.UNKNOWN}
            assert words.contact in expected


@pytest.mark.parametrize("margin", [None, 0.6])
@pytest.mark.parametrize("slip", [None, *SlipState])
def test_what_is_withheld_gives_its_reason_and_no_other_words(margin: float | None, slip: SlipState | None):
    words = describe_reading(reading(margin, slip=slip, withheld="the camera moved"))
    assert words.zone is Zone.NONE
    assert "the camera moved" in words.advice
    assert words.contact == ContactState.UNKNOWN


@pytest.mark.parametrize("contact", [None, False, True])
def test_without_a_network_the_markers_are_described(contact: bool | None):
    markers = MarkerReading(state=SlipState.CANNOT_TELL, contact=contact)
    state = ContactState.NO_CONTACT if contact is False else ContactState.UNKNOWN
    words = describe_reading(reading(markers=markers, slip=markers.state, contact_state=state))
    assert words.contact == {None: "unknown", False: "no contact", True: "contact"}[contact]
    assert not words.margin
