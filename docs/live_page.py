"""Take the picture of the live page: python docs/live_page.py docs/images/live.jpg; needs Chromium."""

import argparse
import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.request import urlopen

from websockets.sync.client import connect

import sliplens as sl
from sliplens.app import LivePage

SIZE = 1280, 800
PULLED_N = 0.55
"""Pull on a fingertip pressed with 1.5 N, in the end."""
SECONDS = 26.0


def open_page(address: str, profile: str) -> tuple[subprocess.Popen[bytes], str]:
    """Open an address in a headless Chromium; return its process and the address of its debugger."""
    name = shutil.which("chromium") or shutil.which("google-chrome")
    if name is None:
        raise SystemExit("there is no Chromium on this machine")
    words = [name, "--headless", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
    process = subprocess.Popen([*words, f"--window-size={SIZE[0]},{SIZE[1]}", address], stderr=subprocess.DEVNULL)
    port = Path(profile) / "DevToolsActivePort"
    while not port.is_file() or not port.read_text().strip():
        time.sleep(0.1)
    with urlopen(f"http://127.0.0.1:{port.read_text().splitlines()[0]}/json") as answer:
        return process, next(tab for tab in json.load(answer) if tab["type"] == "page")["webSocketDebuggerUrl"]


def take_picture(debugger: str) -> bytes:
    """Return what the page shows, as JPEG."""
    with connect(debugger, max_size=2**26) as socket:
        size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
        socket.send(json.dumps({"id": 1, "method": "Emulation.setDeviceMetricsOverride", "params": size}))
        time.sleep(1.0)
        asked = {"id": 2, "method": "Page.captureScreenshot", "params": {"format": "jpeg", "quality": 88}}
        socket.send(json.dumps(asked))
        while (answer := json.loads(socket.recv())).get("id") != 2:
            pass
        return base64.b64decode(answer["result"]["data"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    output: Path = parser.parse_args().output
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        sl.LiveReader("simulated", "chromatouch-pair") as reader,
        LivePage(reader, port=0) as page,
    ):
        process, debugger = open_page(page.address, profile)
        try:
            for reading in reader.readings():
                since_s = reading.time_s - 6  # the reference is taken first
                press = min(max(since_s / 2, 0), 1)
                pull = min(max((since_s - 4) / 12, 0), 1)
                reader.source.load(normal_force_n=1.5 * press, tangential_force_n=PULLED_N * pull)
                if reading.time_s > SECONDS:
                    break
            output.write_bytes(take_picture(debugger))
        finally:
            process.terminate()
