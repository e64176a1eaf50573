"""Read what a study saved about removal: the thesis's remedies, and the sound curves."""

from typing import Any

from sliplens.errors import InputError
from sliplens.intervals import Difference
from sliplens.report.study.tables_on_disk import read_removal_curves, read_variant_curves
from sliplens.results.faithfulness import (
    Agreement,
    Comparison,
    MethodScore,
    Remedies,
    RemovalScore,
    RemovalScores,
    Variant,
)
from sliplens.results.fields import Fields
from sliplens.results.records import Run


def read_interval(fields: Fields, key: str) -> Difference | None:
    """Read an estimate with its 95 % interval; None where the field, or its estimate, is null or absent."""
    part = fields.optional_part(key)
    if part is None or part.optional_number("estimate") is None:
        return None
    return read_gap(part)


def read_remedies(run: Run, fields: Fields) -> Remedies:
    """Read the variants of the thesis's score, with the curve of each frame."""
    return Remedies(
        run=run,
        input=fields.text("input"),
        source=fields.text("source"),
        variants={name: _read_variant(inner) for name, inner in fields.inner("variants").items()},
        alarms=fields.texts("alarms"),
        curves=read_variant_curves(run.folder / "deletion.parquet", command=fields.command),
    )


def read_faithful(run: Run, fields: Fields) -> RemovalScores:
    """Read the sound scores, their comparisons, and the curve of each method."""
    scores = tuple(_read_score(row) for row in fields.rows("scores"))
    curves = read_removal_curves(run.folder / "curves.parquet", command=fields.command)
    absent = [" / ".join(score.key) for score in scores if score.key not in curves]
    if absent:
        raise InputError(
            f"{run.folder / 'curves.parquet'} lacks the curves of {absent[0]}; make it again with `{fields.command}`"
        )
    return RemovalScores(
        run=run,
        input=fields.text("input"),
        source=fields.text("source"),
        frames=fields.integer("frames"),
        trials=fields.integer("trials"),
        random_orders=fields.integer("random_orders"),
        scores=scores,
        comparisons=tuple(
            Comparison(
                fill=row.text("fill"),
                unit=row.text("unit"),
                first=row.text("first"),
                second=row.text("second"),
                gap=read_gap(row),
            )
            for row in fields.rows("comparisons")
            if row.text("measure", default="srg") == "srg"
        ),
        agreement=tuple(
            Agreement(
                unit=row.text("unit"),
                first=row.text("first"),
                second=row.text("second"),
                tau=row.optional_number("tau"),
            )
            for row in fields.rows("agreement")
        ),
        alarms=fields.texts("alarms"),
        curves=curves,
    )


def _read_score(row: Fields) -> RemovalScore:
    return RemovalScore(
        fill=row.text("fill"),
        unit=row.text("unit"),
        method=row.text("method"),
        control=row.flag("control"),
        srg=read_gap(row.part("srg")),
        gain_over_random=read_gap(row.part("gain_over_random")),
        most_first=row.number("most_first"),
        least_first=row.number("least_first"),
        random=row.number("random"),
        at=_areas(row),
    )


def _areas(row: Fields) -> dict[float, float]:
    try:
        return {float(area): value for area, value in row.named_numbers("at").items() if value is not None}
    except ValueError:
        raise InputError(
            f"{row.where} names an area under 'at' that is no number; make the folder again with `{row.command}`"
        ) from None


def read_gap(part: Fields) -> Difference:
    """Read an estimate with its 95 % interval, which must be there."""
    return Difference(
        estimate=part.number("estimate"), low=part.number("low"), high=part.number("high"), units=part.integer("units")
    )


def _read_variant(inner: Fields) -> Variant:
    return Variant(
        told=inner.text("told"),
        fill=inner.text("fill"),
        mode=_one_of(inner, "mode", ("deletion", "insertion")),
        stop=inner.optional_number("stop"),
        better=_one_of(inner, "better", ("lower", "higher")),
        methods={
            name: MethodScore(
                mean=method.number("mean"),
                sd=method.number("sd"),
                last_step_mean=method.optional_number("last_step_mean"),
                frames=method.integer("frames"),
            )
            for name, method in inner.inner("methods").items()
        },
    )


def _one_of(fields: Fields, key: str, known: tuple[str, ...]) -> Any:
    value = fields.text(key)
    if value not in known:
        raise InputError(
            f"{fields.where} has {value!r} as {key!r} where {' or '.join(known)} belongs; make the folder again with "
            f"`{fields.command}`"
        )
    return value
