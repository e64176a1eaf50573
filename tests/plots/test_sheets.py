"""The audit page of a trial, and the frames that are chosen for it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn import misplaced, pictures, pulled_trial
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from there import there

from sliplens.plots.sheets import STATE_COLOURS, brightening, choose_margins, draw_audit, spread_audit_frames
from sliplens.recordings import ContactState, Recording
from sliplens.recordings import labelling as labels
from sliplens.recordings.labelling import Labelling, Lag
from sliplens.results.explanation import MARGIN_LEVELS

NO_CONTACT, CONTACT, INCIPIENT_SLIP, FULL_SLIP, _ = ContactState
MU = 0.53


def make_trial(*, pull: int = 41, lowest: float = 0.0, step_s: float = 0.04, **more: Any) -> Recording:
    """A pulled trial whose labels are valid while the contact holds."""
    trial = pulled_trial(pull=pull, lowest=lowest, step_s=step_s, mu=MU, **more)
    valid = np.array([state in (CONTACT, INCIPIENT_SLIP) for state in trial.contact_state])
    reason = tuple(
        {NO_CONTACT: "no contact", FULL_SLIP: "after gross slip"}.get(each, "") for each in trial.contact_state
    )
    return replace(trial, safety_margin_sigma=np.where(valid, 0.031, np.nan), valid=valid, reason=reason)


AXES = labels.ForceAxes(
    normal="z",
    sign=-1,
    tare_n=(0.211, -0.322, 1.433),
    noise_n=(0.021, 0.022, 0.023),
    tare_sigma_n=(0.001, 0.002, 0.003),
    still_until_s=0.12,
)
FRICTION = labels.FrictionEstimate(
    mu=MU, low=0.517, high=0.546, onset_s=1.97, method="break of F_t / F_n, seen in the image"
)
LAG = Lag(lag_s=0.015, sigma_s=0.009, correlation=0.87)
REFERENCE = labels.ReferenceChoice(index=2, method="least contact energy")


def make_labelling(
    *, reference: labels.ReferenceChoice = REFERENCE, source: str = "/data/one.mkv", **changes: Any
) -> Labelling:
    """Everything found, nothing doubtful; the trial slips at 1.97 s."""
    basis = labels.LabelBasis(
        axes=AXES, friction=FRICTION, slip_s=1.97, lag=LAG, lag_applied=False, contact_threshold_n=0.061
    )
    return Labelling(
        source=source,
        forces=changes.pop("forces", "/data/one.csv"),
        notes=tuple(changes.pop("notes", ["one.csv: times are those of column 't'."])),
        reference=reference,
        basis=replace(basis, **changes),
    )


def told(figure: Figure) -> str:
    """All words, lines that were wrapped put together again."""
    words = " ".join(found.get_text() for found in figure.findobj(Text))
    return " ".join(words.replace("\N{NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-").split())


def charts(figure: Figure) -> list[Axes]:
    return [ax for ax in figure.axes if ax.get_ylabel()]


def bands(ax: Axes) -> list[PolyCollection]:
    return [one for one in ax.collections if isinstance(one, PolyCollection)]


def onsets(ax: Axes) -> list[float]:
    return [float(np.asarray(line.get_xdata())[0]) for line in ax.lines if "slip at" in str(line.get_label())]


def test_flags_stand_before_what_is_told():
    faults = (
        labels.ForceFault(kind=labels.Reason.SPIKE, start_s=1.0, end_s=1.0, largest_n=70.0),
        labels.ForceFault(kind=labels.Reason.SPIKE, start_s=1.4, end_s=1.41, largest_n=9.0),
    )
    words = told(draw_audit(make_trial(), make_labelling(faults=faults, doubts=("a friction of 9 was given",))))
    assert "a friction of 9 was given" in words
    assert words.index("▲ spike of the force in 2 places from 1.00 s on") < words.index("46 of 53")


def test_words_hold_what_the_labels_rest_on():
    words = told(draw_audit(make_trial(), make_labelling()))

    numbers = ("46 of 53", "± 3.1 %", "0.530 (68 % interval 0.517 to 0.546)", "1.970 s", "15.0 ± 9.0 ms", "frame 2")
    names = ("day1-dry-001", "test-sensor, day 1, dry", "/data/one.mkv", "/data/one.csv", "times are those of")
    for fact in (*numbers, *names):
        assert fact in words


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"lag": None}, "lag not estimated"),
        ({"lag": Lag(lag_s=0.1, sigma_s=0.1, correlation=0.2, doubt="they correlate too little")}, "lag unknown: they"),
        ({"lag_applied": True}, "15.0 ± 9.0 ms, taken off"),
        ({"friction": replace(FRICTION, low=MU, high=MU)}, "taken as exact"),
        ({"slip_s": None}, "no slip found"),
        ({"doubts": ("the normal axis is doubtful",)}, "▲ the normal axis is doubtful"),
    ],
)
def test_words_follow_the_labels(changes, fact):
    assert fact in told(draw_audit(make_trial(), make_labelling(**changes)))
    assert fact not in told(draw_audit(make_trial(), make_labelling()))


def test_charts_draw_forces_ratio_margin_and_its_sigma_at_the_frames():
    trial = make_trial()
    figure = draw_audit(trial, make_labelling())
    lines = {str(line.get_label()): np.asarray(line.get_ydata()) for ax in charts(figure) for line in ax.lines}
    touches = trial.normal_force_n > 0
    np.testing.assert_array_equal(lines["$F_n$"], trial.normal_force_n)
    np.testing.assert_array_equal(lines["$F_t$"], trial.tangential_force_n)
    np.testing.assert_allclose(lines["contact from 0.061 N"], 0.061)
    np.testing.assert_allclose(lines[r"$\mu_s$ = 0.53"], MU)
    # by Coulomb, Γ is what the ratio leaves of mu
    np.testing.assert_allclose(lines["$F_t/F_n$ in contact"][touches], MU * (1 - trial.safety_margin[touches]))
    assert np.isnan(lines["$F_t/F_n$ in contact"][~touches]).all()
    np.testing.assert_array_equal(lines["Γ"][trial.labelled], 100 * trial.safety_margin[trial.labelled])
    # frames without a valid label are drawn apart
    assert trial.valid is not None
    np.testing.assert_array_equal(np.isfinite(lines["Γ"]), trial.valid)
    np.testing.assert_array_equal(np.isfinite(lines["no valid label"]), ~trial.valid)
    # the band is one sigma either way
    (band,) = bands(charts(figure)[2])
    corners = np.concatenate([path.vertices for path in band.get_paths()])
    ends = [*corners.min(axis=0), *corners.max(axis=0)]
    assert ends == [trial.time_s[4], pytest.approx(-3.1), trial.time_s[-4], pytest.approx(103.1)]
    # marks stand where the frames were taken
    taken = trial.time_s[[2, *spread_audit_frames(trial)]]
    for ax in charts(figure):
        marks = [np.asarray(line.get_xdata())[0] for line in ax.lines if line.get_label() == "_frame"]
        np.testing.assert_array_equal(marks, taken)


@pytest.mark.parametrize(("applied", "seen"), [(False, 1.97), (True, 1.985)])
def test_onset_is_marked_on_the_cameras_clock(applied, seen):
    figure = draw_audit(make_trial(), make_labelling(lag_applied=applied))

    for ax in charts(figure):
        assert onsets(ax) == [pytest.approx(seen)]


@pytest.mark.parametrize("changes", [{}, {"lowest": 0.4}, {"pull": 700}, {"pull": 2}])
def test_pictures_are_the_reference_and_frames_in_the_order_of_time(changes):
    trial = make_trial(**changes)
    camera, difference = pictures(draw_audit(trial, make_labelling()))

    along = spread_audit_frames(trial)
    assert len(camera) == len(difference) == 1 + len(along)
    assert along == sorted(set(along))
    np.testing.assert_array_equal(camera[0].images[0].get_array(), trial.reference)
    for ax, index in zip(camera[1:], along, strict=True):
        np.testing.assert_array_equal(ax.images[0].get_array(), trial.frames[index])
        assert to_hex(ax.spines["top"].get_edgecolor()).upper() == STATE_COLOURS[trial.contact_state[index]]


def test_a_trial_without_its_pixels_has_those_read_that_are_shown():
    trial = make_trial()
    bare = replace(trial, frames=np.broadcast_to(trial.reference, trial.frames.shape))
    asked: list[int] = []

    def read(places: Sequence[int]) -> np.ndarray:
        asked.extend(places)
        return trial.frames[list(places)]

    shown, expected = draw_audit(bare, make_labelling(), read_frames=read), draw_audit(trial, make_labelling())

    for row, other in zip(pictures(shown), pictures(expected), strict=True):
        for ax, whole in zip(row, other, strict=True):
            np.testing.assert_array_equal(ax.images[0].get_array(), whole.images[0].get_array())
    # the six frames, and an untouched one to tell the drift
    assert len(asked) == 7


@pytest.mark.parametrize("size", [(24, 32), (90, 16)])
def test_no_words_lie_over_others_or_leave_the_page(size):
    trial = replace(
        make_trial(size=size, step_s=40.0),
        trial="a_trial_with_a_name_as_$long$ as a sentence that goes on and on and on and does not end where it should",
        sensor="Some Sensor Mini 2 no 31 of the second batch, glued anew",
        condition="rubbed with oil and then with water",
    )
    told = make_labelling(
        source="/a/very/long/path" * 9,
        forces="/another/of/these" * 9,
        notes=["a note that tells of a doubt at some length, and of its cure"] * 30,
        slip_s=1970.1,
        lag=Lag(lag_s=-0.1, sigma_s=0.1, correlation=0.2, doubt="several lags fit alike " * 4),
        friction=replace(FRICTION, low=MU, high=MU, method="given by hand, after three trials by eye"),
        axes=replace(AXES, tare_n=(-1234.5, 2345.6, -3456.7)),
        doubts=("the normal axis is doubtful",),
    )

    outside, pairs = misplaced(draw_audit(trial, told))

    assert not outside
    assert not pairs


@pytest.mark.parametrize("pull", [11, 41, 700])
def test_chosen_frames_are_the_nearest_to_the_margins(pull):
    trial = pulled_trial(pull=pull)
    for nominal, index in zip(MARGIN_LEVELS, choose_margins(trial), strict=True):
        nearest = np.nanmin(np.abs(trial.safety_margin - nominal))
        # frames within half a percentage point are told apart by their force alone
        assert abs(trial.safety_margin[there(index)] - nominal) <= nearest + 0.005


def test_full_stick_is_shown_where_the_sensor_is_pressed_hardest():
    trial = pulled_trial()

    first, pressed = there(choose_margins(trial)[0]), [state == CONTACT for state in trial.contact_state]
    assert pressed[first]
    assert trial.normal_force_n[first] == trial.normal_force_n[pressed].max()


def test_frames_of_a_later_stick_are_left_alone():
    trial = pulled_trial()
    # after sliding the contact sticks again at exactly 40 %, and is pressed harder than ever
    margin, force = trial.safety_margin.copy(), trial.normal_force_n.copy()
    margin[-1], force[-1] = 0.4, 9.0
    again = replace(
        trial, safety_margin=margin, normal_force_n=force, contact_state=(*trial.contact_state[:-1], INCIPIENT_SLIP)
    )

    assert choose_margins(again)[:-1] == choose_margins(trial)[:-1]


@pytest.mark.parametrize(("lowest", "missing"), [(0.52, 3), (0.5, 3), (0.49, 2), (0.12, 1), (0.05, 0)])
def test_margin_is_missing_where_no_frame_is_within_ten_points(lowest, missing):
    found = choose_margins(pulled_trial(lowest=lowest))

    assert [index is None for index in found] == [False] * (6 - missing) + [True] * missing


@pytest.mark.parametrize(("level", "factor"), [(51, 5.0), (255, 1.0), (0, 255.0), (250, 1.0)])
def test_brightening_makes_the_brightest_pixels_white(level, factor):
    difference = np.full((1, 8, 8, 3), level, dtype=np.uint8)

    assert brightening([difference[:, :4], difference // 2]) == factor
