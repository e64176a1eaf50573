"""Read what the stages of a study saved about its frames and its methods; each mistake is one sentence."""

from collections.abc import Callable
from typing import Any

from sliplens.errors import InputError
from sliplens.intervals import Difference
from sliplens.report.study.scored_readers import read_faithful, read_gap, read_interval, read_remedies
from sliplens.report.study.tables_on_disk import read_effects, read_state_frames, read_truth_maps
from sliplens.results.fields import Fields
from sliplens.results.records import Run
from sliplens.results.study import (
    MAP_MEASURES,
    REGIONS,
    Choice,
    ChosenFrame,
    ChosenTrial,
    Localisation,
    MapQuality,
    MetaTest,
    MethodTime,
    Randomisation,
    RandomisedMethod,
    States,
    Study,
    Timing,
    Truth,
)


def _read_choice(run: Run, fields: Fields) -> Choice:
    return Choice(
        run=run,
        trials_wanted=fields.integer("trials_wanted"),
        tolerance=fields.number("tolerance"),
        considered=fields.integer("considered"),
        qualified=fields.integer("qualified"),
        told=fields.text("told"),
        source=fields.text("source"),
        condition=fields.text("condition"),
        inputs=fields.texts("inputs"),
        trials=tuple(
            ChosenTrial(
                trial=row.text("trial"),
                qualified=row.flag("qualified"),
                worst_error={
                    name: value for name, value in row.named_numbers("worst_error").items() if value is not None
                },
            )
            for row in fields.rows("trials")
        ),
        frames=tuple(
            ChosenFrame(
                id=row.text("id"),
                trial=row.text("trial"),
                frame=row.integer("frame"),
                level=row.number("level"),
                safety_margin=row.number("safety_margin"),
                scored=row.flag("scored"),
                shown=row.flag("shown"),
            )
            for row in fields.rows("frames")
        ),
    )


def _read_states(run: Run, fields: Fields) -> States:
    size = fields.integers("frame_size")
    if len(size) != 2:
        raise InputError(
            f"{fields.where} has {len(size)} numbers as 'frame_size' where height and width belong; make the folder "
            f"again with `{fields.command}`"
        )
    rows = fields.rows("frames")
    if not rows:
        raise InputError(f"{fields.where} names no frame; make the folder again with `{fields.command}`")
    return States(
        run=run,
        trial=fields.text("trial"),
        markers_from=fields.text("markers_from"),
        untracked=fields.texts("untracked"),
        frames=read_state_frames(run.folder, rows, size=(size[0], size[1]), command=fields.command),
    )


def _read_randomisation(run: Run, fields: Fields) -> Randomisation:
    methods = {}
    for name, inner in fields.inner("methods").items():
        layers, similarity = inner.integers("layers"), inner.optional_numbers("similarity")
        if len(layers) != len(similarity):
            raise InputError(
                f"{inner.where} has {len(layers)} layers but {len(similarity)} similarities; make the folder again "
                f"with `{fields.command}`"
            )
        methods[name] = RandomisedMethod(
            layers=layers,
            similarity=similarity,
            complexity_rise=inner.optional_number("complexity_rise"),
            smooth_complexity_rise=inner.optional_number("smooth_complexity_rise"),
        )
    return Randomisation(
        run=run, **_origin(fields), frames=fields.integer("frames"), methods=methods, alarms=fields.texts("alarms")
    )


def _read_looks(run: Run, fields: Fields) -> MapQuality:
    return MapQuality(
        run=run,
        **_origin(fields),
        frames=fields.integer("frames"),
        methods={
            name: {measure: inner.optional_number(measure) for measure in MAP_MEASURES}
            for name, inner in fields.inner("methods").items()
        },
        # studies made before these were kept have none
        rougher={
            (row.text("first"), row.text("second")): read_gap(row)
            for row in (fields.rows("comparisons") if "comparisons" in fields.values else [])
            if row.text("measure") == "total_variation"
        },
    )


def _read_timing(run: Run, fields: Fields) -> Timing:
    return Timing(
        run=run,
        **_origin(fields),
        device=fields.text("device"),
        threads=fields.optional_integer("threads"),
        repeats=fields.integer("repeats"),
        forward_seconds=fields.optional_number("forward_seconds"),
        methods={
            name: MethodTime(
                seconds=inner.number("seconds"),
                seconds_without_forward=inner.optional_number("seconds_without_forward"),
                low=inner.optional_number("low"),
                high=inner.optional_number("high"),
            )
            for name, inner in fields.inner("methods").items()
        },
    )


def _read_truth(run: Run, fields: Fields) -> Truth:
    intervals = fields.inner("intervals", optional=True)
    effects = read_effects(run.folder / "effects.parquet", command=fields.command)
    ids = tuple(dict.fromkeys(effects.frame_id.tolist()))
    network, margin = read_truth_maps(run.folder / "maps.npz", frames=len(ids), command=fields.command)
    return Truth(
        run=run,
        **_origin(fields),
        frames=fields.integer("frames"),
        areas=_regions(fields, "areas"),
        methods={
            name: _read_localisation(inner, intervals.get(name)) for name, inner in fields.inner("methods").items()
        },
        network_against_margin=read_interval(fields, "network_against_margin"),
        meta=tuple(
            MetaTest(
                fill=row.text("fill"),
                holds=row.flag("holds"),
                oracle=row.number("oracle"),
                degraded=row.number("degraded"),
                random=row.number("random"),
            )
            for row in fields.rows("meta")
        ),
        told=fields.text("told", default=""),
        effects=effects,
        frame_ids=ids,
        network_maps=network,
        margin_maps=margin,
    )


def _read_localisation(inner: Fields, intervals: Fields | None) -> Localisation:
    found: dict[str, Difference | None] = {
        name: None if intervals is None else read_interval(intervals, name)
        for name in ("spearman_network", "spearman_margin", "edges_over_chance")
    }
    return Localisation(
        mass=_regions(inner, "mass"),
        rank=_regions(inner, "rank"),
        spearman_network=inner.optional_number("spearman_network"),
        spearman_margin=inner.optional_number("spearman_margin"),
        network=found["spearman_network"],
        margin=found["spearman_margin"],
        edges=found["edges_over_chance"],
    )


def _regions(fields: Fields, key: str) -> dict[str, float | None]:
    given = fields.named_numbers(key)
    return {name: given.get(name) for name in REGIONS}


def _origin(fields: Fields) -> dict[str, Any]:
    return {"input": fields.text("input"), "source": fields.text("source")}


STUDY_READERS: dict[str, Callable[[Run, Fields], Any]] = {
    "choice": _read_choice,
    "states": _read_states,
    "remedies": read_remedies,
    "faithfulness": read_faithful,
    "randomisation": _read_randomisation,
    "map-quality": _read_looks,
    "timing": _read_timing,
    "truth": _read_truth,
}
"""By stage."""


def gather_study(found: dict[tuple[str, str, str], Any]) -> Study:
    """Collect a study's results.

    Parameters
    ----------
    found
        Results by stage, input and source.
    """
    by_input = {
        stage.replace("-", "_"): {key[1]: value for key, value in found.items() if key[0] == stage}
        for stage in ("remedies", "faithfulness", "randomisation", "map-quality", "timing", "truth")
    }
    single = {key[0]: value for key, value in found.items() if key[0] in {"choice", "states"}}
    return Study(choice=single.get("choice"), states=single.get("states"), **by_input)
