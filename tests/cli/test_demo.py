"""The demo, small: every stage, the page, and a second run that has nothing to do."""

from html.parser import HTMLParser
from pathlib import Path

import pytest

from sliplens.cli import demo, main
from sliplens.files import read_json

SMALL = ("--dry-trials", "8", "--wet-trials", "1", "--frames-per-trial", "24", "--days", "2", "--image-size", "32")


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.images = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"
        self.links += [value or "" for name, value in attrs if name in {"src", "href", "srcset", "data"}]


@pytest.fixture
def no_real_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLIPLENS_REFERENCE", str(tmp_path / "nothing"))


def test_the_demo_runs_every_stage_and_ends_in_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], no_real_frames: None
):
    monkeypatch.setattr(demo, "_SHORTEST_TRAINING", 0.02)
    out = tmp_path / "demo"
    words = ("demo", str(out), *SMALL, "--max-minutes", "0.1")
    assert main(words) == 0
    printed = capsys.readouterr().out.replace("\n", "")
    assert "no real frames found" in printed
    assert str(out / "report.html") in printed
    stages = {read_json(path)["stage"] for path in out.glob("*/run.json")}
    assert stages == {"simulate", "train", "evaluate", "explain", "score"}
    assert set(read_json(out / "explain-raw" / "result.json")["methods"]) == {
        "grad-cam",
        "integrated-gradients",
        "poly-cam",
    }
    page = Links()
    page.feed((out / "report.html").read_text(encoding="utf-8"))
    assert page.images > 12
    assert all(link.startswith(("data:", "#")) for link in page.links)  # opens from disk, without a network

    weights = (out / "train-raw" / "model.safetensors").stat().st_mtime_ns
    assert main(words) == 0
    assert capsys.readouterr().out.count("kept") == 9  # data, and two of train, evaluate, explain and score
    assert (out / "train-raw" / "model.safetensors").stat().st_mtime_ns == weights
    assert main((*words, "--seed", "1")) == 2
    assert "holds a demo of other settings" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rate", "size", "shortest"),
    [(1000.0, 112, False), (150.0, 96, False), (0.5, 64, True)],
)
def test_a_slow_machine_gets_smaller_images_and_never_a_starved_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_real_frames: None, *, rate: float, size: int, shortest: bool
):
    # twelve frames of 4464 + 4 x 112 passes by an engine twice as fast, and of 400 without: 68.5 thousand of 2 x rate,
    # for which 420 - 60 - 2 x 84 = 192 s are left: 178 images a second for 112 px, 130 for 96 px
    monkeypatch.setattr(demo, "_measure_rates", lambda _: demo._Rates(plain=rate, engine=2 * rate))
    run = demo.Demo(output=tmp_path / "demo", max_minutes=7.0)
    run._open_workspace(None)
    chosen, minutes = run._plan_training(demo.time.perf_counter(), None)
    assert chosen == size
    assert (minutes == demo._SHORTEST_TRAINING) == shortest
    assert run._plan_training(0.0, None) == (chosen, minutes)  # decided once
