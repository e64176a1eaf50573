"""A page of a simulated fingertip, or gripper, in a process of its own, until its standard input is closed.

NiceGUI serves one page to a process, and a browser is led by another event loop: a test that fails in between must not
take the tests after it along. Writes a line of JSON: the address, and what a second page and a taken port are answered.
"""

import faulthandler
import json
import sys

import sliplens as sl
from sliplens.app import LivePage
from sliplens.errors import InputError
from sliplens.grip.source import GripSource
from sliplens.live import LiveSource, SimulatedSource


def _refusal(reader: sl.LiveReader, port: int) -> str:
    try:
        with LivePage(reader, port=port):
            return ""
    except InputError as error:
        return str(error)


def main() -> None:
    """Serve."""
    source: LiveSource = GripSource(rate_hz=10.0)
    network = None  # the gripper's controllers say what they do without a margin, too
    if sys.argv[2] == "fingertip":
        source, network = SimulatedSource(rate_hz=10.0), "chromatouch-difference"
        source.load(normal_force_n=0.0, tangential_force_n=0.0)  # nobody presses yet
    with (
        # a busy machine drops frames, and health and markers would withhold margins for that
        sl.LiveReader(source, network, engine="torch", health=None, slip=None) as reader,
        LivePage(reader, port=0, record_into=sys.argv[1]) as page,
    ):
        port = int(page.address.rstrip("/").rpartition(":")[2])
        told = {"address": page.address, "second": _refusal(reader, 0), "taken": _refusal(reader, port)}
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()
        sys.stdin.read()


if __name__ == "__main__":
    faulthandler.enable()  # of a process that ends itself, this is all one sees
    main()
