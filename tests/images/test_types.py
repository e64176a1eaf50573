"""Frames and references of any type but 8-bit RGB: refused with a cure by whatever takes frames, never compared.

In a process of its own, as users run it: under pytest jaxtyping checks every type before the code can.
"""

import json
import subprocess
import sys

import pytest

SCRIPT = """
import json
from dataclasses import replace
import numpy as np
import sliplens as sl
from sliplens.errors import SliplensError
from sliplens.images import absolute_difference, signed_difference
from sliplens.markers.detect import detect_markers
from sliplens.markers.tracker import track_markers
from sliplens.recordings.source import open_source

rng = np.random.default_rng(0)
rows, columns = np.mgrid[:224, :224]
dots = (rows % 28 - 14) ** 2 + (columns % 28 - 14) ** 2 < 36
reference = np.where(dots[..., None], 60, 160) + rng.integers(0, 4, (224, 224, 3))
reference = reference.astype(np.uint8)
frames = np.stack([reference, reference])
run = sl.load("chromatouch-difference")
maps = rng.normal(size=(2, 224, 224))


def predict_capture(frames, reference):
    (capture,) = open_source(np.zeros((2, 224, 224, 3), np.uint8))
    return sl.predict(run, [replace(capture, read_frames=lambda: iter(frames), reference=reference)])


def read_live(frames, reference):
    with sl.LiveReader(frames, run, reference=reference, engine="torch") as reader:
        return list(reader.readings())


CALLS = {
    "predict": lambda frames, reference: sl.predict(run, frames, reference=reference),
    "predict captures": predict_capture,
    "explain": lambda frames, reference: sl.explain(run, frames, reference=reference, method="grad-cam"),
    "score": lambda frames, reference: sl.score(run, frames, maps, reference=reference),
    "encode": run.encode,
    "track": lambda frames, reference: sl.track(frames, reference=reference),
    "live": read_live,
    "track_markers": track_markers,
    "detect_markers": lambda frames, reference: [detect_markers(image) for image in (*frames, reference)],
    "absolute_difference": absolute_difference,
    "signed_difference": signed_difference,
}
KINDS = {
    "floats up to 1": lambda levels: levels / np.float32(255),
    "floats up to 255": lambda levels: levels.astype(np.float64),
    "half floats": lambda levels: levels.astype(np.float16),
    "16 bits": lambda levels: levels.astype(np.uint16) * 257,
    "12 bits in 16": lambda levels: levels.astype(np.uint16) * 16,
    "whole numbers": lambda levels: levels.astype(np.int64),
    "black and white": lambda levels: levels > 100,
    "one colour": lambda levels: levels[..., :1],
    "no colour axis": lambda levels: levels[..., 0],
}


def outcome(call, frames, reference):
    try:
        call(frames, reference)
    except SliplensError as error:
        return f"refused: {error}"
    except Exception as error:
        return f"crashed: {error!r}"
    return "accepted"


# scores take minutes
found = {f"{call}, 8-bit RGB": outcome(CALLS[call], frames, reference) for call in CALLS if call != "score"}
for kind, convert in KINDS.items():
    cases = {
        "frames": (convert(frames), reference),
        "reference": (frames, convert(reference)),
        "both": (convert(frames), convert(reference)),
    }
    for call in CALLS:
        for case, images in cases.items():
            found[f"{call}, {kind} as {case}"] = outcome(CALLS[call], *images)
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def outcomes() -> dict[str, str]:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_only_8_bit_rgb_is_accepted(outcomes: dict[str, str]):
    accepted = {case for case, told in outcomes.items() if told == "accepted"}
    assert accepted == {case for case in outcomes if case.endswith("8-bit RGB")}
    assert {case: told for case, told in outcomes.items() if told.startswith("crashed")} == {}
    assert len(outcomes) > 200


@pytest.mark.parametrize(
    ("kind", "cure"),
    [
        ("floats", "multiply them by 255 if they are in [0, 1], round them"),
        ("bits", "divide its levels by 256, or by 16 or 4"),
        ("whole numbers", "convert them with .astype(np.uint8)"),
        ("colour", "with the colours on the last axis"),
    ],
)
def test_the_refusal_names_the_cure(outcomes: dict[str, str], kind: str, cure: str):
    told = [words for case, words in outcomes.items() if kind in case]
    assert told
    assert [words for words in told if cure not in words] == []
