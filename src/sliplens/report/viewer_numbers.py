"""Numbers and states of a trial over time, for the Rerun viewer."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.colors import to_rgba

from sliplens.recordings import ContactState, Recording
from sliplens.recordings.capture import Forces
from sliplens.report.style import GREEN, GREY
from sliplens.report.trial_charts import STATE_COLOURS
from sliplens.report.viewer_layout import LINES, SAMPLE_LINES
from sliplens.report.viewer_process import require_rerun

if TYPE_CHECKING:
    from rerun import RecordingStream, TimeColumn

_STATE_COLOURS = {str(state): colour for state, colour in STATE_COLOURS.items()}
_LABEL_COLOURS = {"valid": GREEN, "not valid": GREY}
_SAMPLES_TOGETHER = 2**16


def clock(time_s: Float[np.ndarray, " _"], frames: Int[np.ndarray, " _"]) -> "list[TimeColumn]":
    """Both timelines of some frames: `time`, on the clock of the camera, and `frame`."""
    rerun = require_rerun()
    return [rerun.TimeColumn("time", duration=_nanoseconds(time_s)), rerun.TimeColumn("frame", sequence=frames)]


def rgba(colour: str) -> list[int]:
    """Red, green, blue and opacity of a colour, 0 to 255."""
    return [round(255 * part) for part in to_rgba(colour)]


def force_ratio(trial: Recording) -> Float[np.ndarray, " frames"]:
    """F_t / F_n where something touches, NaN elsewhere."""
    normal = trial.normal_force_n
    touches = (normal > 0) & np.array([state != ContactState.NO_CONTACT for state in trial.contact_state])
    return np.divide(trial.tangential_force_n, normal, where=touches, out=np.full(len(trial), np.nan))


def log_numbers(stream: "RecordingStream", trial: Recording, static_friction: Float[np.ndarray, " _"] | None) -> None:
    """Log forces, their ratio where something touches, and labels: a line each."""
    rerun = require_rerun()
    normal = trial.normal_force_n
    margin, sigma = 100 * trial.safety_margin, trial.safety_margin_sigma
    lines = {
        "force/normal": normal,
        "force/tangential": trial.tangential_force_n,
        "force/limit": trial.friction_coefficient * normal,
        "ratio/tangential_to_normal": force_ratio(trial),
        "margin/gamma": margin,
        "margin/stick_ratio": 100 * trial.stick_ratio,
    }
    if static_friction is None:
        lines["ratio/friction"] = trial.friction_coefficient
    else:
        lines["ratio/static_friction"] = static_friction
    if sigma is not None:
        lines |= {"margin/band/high": margin + 100 * sigma, "margin/band/low": margin - 100 * sigma}
    times = clock(trial.time_s, np.arange(len(trial)))
    for entity, values in lines.items():
        name, colour = LINES[entity]
        width = 1.0 if "band" in entity else 2.0
        stream.log(entity, rerun.SeriesLines(names=name, colors=[rgba(colour)], widths=width), static=True)
        stream.send_columns(entity, times, rerun.Scalars.columns(scalars=values))


def log_states(stream: "RecordingStream", trial: Recording) -> None:
    """Log when the contact changes its state, and when labels begin and cease to be valid."""
    rerun = require_rerun()
    lanes = [("state/contact", [str(state) for state in trial.contact_state], _STATE_COLOURS)]
    if trial.valid is not None:
        lanes.append(("state/label", ["valid" if one else "not valid" for one in trial.labelled], _LABEL_COLOURS))
    for entity, states, colours in lanes:
        style = rerun.StateConfiguration(values=list(colours), colors=[rgba(colour) for colour in colours.values()])
        stream.log(entity, style, static=True)
        begins = np.flatnonzero([at == 0 or state != states[at - 1] for at, state in enumerate(states)])
        columns = rerun.StateChange.columns(state=[states[at] for at in begins])
        stream.send_columns(entity, clock(trial.time_s[begins], begins), columns)


def log_samples(stream: "RecordingStream", forces: Forces, labelling: Mapping[str, Any] | None) -> None:
    """Log what the force sensor recorded, on the clock of the camera if its lag was applied to the labels."""
    rerun = require_rerun()
    told = labelling or {}
    late_s = (told["lag"]["lag_s"] or 0.0) if told.get("lag_applied") and told.get("lag") else 0.0
    names, colours = list(SAMPLE_LINES), [rgba(colour) for colour in SAMPLE_LINES.values()]
    stream.log("sensor/force", rerun.SeriesLines(names=names, colors=colours, widths=[1.0] * len(names)), static=True)
    for begin in range(0, len(forces.time_s), _SAMPLES_TOGETHER):
        some = slice(begin, begin + _SAMPLES_TOGETHER)
        time = rerun.TimeColumn("time", duration=_nanoseconds(forces.time_s[some] + late_s))
        stream.send_columns("sensor/force", [time], rerun.Scalars.columns(scalars=forces.force_n[some]))


def _nanoseconds(time_s: Float[np.ndarray, " _"]) -> np.ndarray:
    # rounded here: Rerun cuts off, and a third of a second could come back a nanosecond short
    return np.round(1e9 * time_s).astype("timedelta64[ns]")
