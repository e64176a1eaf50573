"""The page on which labels are repaired, and what it shows."""

import json
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from data_sets import save_dataset
from hostile_names import ATTACK, assert_inert, watch

from sliplens.app import LabelPage
from sliplens.codec import to_builtins
from sliplens.errors import InputError, RecordingError
from sliplens.images import decode_png
from sliplens.recordings import Dataset, Recording
from sliplens.recordings.edits import EDITS_FILE, make_edit, read_edits
from sliplens.recordings.formats.stored import read_stored_trial
from sliplens.recordings.importing import relabel_trial
from sliplens.simulation import PRESETS, plan_trials, simulate_trial

pytest.importorskip("nicegui", reason="the page needs NiceGUI (extra live)")
SUMMARY = "document.querySelector('.sl-summary').textContent"
EDITS = "document.querySelectorAll('.sl-edits li').length"


@pytest.fixture(scope="module")
def trial() -> Recording:
    return simulate_trial(plan_trials(PRESETS["small"])[0])


@pytest.fixture(scope="module")
def data(trial: Recording, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return save_dataset(tmp_path_factory.mktemp("to-repair"), trial, simulated=True)


@pytest.fixture(scope="module")
def address(data: Dataset) -> Iterator[str]:
    command = [sys.executable, str(Path(__file__).with_name("served_labels.py")), str(data.folder), ATTACK]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["address"]
            assert process.stdin is not None
            process.stdin.close()
            assert process.wait(timeout=60) == 0
        finally:
            process.kill()


def test_edits_are_made_by_key_seen_in_the_margin_and_taken_back(browser, address: str, data: Dataset):
    context = browser.new_context(viewport={"width": 320, "height": 640})
    context.set_default_timeout(30_000)
    window, said = context.new_page(), []
    watch(window)
    window.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    window.on("pageerror", lambda error: said.append(str(error)))
    window.goto(address)
    window.wait_for_function(f"{SUMMARY}.includes('friction')")
    before = window.evaluate(SUMMARY)
    window.locator("body").click(position={"x": 2, "y": 2})
    for keys in ("Shift+ArrowRight", "Shift+ArrowRight", "[", "Shift+ArrowRight", "]", "b"):
        window.keyboard.press(keys)
    window.wait_for_function(f"{EDITS} === 1 && {SUMMARY} !== {json.dumps(before)}")
    assert "marked by hand" in window.locator(".sl-readout").text_content()
    window.get_by_label("friction").fill("0.9")
    window.keyboard.press("Enter")
    window.wait_for_function(f"{SUMMARY}.includes('friction 0.900')")
    (bad, friction) = read_edits(data.folder)
    assert (bad.kind, bad.value, bad.by) == ("bad", (20, 30), ATTACK)
    assert (friction.kind, friction.value) == ("mu", 0.9)
    window.reload()  # a restart forgets nothing
    window.wait_for_function(f"{EDITS} === 2 && {SUMMARY}.includes('friction 0.900')")
    assert not said
    assert_inert(window)  # which the browser complains of
    said.clear()
    for left in (1, 0):
        window.get_by_role("button", name="Undo").click()
        window.wait_for_function(f"{EDITS} === {left} && !{SUMMARY}.includes('labelling')")
    assert window.evaluate(SUMMARY) == before
    assert window.evaluate("document.documentElement.scrollWidth") <= 320
    assert not said
    context.close()


def test_frames_are_served_to_this_machine_alone(address: str, data: Dataset, trial: Recording):
    with urllib.request.urlopen(f"{address}images/{trial.trial}/5", timeout=60) as answer:
        np.testing.assert_array_equal(decode_png(answer.read(), where="the answer"), trial.frames[5])
    for path in (f"images/{trial.trial}/{data.trials[0].frames}", "images/..%2F..%2Fdataset.json/0"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(address + path, timeout=60)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(address, headers={"Host": "evil.example"}), timeout=60)


def test_what_is_shown_is_what_label_will_write(data: Dataset, trial: Recording):
    page = LabelPage(data, by="bo")
    page.edit(trial.trial, "slip_s", float(trial.time_s[30]))
    page.edit(trial.trial, "contact_s", float(trial.time_s[5]))
    view, labels = page.look(trial.trial), relabel_trial(data, trial.trial)
    shown = np.array([np.nan if margin is None else margin for margin in view.margin])
    np.testing.assert_allclose(shown, labels.safety_margin, atol=1e-5)
    # valid up to the slip at most: the ratio rises on after it, which contradicts it
    assert np.flatnonzero(np.diff(np.array(view.valid, dtype=int)) == -1).max() <= 29
    assert any("after the slip at" in flag for flag in view.flags)
    assert (view.contact_s, view.slip_s) == (trial.time_s[5], trial.time_s[30])
    assert [edit.by for edit in view.edits] == ["bo", "bo"]
    assert page.edit_counts == {trial.trial: 2}
    # a trial that cannot be labelled so is shown as it is on disk, with the reason, and can be repaired
    early = make_edit(trial.trial, "slip_s", float(trial.time_s[2]), by="bo")
    with pytest.raises(RecordingError, match="set the contact first"):
        page.edit(early.trial, early.kind, early.value)
    with (data.folder / EDITS_FILE).open("a") as file:
        file.write(json.dumps(to_builtins(early)) + "\n")
    assert "set the contact first" in page.look(trial.trial).trouble
    page.edit(trial.trial, "undo")
    assert not page.look(trial.trial).trouble


def test_a_damaged_file_of_edits_is_told_before_a_browser_is_opened(tmp_path: Path, data: Dataset):
    (tmp_path / EDITS_FILE).write_text("{\n")
    with pytest.raises(InputError, match="line 1 of"):
        LabelPage(Dataset(folder=tmp_path, trials=data.trials))


def test_the_tare_of_a_span_is_the_mean_of_its_samples(data: Dataset, trial: Recording):
    page, forces = LabelPage(data, by="bo"), read_stored_trial(data, data.find(trial.trial)).forces
    assert forces is not None
    begin_s, end_s = float(forces.time_s[3]), float(forces.time_s[17])
    page.edit(trial.trial, "tare_span", (begin_s, end_s))
    (tare,) = (edit for edit in page.look(trial.trial).edits if edit.kind == "tare")
    assert tare.value == pytest.approx(tuple(forces.force_n[3:18].mean(axis=0)))
    with pytest.raises(RecordingError, match="no force sample from"):
        page.edit(trial.trial, "tare_span", (end_s + 1000, end_s + 1001))
    page.edit(trial.trial, "undo")
