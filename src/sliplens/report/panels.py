"""Panels of saliency: the network's input above what each method made of it, from full stick to full slip."""

from dataclasses import dataclass
from typing import ClassVar

from sliplens.report.drawing import Picture, png_picture
from sliplens.report.overlay import overlay_saliency, stretch_saliency
from sliplens.report.records import Explained, ExplainedFrame
from sliplens.report.style import in_order, input_name, method_name, methods_in_order, percent, source_name

NOMINAL_MARGINS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
_TOLERANCE = 0.1  # half the distance between two columns


@dataclass(frozen=True, kw_only=True)
class PanelColumn:
    """Head of a column: what it stands for, the frame's label and the network's answer."""

    head: str
    label: str
    prediction: str


@dataclass(frozen=True, kw_only=True)
class PanelRow:
    """A row of pictures, one a column; None where no frame has that margin."""

    name: str
    cells: tuple[Picture | None, ...]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A table of pictures with its caption."""

    layout: ClassVar[str] = "panel"

    columns: tuple[PanelColumn, ...]
    rows: tuple[PanelRow, ...]
    caption: str


def build_panel(explained: Explained) -> Panel:
    """Lay out frames by safety margin (thesis, Figs. 8, 11 and 12).

    Where there are few frames, all of them; otherwise those nearest to 100, 80, 60, 40, 20 and 0 %, of the condition
    with the most frames; without labels, the first ones.
    """
    condition, chosen = choose_frames(explained.frames)
    columns = tuple(_column(nominal, explained.frames, index) for nominal, index in chosen)
    rows = [PanelRow(name="Input", cells=tuple(_input_picture(explained, index) for _, index in chosen))]
    rows += [
        PanelRow(
            name=method_name(method), cells=tuple(_overlay_picture(explained, method, index) for _, index in chosen)
        )
        for method in methods_in_order(explained.methods)
    ]
    absent = [percent(nominal) for nominal, index in chosen if index is None and nominal is not None]
    gap = f" No frame within 10 percentage points of {', '.join(absent)}." if absent else ""
    ids = ", ".join(explained.frames[index].id for _, index in chosen if index is not None)
    return Panel(
        columns=columns,
        rows=tuple(rows),
        caption=f"{input_name(explained.input)}, {source_name(explained.source)}, {condition}: what the network saw, "
        "and what each method holds to speak for the answer, rather than for that of the untouched sensor. Colours are "
        f"relative to each picture's own saliency, so brightness does not compare between pictures.{gap}"
        f"{_tell_blank(explained, chosen)} Frames: {ids}.",
    )


def choose_frames(frames: tuple[ExplainedFrame, ...]) -> tuple[str, list[tuple[float | None, int | None]]]:
    """Pick the condition, and a frame's index for each nominal margin (None where none is near).

    The nearest label wins and ties go to the first frame: the network's answer plays no part.
    """
    conditions = [frame.condition for frame in frames]
    condition = max(in_order(set(conditions), ("dry", "wet")), key=conditions.count)
    rows = [index for index, frame in enumerate(frames) if frame.condition == condition]
    labels = {index: margin for index in rows if (margin := frames[index].safety_margin) is not None}
    if not labels:
        return condition, [(None, index) for index in rows[: len(NOMINAL_MARGINS)]]
    if len(labels) == len(rows) <= len(NOMINAL_MARGINS):
        return condition, [(labels[index], index) for index in sorted(rows, key=lambda index: -labels[index])]
    chosen = []
    for nominal in NOMINAL_MARGINS:
        nearest = min(labels, key=lambda index: abs(labels[index] - nominal))
        near = abs(labels[nearest] - nominal) < _TOLERANCE
        chosen.append((nominal, nearest if near else None))
    return condition, chosen


def _column(nominal: float | None, frames: tuple[ExplainedFrame, ...], index: int | None) -> PanelColumn:
    frame = None if index is None else frames[index]
    head = "Γ not known" if nominal is None else f"Γ {percent(nominal)}"
    told = frame is not None and head == f"Γ {percent(frame.safety_margin)}"
    return PanelColumn(
        head=head,
        # a label that the head gives already is not given twice
        label="no frame" if frame is None else "" if told else f"true {percent(frame.safety_margin)}",
        prediction="" if frame is None else f"read {percent(frame.prediction)}",
    )


def _input_picture(explained: Explained, index: int | None) -> Picture | None:
    if index is None:
        return None
    return png_picture(explained.pictures[index], alt=f"Input of the network, frame {_told(explained.frames[index])}")


def _overlay_picture(explained: Explained, method: str, index: int | None) -> Picture | None:
    if index is None:
        return None
    pixels = overlay_saliency(explained.pictures[index], stretch_saliency(explained.saliency[method][index]))
    return png_picture(pixels, alt=f"{method_name(method)} over frame {_told(explained.frames[index])}")


def _tell_blank(explained: Explained, chosen: list[tuple[float | None, int | None]]) -> str:
    rows = [index for _, index in chosen if index is not None]
    blank = sum(not explained.saliency[method][index].any() for method in explained.methods for index in rows)
    if not blank:
        return ""
    pictures = "1 picture has" if blank == 1 else f"{blank} pictures have"
    return f" {pictures} no colour: there the method finds nothing that speaks for the answer."


def _told(frame: ExplainedFrame) -> str:
    return f"{frame.id}, true Γ {percent(frame.safety_margin)}, read {percent(frame.prediction)}"
