"""Samples of a force sensor beside a stored trial, as they were recorded: labels can be made anew from them."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sliplens.errors import RecordingError
from sliplens.recordings.capture import Forces
from sliplens.recordings.parquet import DAMAGED_PARQUET, one_line

_AXES = ("x_n", "y_n", "z_n")


def forces_path(folder: Path, trial: str) -> Path:
    """File that holds the force samples of a trial of a data set."""
    return folder / "forces" / f"{trial}.parquet"


def save_forces(forces: Forces, path: Path) -> None:
    """Write samples as one Parquet file, a row a sample; whole or not at all."""
    columns = {"time_s": forces.time_s, **{name: forces.force_n[:, at] for at, name in enumerate(_AXES)}}
    table = pa.table(columns).replace_schema_metadata({"source": forces.source})
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    pq.write_table(table, part, compression="zstd")
    part.replace(path)


def load_forces(path: Path) -> Forces:
    """Read samples written by `save_forces`.

    Raises
    ------
    RecordingError
        If the file is missing or damaged, or breaks a law of `Forces`.
    """
    try:
        table = pq.read_table(path)
        source = (table.schema.metadata or {}).get(b"source", b"the force sensor").decode()
        values = [table.column(name).to_numpy().astype(np.float64) for name in ("time_s", *_AXES)]
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist; make the data set again") from None
    except (*DAMAGED_PARQUET, TypeError) as error:  # the latter of values that are missing
        raise RecordingError(
            f"{path} does not hold samples of forces ({one_line(error)}); make the data set again"
        ) from None
    return Forces(time_s=values[0], force_n=np.stack(values[1:], axis=-1), source=source)
