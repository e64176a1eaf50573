"""What the labels of an imported trial rest on, in words."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sliplens.recordings import ContactState, Recording
from sliplens.report.style import decimals, signed

_MINUS = "\N{MINUS SIGN}"
_LOOSE = 10.0  # percentage points: beyond, margins 20 points apart are hard to tell apart
_SEEN_SIGMAS = 5.0  # an image that moves less at the onset does not speak for a slip


class Fact(NamedTuple):
    """A paragraph beside the charts."""

    head: str
    words: list[str]
    doubtful: bool = False
    """Whether a label may be wrong for it."""
    indent: str = ""


def audit_facts(recording: Recording, labelling: Mapping[str, Any]) -> list[Fact]:
    """Tell what the labels rest on: what was declared, found and assumed, and what of it is doubtful."""
    if labelling["friction"] is None:
        return _tell_given(recording, labelling)
    axes, notes = labelling["axes"], [*labelling["axes"]["notes"], *labelling["notes"]]
    found = {name: _found(axes[f"{name}_found"]) for name in ("normal", "sign", "tare")}
    pressing = f"normal force is {'+' if axes['sign'] > 0 else _MINUS}{axes['normal']}"
    still = f"untouched until {decimals(axes['still_until_s'], 2)} s"
    reference, limit = labelling["reference"], labelling["force_range_n"]
    energy, drift = (decimals(reference[name], 2) for name in ("contact_energy", "drift"))
    means = f"means over {_milli(labelling['window_s'])} ms; gaps over {_milli(labelling['gap_s'])} ms count as missing"
    return [
        _tell_frames(recording),
        Fact(
            "Axes",
            [f"{pressing} (axis {found['normal']}, sign {found['sign']})"],
            any("axis" in note for note in axes["notes"]),
        ),
        Fact(
            f"Tare {found['tare']}",
            [
                f"x, y, z: {_three(axes['tare_n'], signed)} N",
                f"± {_three(axes['tare_sigma_n'])} N",
                f"noise of a sample {_three(axes['noise_n'])} N",
                still,
            ],
            axes["tare_found"] == "assumed",
        ),
        _tell_friction(labelling["friction"], labelling["slip_s"]),
        _tell_lag(recording, labelling["lag"], applied=labelling["lag_applied"]),
        Fact(
            "Forces",
            [
                f"contact from {decimals(labelling['contact_threshold_n'], 3)} N",
                means,
                "range of the sensor not told" if limit is None else f"range of the sensor ± {limit:g} N",
            ],
        ),
        Fact(
            "Reference",
            [str(reference["method"])]
            if reference["index"] is None
            else [
                f"frame {reference['index']}, {reference['method']}",
                f"contact energy {energy}, drift {drift} grey levels",
            ],
        ),
        *([Fact("Notes", [f"• {note}" for note in notes], indent="   ")] if notes else []),
    ]


def _tell_given(recording: Recording, labelling: Mapping[str, Any]) -> list[Fact]:
    """Tell of labels that came with the frames, and were not found from forces."""
    reference, clip = labelling["reference"], labelling.get("clip") or {}
    which = "recorded apart from the frames" if reference["index"] is None else f"frame {reference['index']}"
    labelled = bool(recording.labelled.any())
    words = ["They came with the recording; nothing was found from forces."] if labelled else ["No frame has one."]
    known = [f"{name.replace('_', ' ')}: {_plainly(value)}" for name, value in clip.items()]
    notes = [f"• {note}" for note in labelling["notes"]]
    counts = labelling["frames_by_reason"]
    lost = [", ".join(f"{count} {reason}" for reason, count in counts.items() if reason != "valid")]
    return [
        Fact(f"Frames: {counts.get('valid', 0)} of {sum(counts.values())} valid", lost),
        Fact("Labels", words, doubtful=not labelled),
        *([Fact("Known of the whole clip", known)] if known else []),
        Fact("Reference", [which]),
        *([Fact("Notes", notes, indent="   ")] if notes else []),
    ]


def _plainly(value: object) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _tell_frames(recording: Recording) -> Fact:
    """Count the frames with a valid label, and the others by what they lack."""
    states, sigma = np.array([str(state) for state in recording.contact_state]), recording.safety_margin_sigma
    lacking = {
        "missing samples": np.isnan(recording.normal_force_n),
        "no contact": states == ContactState.NO_CONTACT,
        "after gross slip": states == ContactState.FULL_SLIP,
        "outside the sensor's range": np.isnan(recording.safety_margin),
    }
    kinds = np.select([recording.labelled, *lacking.values()], range(5), default=5)
    counts = dict(zip(("valid", *lacking, "not valid"), np.bincount(kinds, minlength=6).tolist(), strict=True))
    words = [", ".join(f"{count} {name}" for name, count in counts.items() if count and name != "valid")]
    middle = most = 0.0
    if sigma is not None and np.isfinite(sigma).any():
        middle, most = 100 * float(np.nanmedian(sigma)), 100 * float(np.nanmax(sigma))
        words.append(f"Γ known to ± {middle:.1f} % (median), {most:.1f} % at worst")
    lost = counts["missing samples"] + counts["outside the sensor's range"]
    return Fact(f"Frames: {counts['valid']} of {len(states)} valid", words, lost > 0 or middle > _LOOSE)


def _tell_friction(friction: Mapping[str, Any], slip_s: float | None) -> Fact:
    low, high, moved = friction["low"], friction["high"], friction["image_sigmas"]
    exact = low is not None and low == high
    interval = "taken as exact" if exact else f"68 % interval {decimals(low, 3)} to {decimals(high, 3)}"
    image = [] if moved is None else [f"image moves {moved:.1f} σ more at the slip"]  # noqa: RUF001 (sigma is meant)
    slip = "never slips" if slip_s is None else f"slips at {slip_s:.3f} s on the clock of the forces"
    unseen = friction["found"] == "inferred" and (moved is None or moved < _SEEN_SIGMAS)
    words = [f"μ {decimals(friction['mu'], 3)}, {interval}", friction["method"], *image, slip]
    return Fact(f"Friction {_found(friction['found'])}", words, exact or unseen)


def _tell_lag(recording: Recording, lag: Mapping[str, Any] | None, *, applied: bool) -> Fact:
    head = f"Lag {'applied' if applied else 'not applied'}"
    if lag is None or lag["doubt"]:
        return Fact(head, [f"cannot be told: {lag['doubt']}" if lag else "not estimated"], doubtful=True)
    late = f"camera late by {_milli(lag['lag_s'])} ± {_milli(lag['sigma_s'])} ms"
    # beyond chance, and as much as half a frame: the labels are those of another frame
    least = max(2 * (lag["sigma_s"] or 0), np.ptp(recording.time_s) / (2 * len(recording)))
    ignored = not applied and abs(lag["lag_s"] or 0) > least
    return Fact(head, [late, f"correlation {decimals(lag['correlation'], 2)}"], bool(ignored))


def _found(how: str) -> str:
    return "found" if how == "inferred" else how


def _milli(value: float | None) -> str:
    return decimals(None if value is None else 1000 * value, 1).replace("-", _MINUS)


def _three(values: Sequence[float | None], write: Callable[..., str] = decimals) -> str:
    return ", ".join(decimals(None, 0) if one is None else write(one, 3) for one in values)
