"""Checkpoints that are written whole or not at all."""

import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from sliplens.errors import InputError


class WholeCheckpoints(TorchCheckpointIO):
    """Writes each checkpoint beside the one it replaces, so that a crash or a full disk leaves the old one.

    Lightning's own way goes through the system's temporary folder, and is whole only where that is on the same disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        if storage_options is not None:
            raise TypeError("this way of saving takes no storage_options")
        target = Path(path)
        part = target.with_name(target.name + ".part")
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as stream:
                stream.write(buffer.getbuffer())
                stream.flush()
                os.fsync(stream.fileno())  # the new name must not come before the bytes
            part.replace(target)
        except OSError as error:
            with suppress(OSError):
                part.unlink()
            raise InputError(
                f"cannot save the checkpoint {target} ({error.strerror}); make room and give the same command again, "
                "it goes on after the last whole epoch"
            ) from None
