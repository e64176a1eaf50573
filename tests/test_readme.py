"""The Python blocks of the README run as they stand."""

import re
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from sliplens.live import LiveReader

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run live for a twentieth of the time."""
    begin = LiveReader.__init__

    @wraps(begin)
    def begin_short(self: LiveReader, *args: Any, seconds: float, **options: Any) -> None:
        begin(self, *args, seconds=seconds / 20, **options)

    monkeypatch.setattr(LiveReader, "__init__", begin_short)


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_a_block_runs_as_pasted(block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hurry: None):
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "README.md", "exec"), {})
    assert len(block.splitlines()) <= 10
