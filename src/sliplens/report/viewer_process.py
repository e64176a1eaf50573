"""Rerun, its viewer and its files: there or not, and started on this machine only."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

from sliplens.errors import InputError

_LOOPBACK = "127.0.0.1"
_PATIENCE_S = 30.0  # a graphics driver may take its time
_GRACE_S = 1.0


def require_rrd_path(path: Path) -> None:
    """Check that a file is named as one of the Rerun viewer.

    Raises
    ------
    InputError
        If its suffix is another one.
    """
    if path.suffix.lower() != ".rrd":
        raise InputError(f"{path} does not end in .rrd; name a file of the Rerun viewer, such as trial.rrd")


def require_rerun() -> ModuleType:
    """Import Rerun, which only the viewer needs.

    Raises
    ------
    InputError
        If it is not installed, or too old to show states over time.
    """
    cure = 'install it with pip install "sliplens[view]"'
    try:
        import rerun  # noqa: PLC0415 (an extra, and large)
    except ImportError:
        raise InputError(f"the Rerun viewer is not installed; {cure}") from None
    if not hasattr(rerun, "StateChange"):
        raise InputError(f"the Rerun viewer is too old ({rerun.__version__}); {cure.replace('install', 'upgrade', 1)}")
    return rerun


def start_viewer() -> str:
    """Start a viewer that outlives this process; give the address to which data are sent.

    Raises
    ------
    InputError
        If it does not start, as where there is no screen.
    """
    with socket.socket() as one:
        one.bind((_LOOPBACK, 0))
        port = one.getsockname()[1]
    # rerun.spawn would have the viewer listen on every network of the machine, and seeks it on the PATH only
    command = [sys.executable, "-m", "rerun_cli", "--bind", _LOOPBACK, "--port", str(port), "--expect-data-soon"]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True)
        give_up = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up and process.poll() is None:
            if _listens(port) and _stays(process):
                return f"rerun+http://{_LOOPBACK}:{port}/proxy"
            time.sleep(0.05)
        if process.poll() is None:
            _end(process)
        said.seek(0)
        words = said.read().decode(errors="replace").strip().splitlines()
    why = words[-1].strip() if words else "it said nothing"
    raise InputError(f"the Rerun viewer did not start ({why}); write a file with --output and open it elsewhere")


def _stays(process: subprocess.Popen[bytes]) -> bool:
    """Tell whether a viewer that listens also finds a screen: it looks for one only then."""
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        return True
    return False


def _end(process: subprocess.Popen[bytes]) -> None:
    if hasattr(os, "killpg"):  # the viewer is a child of the process that was started
        os.killpg(process.pid, signal.SIGTERM)
    process.kill()
    process.wait()


def _listens(port: int) -> bool:
    try:
        socket.create_connection((_LOOPBACK, port), timeout=0.2).close()
    except OSError:
        return False
    return True
