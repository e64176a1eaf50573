"""Each part of an installation is tried once; what fails is told and stops nothing."""

import numpy as np
import pytest
from command_line import run

from sliplens import doctor
from sliplens.doctor import Item, examine_installation
from sliplens.errors import InputError


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """No engine, network or extra, which take seconds."""
    monkeypatch.setattr(doctor, "ENGINES", {})
    monkeypatch.setattr(doctor, "shipped_names", list)
    monkeypatch.setattr(doctor, "_extras", lambda: {"onnx": ["no-such-package"], "view": ["numpy"]})


def test_what_is_there_works_and_what_is_not_is_told_with_its_cure(few: None):
    counted = []
    items = examine_installation(on_progress=lambda done, total: counted.append((done, total)))
    found = {item.name: item for item in items}
    assert found["versions"].works
    assert found["extra view"] == Item(name="extra view", works=True, detail=f"numpy {np.__version__}")
    assert found["extra onnx"].works is None
    assert 'pip install "sliplens[onnx]"' in found["extra onnx"].detail
    assert counted[-1] == (len(items), len(items))


def test_what_fails_is_told_and_stops_nothing(few: None, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "versions", lambda: 1 / 0)
    assert run("doctor") == 2
    said = capsys.readouterr()
    assert "ZeroDivisionError: division by zero" in said.out
    assert "versions does not work" in said.err


@pytest.mark.parametrize("name", ["torch", "openvino"])
def test_an_engine_agrees_with_the_network(name: str):
    assert doctor._engine(name).startswith("agrees with the network")


def test_a_network_that_predicts_no_number_fails(monkeypatch: pytest.MonkeyPatch):
    assert "shufflenet" in doctor._network("chromatouch-difference")
    monkeypatch.setattr(doctor.Network, "predict", lambda _, inputs: inputs.sum(dim=(1, 2, 3)) * float("nan"))
    with pytest.raises(InputError, match="predicts no number"):
        doctor._network("chromatouch-difference")


def test_extras_are_those_of_users():
    extras = doctor._extras()
    assert "rosbags" in extras["ros"]
    assert not set(extras) & {"dev", "docs"}
