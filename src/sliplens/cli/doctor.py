"""`sliplens doctor`."""

from dataclasses import dataclass
from pathlib import Path

from sliplens.cli.console import Terminal, say
from sliplens.errors import InputError
from sliplens.progress import stage

_WORDS = {True: "works", False: "fails", None: "not there"}


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Try each part of this installation: versions, data store, networks, engines, extras, cameras, reference data.

    One line an item; exit code 2 where something that is installed does not work.
    """

    reference: Path | None = None
    """Folder of the real recordings; that of the environment variable SLIPLENS_REFERENCE if not given."""

    def run(self) -> None:
        """Try, and tell."""
        from sliplens.doctor import examine_installation

        with stage(Terminal(), "Trying what is installed") as count:
            items = examine_installation(reference=self.reference, on_progress=count)
        width = max(len(item.name) for item in items)
        for item in items:
            say(f"{_WORDS[item.works]:9}  {item.name:{width}}  {item.detail}")
        if failed := [item.name for item in items if item.works is False]:
            raise InputError(
                f"{', '.join(failed)} {'does' if len(failed) == 1 else 'do'} not work; see the lines above"
            )
