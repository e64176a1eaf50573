import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.explainers.attribution import check_slopes
from sliplens.report import load_results
from sliplens.report.alarms import count_alarms, group_alarms
from sliplens.report.verdict import cautions, judge


def test_alarms_of_one_kind_are_one_line_with_a_count():
    alarms = ["grad-cam does not beat a random order: its symmetric gain is -0.1", "the network is asleep"]
    alarms += ["under grey: occlusion does not beat a random order: its symmetric gain is -0.2", alarms[0]]

    groups = group_alarms(alarms)

    assert [(kind, len(sentences)) for kind, sentences in groups.items()] == [
        ("Methods that do not beat a random order", 2),
        ("The network is asleep.", 1),
    ]
    assert next(iter(groups.values()))[0] == "Grad-CAM does not beat a random order: its symmetric gain is -0.1."


def test_warnings_of_explainers_are_grouped_by_kind_not_told_frame_by_frame():
    warnings = [
        *check_slopes([0.001, 0.002], change=[-0.5, -0.6]),
        *(f"f{row}: the map leaves 0.{row} of f(x) - f(reference) = -0.9 unexplained, more than 1%" for row in (1, 2)),
        *(
            f"f{row}: f(x) = 1 is within 0.02 of f(reference) = 1, so there is next to nothing to explain"
            for row in (1, 2)
        ),
        *(
            f"f{row}: contributions hardly surer than they differ in 1 of 1 frames; ask for more pairs"
            for row in (1, 2)
        ),
    ]

    groups = group_alarms(warnings)

    assert [len(sentences) for sentences in groups.values()] == [2, 2, 2, 2]


def test_alarms_are_counted_by_network(workspace):
    assert count_alarms(load_results(workspace)) == (
        "Frames in which the fill decides, rather than the map: 1 (raw images 1)",
        "Integrated Gradients, real touch: completeness gap 1.8 % on 2 frames: 1 (raw images 1)",
    )


@pytest.fixture
def verdict(workspace, rng):
    """Rows of the workspace as it is when called, by claim and network."""
    return lambda: {
        (row.claim, row.subject): row for table in judge(load_results(workspace), rng=rng) for row in table.rows
    }


def edit(path, change):
    value = json.loads(path.read_text(encoding="utf-8"))
    change(value)
    path.write_text(json.dumps(value), encoding="utf-8")


def replace(path, column, values):
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


DIFFERENCE, RAW = "Difference images", "Raw images"
TOUCH = "Predicts real touch better than a constant"


def test_accuracy_has_its_numbers(workspace, verdict):
    scores = load_results(workspace).evaluations["difference"].conditions
    for condition in ("dry", "wet"):
        row = verdict()[f"Predicts the margin on {condition} objects", DIFFERENCE]
        assert row.number == f"R² {scores[condition].r2:.2f}"
        assert f"{100 * scores[condition].mae:.1f} percentage points" in row.sentence


@pytest.mark.parametrize(("r2", "outcome"), [(-0.1, "does not hold"), (0.0, "does not hold"), (None, "undecided")])
def test_a_network_no_better_than_the_mean_label_is_called_so(workspace, verdict, r2, outcome):
    edit(workspace / "test-raw" / "result.json", lambda value: value["conditions"]["wet"].update(r2=r2))
    row = verdict()["Predicts the margin on wet objects", RAW]
    assert row.outcome == outcome
    assert ("no better than the mean label" in row.sentence) == (r2 is not None)


def test_a_smaller_error_holds_only_beyond_the_interval(workspace, verdict, rng):
    claim = "Smaller error than raw images on dry objects", DIFFERENCE
    assert verdict()[claim].outcome == "holds"
    assert "over 6 trials, one day, one network" in verdict()[claim].sentence
    # the same predictions but for noise that favours neither
    path = workspace / "test-raw" / "predictions.parquet"
    predictions = pq.read_table(workspace / "test-difference" / "predictions.parquet")["prediction"].to_numpy()
    replace(path, "prediction", predictions + rng.normal(0, 1e-4, len(predictions)))
    assert verdict()[claim].outcome == "undecided"


def test_a_method_holds_where_it_beats_a_random_order(workspace, verdict):
    methods = load_results(workspace).scores["difference", "simulated"].methods
    row = verdict()["Poly-CAM beats a random order", DIFFERENCE]
    assert row.outcome == "holds"
    assert row.number == f"{methods['poly-cam'].mean:.3f} ± {methods['poly-cam'].sd:.3f}"
    assert f"a random order has {methods['random'].mean:.3f}" in row.sentence


def test_a_method_that_loses_to_a_random_order_does_not_hold(workspace, verdict):
    folder = workspace / "score-raw"
    table = pq.read_table(folder / "table.parquet")
    method, score = np.array(table["method"].to_pylist()), table["score"].to_numpy().copy()
    score[method == "random"] = 0.1
    replace(folder / "table.parquet", "score", score)
    edit(folder / "result.json", lambda value: value["methods"]["random"].update(mean=0.1, sd=0.0))
    assert verdict()["Poly-CAM beats a random order", RAW].outcome == "does not hold"


def test_without_control_nothing_is_claimed(workspace, verdict):
    edit(workspace / "score-raw" / "result.json", lambda value: value["methods"].pop("random"))
    row = verdict()["Poly-CAM beats a random order", RAW]
    assert row.outcome == "undecided"
    assert "no random control was scored" in row.sentence


def test_real_touch_is_compared_with_a_constant(workspace, verdict):
    def constant(value):
        for frame in value["frames"]:
            frame["prediction"] = 0.9

    edit(workspace / "maps-raw-real" / "result.json", constant)
    row = verdict()[TOUCH, RAW]
    assert (row.outcome, row.number) == ("does not hold", "43 points")
    assert "the best constant is off by 30 points; 0 of 15 pairs of frames are in order" in row.sentence


@pytest.mark.parametrize(
    ("labels", "sign", "order"),
    [
        ((1.0, 0.8, 0.6, 0.4, 0.2, 0.0), 1, "15 of 15 pairs"),
        # frames with equal labels have no order
        ((1.0, 0.5, 0.5, 0.5, 0.5, 0.0), 1, "9 of 9 pairs"),
        ((1.0, 0.5, 0.5, 0.5, 0.5, 0.0), -1, "0 of 9 pairs"),
    ],
)
def test_pairs_of_real_frames_are_in_order_or_not(workspace, verdict, labels, sign, order):
    def label(value):
        for frame, margin in zip(value["frames"], labels, strict=True):
            frame.update(safety_margin=margin, prediction=sign * margin)

    edit(workspace / "maps-raw-real" / "result.json", label)
    row = verdict()[TOUCH, RAW]
    assert order in row.sentence
    assert row.outcome == ("holds" if sign > 0 else "does not hold")


def test_real_frames_without_labels_decide_nothing(workspace, verdict):
    def unlabel(value):
        for frame in value["frames"]:
            frame["safety_margin"] = None

    edit(workspace / "maps-raw-real" / "result.json", unlabel)
    assert verdict()[TOUCH, RAW].outcome == "undecided"


def test_limits_of_the_verdict_are_named(workspace):
    (fill,) = cautions(load_results(workspace))
    assert "depends on the fill of a removed pixel" in fill
    assert "grey" in fill
