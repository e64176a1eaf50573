"""Files beside a study's `result.json`: long tables, maps and pictures, each checked as it is read."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float, UInt8

from sliplens.errors import ImageError, InputError
from sliplens.images import read_image
from sliplens.results.faithfulness import DeletionCurve, Key, RemovalCurve
from sliplens.results.fields import Fields
from sliplens.results.files import read_table
from sliplens.results.study import MarkerEffects, StateFrame

_CURVES = ("most_first", "least_first", "random")


def read_removal_curves(path: Path, *, command: str) -> dict[Key, RemovalCurve]:
    """Read curves of removal by fill, unit and method.

    Raises
    ------
    InputError
        If the file is missing or damaged, lacks a column, or a frame lacks areas that others have.
    """
    table = read_table(path, ("fill", "unit", "method", "frame_id", "trial", "area", *_CURVES), command=command)
    names = [_texts(table, name) for name in ("fill", "unit", "method")]
    frame, trial = _texts(table, "frame_id"), _texts(table, "trial")
    area = np.round(_numbers(table, "area"), 9)
    values = np.stack([_numbers(table, name) for name in _CURVES])
    found = {}
    for key, rows in _groups(names):
        ids, first, at = np.unique(frame[rows], return_index=True, return_inverse=True)
        areas, step = np.unique(area[rows], return_inverse=True)
        if len(rows) != len(ids) * len(areas) or len(np.unique(at * len(areas) + step)) != len(rows):
            raise InputError(
                f"{path} lacks areas of some frames under {' / '.join(key)}; make it again with `{command}`"
            )
        curves = np.empty((len(_CURVES), len(ids), len(areas)))
        curves[:, at, step] = values[:, rows]
        found[key[0], key[1], key[2]] = RemovalCurve(
            frame_ids=tuple(ids.tolist()),
            trials=trial[rows][first],
            areas=areas,
            **dict(zip(_CURVES, curves, strict=True)),
        )
    return found


def read_variant_curves(path: Path, *, command: str) -> dict[tuple[str, str], dict[str, DeletionCurve]]:
    """Read deletion or insertion curves by variant and method, then by frame: they may differ in length.

    Raises
    ------
    InputError
        If the file is missing or damaged, or lacks a column.
    """
    columns = ("variant", "method", "frame_id", "step", "pixels_removed", "prediction", "score")
    table = read_table(path, columns, command=command)
    step, removed = (_numbers(table, name).astype(np.int64) for name in ("step", "pixels_removed"))
    prediction, score = (_numbers(table, name) for name in ("prediction", "score"))
    found: dict[tuple[str, str], dict[str, DeletionCurve]] = {}
    for (variant, method, frame), unsorted in _groups([_texts(table, name) for name in columns[:3]]):
        rows = unsorted[np.argsort(step[unsorted], kind="stable")]
        found.setdefault((variant, method), {})[frame] = DeletionCurve(
            frame_ids=(frame,),
            pixels_removed=removed[rows],
            scores=score[rows][None],
            predictions=prediction[rows][None],
        )
    return found


def read_effects(path: Path, *, command: str) -> MarkerEffects:
    """Read what putting each marker back does.

    Raises
    ------
    InputError
        If the file is missing or damaged, or lacks a column.
    """
    numbers = ("x_px", "y_px", "network_effect", "margin_effect")
    table = read_table(path, ("frame_id", "trial", "marker", "state", *numbers), command=command)
    return MarkerEffects(
        frame_id=_texts(table, "frame_id"),
        trial=_texts(table, "trial"),
        marker=_numbers(table, "marker").astype(np.int64),
        x_px=_numbers(table, "x_px"),
        y_px=_numbers(table, "y_px"),
        network=_numbers(table, "network_effect"),
        margin=_numbers(table, "margin_effect"),
        state=_numbers(table, "state").astype(np.int64),
    )


def read_truth_maps(
    path: Path, *, frames: int, command: str
) -> tuple[Float[np.ndarray, "frames height width"], Float[np.ndarray, "frames height width"]]:
    """Effects on the network and on the margin, painted on the markers, a map a frame.

    Raises
    ------
    InputError
        If the file is missing or damaged, or its maps are not one a frame and finite.
    """
    cure = f"make the folder again with `{command}`"
    try:
        with np.load(path, allow_pickle=False) as archive:
            maps = [archive[name].astype(np.float32) for name in ("network", "margin")]
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {cure}") from None
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as maps ({error}); {cure}") from None
    for one in maps:
        if one.ndim != 3 or len(one) != frames or one.shape != maps[0].shape or not np.isfinite(one).all():
            raise InputError(f"{path} holds maps of shape {one.shape} where {frames} finite ones belong; {cure}")
    return maps[0], maps[1]


def read_state_frames(
    folder: Path, rows: Sequence[Fields], *, size: tuple[int, int], command: str
) -> tuple[StateFrame, ...]:
    """Read a trial's frames with the markers in each.

    Raises
    ------
    InputError
        If a picture or the table of markers is missing, damaged or of another size.
    """
    numbers = ("marker", "rest_x_px", "rest_y_px", "x_px", "y_px")
    # empty where the markers of no trial could be followed
    table = read_table(folder / "markers.parquet", ("frame_id", *numbers), command=command, may_be_empty=True)
    ids = _texts(table, "frame_id")
    marker, *places = (_numbers(table, name) for name in numbers)
    frames = []
    for row in rows:
        name = row.text("id")
        inside = np.flatnonzero(ids == name)
        inside = inside[np.argsort(marker[inside], kind="stable")]
        rest_x, rest_y, x, y = (place[inside] for place in places)
        frames.append(
            StateFrame(
                id=name,
                level=row.number("level"),
                safety_margin=row.number("safety_margin"),
                contact_state=row.text("contact_state").replace("_", " "),
                raw=_picture(folder, f"{name}.raw.png", size=size, command=command),
                difference=_picture(folder, f"{name}.difference.png", size=size, command=command),
                rest_px=np.stack([rest_x, rest_y], axis=1),
                position_px=np.stack([x, y], axis=1),
            )
        )
    return tuple(frames)


def _picture(folder: Path, name: str, *, size: tuple[int, int], command: str) -> UInt8[np.ndarray, "height width 3"]:
    if Path(name).name != name:
        raise InputError(f"{name!r} in {folder} is no file name; make the folder again with `{command}`")
    try:
        return read_image(folder / "frames" / name, size=size)
    except ImageError as error:
        raise InputError(str(error)) from None


def _texts(table: pa.Table, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist(), dtype=str)


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    return table[name].to_numpy().astype(np.float64)


def _groups(columns: Sequence[np.ndarray]) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """Rows of each combination of names, in the order in which they first appear."""
    codes = np.zeros(len(columns[0]), dtype=np.int64)
    for column in columns:
        known, place = np.unique(column, return_inverse=True)
        codes = codes * len(known) + place
    order = np.argsort(codes, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1)
    pieces.sort(key=lambda rows: rows[0])
    return [(tuple(str(column[rows[0]]) for column in columns), rows) for rows in pieces]
