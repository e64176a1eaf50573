"""Where a command computes."""

from sliplens.errors import InputError


def require_device(name: str) -> None:
    """Refuse a device that is not known or not there.

    Raises
    ------
    InputError
        Naming those that can be used.
    """
    import torch

    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"device {name!r} is not known; use cpu, cuda or cuda:1") from None
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device {name} is not on this machine; use cpu")
    if device.type not in {"cpu", "cuda"}:
        raise InputError(f"device {name} cannot be used; use cpu or cuda")
