"""Kills processes that write, before each change of a file that they make, and has them do it again.

In a process of its own, as it forks.
"""

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from changes import count_changes

from sliplens.errors import InputError
from sliplens.files import locked, output_folder, partial_folder, remove, require_new_table, whole_file, write_json
from sliplens.recordings.dataset import TrialInfo, write_dataset_table
from sliplens.recordings.splits import split_dataset


def make(folder: Path, text: str = "x") -> None:
    with output_folder(folder / "result", stage="test", config={"text": text}, overwrite=text == "y") as out:
        if not out.complete:
            (out.folder / "pieces").mkdir(exist_ok=True)
            with whole_file(out.folder / "pieces" / "a") as part:
                part.write_text(text)
            write_json(out.folder / "result.json", {"text": text})


def prepare_split(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    names = [f"trial-{number}" for number in range(3)]
    write_dataset_table(
        folder, [TrialInfo(trial=name, split="train", frames=1, height=1, width=1, sha256="") for name in names]
    )


def make_file(folder: Path) -> None:
    """Make a file of a part, or be told that it is there."""
    out = folder / "x.csv"
    with suppress(InputError):
        require_new_table(out, suffix=".csv")
        with locked(out):
            parts = partial_folder(out)
            write_json(parts / "x.json", {"x": 1})
            with whole_file(out) as draft:
                draft.write_text("x")
            remove(parts)


Work = Callable[[Path], object]
WORKS: dict[str, tuple[Work, Work]] = {
    "make": (lambda _: None, make),
    "replace": (make, lambda folder: make(folder, "y")),
    "file": (lambda _: None, lambda folder: write_json(folder / "x.json", {"x": 1})),
    "table": (lambda _: None, make_file),
    "split": (prepare_split, lambda folder: split_dataset(folder, "trial")),
}


def run(work: Work, folder: Path, kill_before: int | None) -> int:
    """Changes that a process made, or minus the signal that ended it."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        code = 1
        try:
            changes = count_changes(folder, kill_before=kill_before)
            work(folder)
            os.write(writer, str(changes()).encode())
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    told = os.read(reader, 20)
    os.close(reader)
    if code > 0:
        raise SystemExit("the work failed")
    return code or int(told)


def files(folder: Path) -> dict[str, str]:
    """What each file holds, but when it was finished, and the folders."""
    found = {}
    for path in sorted(folder.rglob("*")):
        text = path.read_bytes().hex() if path.is_file() else "folder"
        if path.name == "run.json":
            text = json.dumps({name: one for name, one in json.loads(path.read_text()).items() if name != "finished"})
        found[str(path.relative_to(folder))] = text
    return found


def main(base: Path) -> None:
    """Kill every work before each of its changes."""
    folder = base / "work"
    tempfile.tempdir, tried = str(folder), []
    for name, (prepare, work) in WORKS.items():
        whole, number, changes = {}, 0, 1
        while number <= changes:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            prepare(folder)
            if number == 0:
                changes, whole = run(work, folder, None), files(folder)
            else:
                ended = run(work, folder, number)
                assert ended == -9, f"{name} was not killed before change {number}: {ended}"
                run(work, folder, None)
                left = {file for file in files(folder).items() if file not in whole.items()}
                assert files(folder) == whole, f"{name} killed before change {number} of {changes}: {sorted(left)}"
                tried.append((name, number))
            number += 1
    sys.stdout.write(json.dumps(tried))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
