"""What the command line shows."""

from pathlib import Path

import pytest
from rich.console import Console

from sliplens.cli import console
from sliplens.cli.console import Terminal, print_table
from sliplens.progress import Stages, open_stage, report_progress, reporting

METHODS = ["Grad-CAM", "Integrated Gradients", "Poly-CAM (thesis)"]
HEAD = ["Method", "Score D (lower is better)", "Standard deviation", "SRG, grey fill", "SRG, blurred fill", "Seconds"]


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Console:
    narrow = Console(width=80, record=True)
    monkeypatch.setattr(console, "OUT", narrow)
    monkeypatch.setattr(console, "ERR", narrow)
    return narrow


@pytest.mark.parametrize("width", [60, 70, 80, 90, 100, 110, 140])
def test_a_table_fits_the_terminal_with_every_word_whole(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(width=width, record=True)
    monkeypatch.setattr(console, "OUT", screen)
    for count, cell in ((5, "0.123 (0.045 to 0.{}78)"), (3, "2133 ms {}/21")):
        rows = [
            dict(zip(HEAD, [name, *(cell.format(index) for index in range(count))], strict=False)) for name in METHODS
        ]
        print_table("Scores of explanations", rows)
        text = screen.export_text()
        assert max(map(len, text.splitlines())) <= width
        for row in rows:
            assert all(text.count(cell) == 3 for cell in list(row.values())[1:]), "a number is broken or missing"
        assert all(word in text for word in " ".join((*METHODS, *rows[0])).split())


def test_numbers_stand_to_the_right_and_words_to_the_left(screen: Console) -> None:
    rows = [
        {"Method": "a", "D": "0.5", "meaning": "as it fell", "x": None},
        {"Method": "b", "D": None, "meaning": "", "x": None},
    ]
    print_table("Scores", rows)

    text = screen.export_text()
    assert "│ 0.5 │ as it fell │\n" in text
    assert "│   - │            │\n" in text


HOSTILE = "cup[/][red]\x1b[2J\x1b]0;owned\x07\r\n\u202egnp.tac\udc80"


def test_names_of_files_move_no_cursor_and_paint_nothing(screen: Console) -> None:
    terminal = Terminal()
    with terminal.stage(f"Reading {HOSTILE}"):
        terminal.note(f"note {HOSTILE}")
    console.say(HOSTILE)
    console.say(HOSTILE, aside=True)
    console.fail(HOSTILE)
    console.print_file(Path(HOSTILE), HOSTILE)
    print_table(HOSTILE, [{HOSTILE: HOSTILE, "D": 1}])

    text = screen.export_text(styles=False)
    told = r"cup[/][red]\x1b[2J\x1b]0;owned\x07\r\n\u202egnp.tac\udc80"
    assert text.replace("│", "").replace("┃", "").replace("\n", "").replace(" ", "").count(told) >= 8
    assert all(one.isprintable() or one == "\n" for one in text)


def test_terminal_shows_stages(screen: Console) -> None:
    terminal = Terminal()
    assert isinstance(terminal, Stages)

    with reporting(terminal), open_stage("Explain"):
        report_progress(2, 2)
        with terminal.stage("Score") as inner:
            inner(1, 5)
            terminal(3, 5)
    terminal.wrote(Path("runs/explain"), "2 frames")

    text = screen.export_text()
    assert "Explain" in text
    assert "2/2" in text
    assert "wrote runs/explain" in text


def test_notes_of_a_stage_are_shown_once_with_a_count(screen: Console) -> None:
    terminal = Terminal()

    with terminal.stage("Explain"):
        for _ in range(3):
            terminal.note("the map is flat")
        terminal.note("one marker is lost")
        terminal.note("the map is flat")

    text = screen.export_text()
    assert "the map is flat (4 times)" in text
    assert text.count("flat") == 1
    assert "one marker is lost\n" in text


def test_a_stage_that_fails_closes_its_bar(screen: Console) -> None:
    terminal = Terminal()

    with pytest.raises(ValueError, match="no"), terminal.stage("Explain"):
        raise ValueError("no")
    with terminal.stage("Score") as count:
        count(1, 1)

    assert "1/1" in screen.export_text()
