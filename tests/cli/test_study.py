"""`sliplens study`: the whole experiment on a small data set, its resumption, and what is said to mistakes."""

import json
from pathlib import Path

import pytest
from command_line import run

from sliplens.errors import InputError
from sliplens.recordings import Dataset
from sliplens.results.study import StudyConfig
from sliplens.study.run import run_study

STAGES = ("evaluate", "explain", "score", "faithfulness", "map-quality")


@pytest.fixture(scope="module")
def words(difference_run: Path, pair_run: Path, fine_dataset: Dataset) -> tuple[object, ...]:
    networks = ("--network", difference_run, pair_run)
    quick = ("--method", "grad-cam", "occlusion", "--trials", 2)
    return ("study", fine_dataset.folder, *networks, *quick)


def test_a_study_makes_every_stage_and_the_page_and_keeps_what_is_there(
    words: tuple[object, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    output = tmp_path / "study"
    assert run(*words, "-o", output, "--on", "serial") == 0
    folders = {path.name for path in output.iterdir() if path.is_dir() and not path.name.startswith(".")}
    stages = {f"{stage}-{name}" for stage in STAGES for name in ("difference", "pair")}
    assert folders >= {"choice", "states", "strip", *stages}
    assert (output / "report.html").is_file()
    for name in ("difference", "pair"):
        told = json.loads((output / f"faithfulness-{name}" / "result.json").read_text())
        assert (told["frames"], told["trials"]) == (6, 2)
        new = {f"{method}-new-weights" for method in ("grad-cam", "occlusion", "weights-1")}
        controls = {"edges", "change", "local-change", "weights-1", "centre", *new}
        assert {one["method"] for one in told["scores"] if one["control"]} == controls
        assert all((one["lead_over_controls"] is None) == one["control"] for one in told["scores"])
    # as after an interruption: one stage is missing, the others stay as they are; now in processes
    before = {path: path.stat().st_mtime_ns for path in output.glob("*/result.json")}
    gone = output / "map-quality-pair"
    kept = json.loads((gone / "result.json").read_text())
    for path in gone.iterdir():
        path.unlink()
    gone.rmdir()
    monkeypatch.setattr("sliplens.cli.commands.draw_report", lambda _: None)  # the page was drawn above
    capsys.readouterr()
    assert run(*words, "-o", output, "--on", "processes=2") == 0
    told = capsys.readouterr().out
    assert told.count("kept") == len(before) - 1
    after = {path: path.stat().st_mtime_ns for path in output.glob("*/result.json")}
    assert {path for path in after if after[path] != before[path]} == {gone / "result.json"}
    # gradients are added in float32, in an order that another process may choose otherwise (docs/scale.md)
    again = json.loads((gone / "result.json").read_text())
    methods = kept.pop("methods"), again.pop("methods")
    assert again == kept
    assert methods[0].keys() == methods[1].keys()
    for name, figures in methods[0].items():
        for key, figure in figures.items():
            assert methods[1][name][key] == (pytest.approx(figure, rel=1e-5) if isinstance(figure, float) else figure)


def test_data_of_too_few_trials_are_refused_before_a_network_is_loaded(
    fine_dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sliplens.study.run.load_networks", stop)
    with pytest.raises(InputError, match="3 test trials of condition dry, and fewer than 5 decide nothing"):
        run_study(fine_dataset, out=tmp_path / "study")
    # asked for, they are studied
    with pytest.raises(KeyboardInterrupt):
        run_study(fine_dataset, out=tmp_path / "study", config=StudyConfig(trials=3))
    assert not list(tmp_path.iterdir())
