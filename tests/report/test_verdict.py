import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sliplens.explainers.attribution import check_slopes
from sliplens.report import load_results
from sliplens.report.verdict import Statement, count_alarms, group_alarms, judge


def test_what_carries_comes_before_what_warns(verdict):
    tones = [one.tone == "caution" for one in verdict().values()]

    assert tones == sorted(tones)
    assert list(verdict())[:2] == ["Accuracy, difference images", "Accuracy, raw images"]


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
    """The verdict of the workspace as it is when called: topic to statement."""
    return lambda: {one.topic: one for one in judge(load_results(workspace), rng=rng)}


def edit(path, change):
    value = json.loads(path.read_text(encoding="utf-8"))
    change(value)
    path.write_text(json.dumps(value), encoding="utf-8")


def replace(path, column, values):
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)


def test_accuracy_is_told_with_the_numbers(workspace, verdict):
    scores = load_results(workspace).evaluations["difference"].conditions

    text = verdict()["Accuracy, difference images"].text

    assert f"R² {scores['dry'].r2:.2f} on dry and {scores['wet'].r2:.2f} on wet objects" in text
    assert f"{100 * scores['dry'].mae:.1f} and {100 * scores['wet'].mae:.1f} percentage points" in text


def test_a_network_that_reads_nothing_is_called_so(workspace, verdict):
    edit(workspace / "test-raw" / "result.json", lambda value: value["conditions"]["wet"].update(r2=-0.1))

    found = verdict()["Accuracy, raw images"]

    assert found.tone == "caution"
    assert "On wet objects that is no better than always answering the mean label." in found.text


def test_labels_that_do_not_vary_say_nothing_of_a_network(workspace, verdict):
    edit(workspace / "test-raw" / "result.json", lambda value: value["conditions"]["wet"].update(r2=None))

    found = verdict()["Accuracy, raw images"]

    assert found.tone == "plain"
    assert "no better than" not in found.text


def test_a_clear_winner_is_named(workspace, verdict):
    found = verdict()["Raw or difference, dry"]

    assert found.tone == "good"
    assert "On dry objects difference images have the lower error" in found.text
    assert "holds beyond the 95 % interval over 6 trials, one day, one network" in found.text


def test_a_lead_that_can_be_chance_is_called_so(workspace, verdict, rng):
    # the same answers but for noise that favours neither
    path = workspace / "test-raw" / "predictions.parquet"
    answers = pq.read_table(workspace / "test-difference" / "predictions.parquet")["prediction"].to_numpy()
    replace(path, "prediction", answers + rng.normal(0, 1e-4, len(answers)))

    found = verdict()["Raw or difference, dry"]

    assert found.tone == "caution"
    assert "does not rule out chance" in found.text


def test_the_best_method_is_named_with_its_control(workspace, verdict):
    methods = load_results(workspace).scores["difference", "simulated"].methods

    found = verdict()["Faithfulness, difference images"]

    assert found.tone == "good"
    assert f"Poly-CAM has the lowest deletion score, {methods['poly-cam'].mean:.3f}" in found.text
    assert f"random order gives {methods['random'].mean:.3f}" in found.text
    assert "It beats the control, as does every other method." in found.text


def test_methods_that_lose_to_chance_are_called_so(workspace, verdict):
    folder = workspace / "score-raw"
    table = pq.read_table(folder / "table.parquet")
    method, score = np.array(table["method"].to_pylist()), table["score"].to_numpy().copy()
    score[method == "random"] = 0.1
    replace(folder / "table.parquet", "score", score)
    edit(folder / "result.json", lambda value: value["methods"]["random"].update(mean=0.1, sd=0.0))

    found = verdict()["Faithfulness, raw images"]

    assert found.tone == "caution"
    assert "does not beat the control" in found.text


def test_without_control_nothing_is_claimed(workspace, verdict):
    edit(workspace / "score-raw" / "result.json", lambda value: value["methods"].pop("random"))

    assert "no random control was scored" in verdict()["Faithfulness, raw images"].text


def test_the_score_of_the_fill_alone_is_told(verdict):
    found = verdict()["How far to trust D"]

    assert found.tone == "caution"
    assert "depends on what a removed pixel becomes" in found.text
    assert "grey" in found.text


def test_real_touch_is_held_against_a_constant_answer(workspace, verdict):
    def constant(value):
        for frame in value["frames"]:
            frame["prediction"] = 0.9

    edit(workspace / "maps-raw-real" / "result.json", constant)

    found = verdict()["Real touch, raw images"]

    assert found.tone == "caution"
    assert "off by 43 percentage points on average; the best constant answer would be off by 30." in found.text
    assert "0 of 15 pairs of frames in the right order" in found.text
    assert "do not carry over to real touch" in found.text


@pytest.mark.parametrize(
    ("labels", "sign", "told"),
    [
        ((1.0, 0.8, 0.6, 0.4, 0.2, 0.0), 1, "It puts 15 of 15 pairs of frames in the right order (all of them)."),
        # frames with equal labels have no order
        ((1.0, 0.5, 0.5, 0.5, 0.5, 0.0), 1, "9 of 9 pairs"),
        ((1.0, 0.5, 0.5, 0.5, 0.5, 0.0), -1, "0 of 9 pairs of frames in the right order (chance gives half)."),
    ],
)
def test_pairs_of_real_frames_are_in_order_or_not(workspace, verdict, labels, sign, told):
    def label(value):
        for frame, margin in zip(value["frames"], labels, strict=True):
            frame.update(safety_margin=margin, prediction=sign * margin)

    edit(workspace / "maps-raw-real" / "result.json", label)

    found = verdict()["Real touch, raw images"]

    assert told in found.text
    assert ("off by 0 percentage points" in found.text) == (sign > 0)
    assert found.tone == ("plain" if sign > 0 else "caution")


def test_real_frames_without_labels_carry_no_claim(workspace, verdict):
    def unlabel(value):
        for frame in value["frames"]:
            frame["safety_margin"] = None

    edit(workspace / "maps-raw-real" / "result.json", unlabel)

    assert "no label is known, so nothing can be said" in verdict()["Real touch, raw images"].text


def test_the_reduced_image_is_told(verdict):
    text = verdict()["What this run is"].text

    assert text.count("frames of 24 px, shrunk from 224 x 224, for") == 2
    assert "the thesis took images of 224 px" in text


def test_a_statement_begins_with_its_finding():
    parts = Statement(topic="", text="Believe it: its lead is +0.10. Found over one day.").parts
    assert parts == ("Believe it:", "its lead is +0.10. Found over one day.")
    assert Statement(topic="", text="MSE is 0.01 less. So be it.").parts == ("MSE is 0.01 less.", "So be it.")
