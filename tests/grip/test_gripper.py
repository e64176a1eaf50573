"""A gripper that misbehaves: nothing passes the ceiling, what falls silent is held, and nothing opens by itself."""

import math
import os
import threading
import time
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_gripper import FakeGripper
from zenoh_router import open_router

from sliplens.errors import InputError
from sliplens.grip.gripper import ROS_MESSAGES, DryRun, GripperError, GuardedGripper, LineGripper, open_gripper

SOON_S = 0.03


@pytest.fixture
def fake():
    gripper = FakeGripper()
    yield gripper
    gripper.close()


@pytest.fixture
def clock(monkeypatch):
    """Time of the guard, which goes on only when a test says so."""
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr("sliplens.grip.gripper.time", SimpleNamespace(monotonic=lambda: clock.now_s))
    return clock


def wait_until(true) -> None:
    end = time.monotonic() + 5
    while not true() and time.monotonic() < end:
        time.sleep(0.005)
    assert true()


def test_a_force_and_a_question_are_lines(fake):
    gripper = open_gripper(fake.address, timeout_s=2.0)
    gripper.set_force(1.25)
    state = gripper.read_state()
    gripper.close()
    assert fake.heard == ["F 1.250", "S"]
    assert (state.force_n, state.width_m) == (1.0, 0.04)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (b"ERR too hot\n", "refused 'F 1.000': too hot"),
        (b"OK nan 0.04\n", "not `OK force_n width_m`"),
        (b"OK 1.0\n", "not `OK force_n width_m`"),
        (b"hello\n", "did not answer 'F 1.000' in time, it sent 'hello'"),
        (b"\xff\xfe\n", "did not answer 'F 1.000' in time, it sent"),
        (b"x" * 500 + b"\n", "did not answer"),
        (None, "cannot be reached|did not answer"),
    ],
)
def test_a_wrong_answer_is_told_in_a_sentence(fake, answer, told):
    fake.answer = answer
    gripper = open_gripper(fake.address, timeout_s=0.1 if not answer or b"OK" not in answer else 10.0)
    with pytest.raises(GripperError, match=told):
        gripper.set_force(1.0)
    gripper.close()


def test_a_late_answer_never_counts_as_that_of_another_line(fake):
    """A gripper falls behind by some lines: each answer tells the force of its own line, or none is taken."""
    late = threading.Event()
    gripper = open_gripper(fake.address, timeout_s=0.05)
    assert isinstance(gripper, LineGripper)

    def answer(line: str) -> bytes:
        if line == "F 1.000":
            late.wait(5)  # the first answer comes after the second line was sent
        return f"OK {line[2:]} 0.0400\n".encode()

    fake.answer = answer
    for force_n in (1.0, 2.0):
        with pytest.raises(GripperError, match="did not answer"):
            gripper.set_force(force_n)
    late.set()
    gripper.timeout_s = 2.0
    for force_n in (3.0, 4.0):
        assert gripper.ask(f"F {force_n:.3f}").force_n == force_n
    gripper.close()


def test_a_serial_gripper_is_left_alone_after_an_answer_that_did_not_come(clock):
    gripper_end, ours = os.openpty()
    gripper = open_gripper(os.ttyname(ours), timeout_s=10.0)
    assert isinstance(gripper, LineGripper)
    os.write(gripper_end, b"a line before\n")
    answering = threading.Thread(target=lambda: os.write(gripper_end, os.read(gripper_end, 9) + b"OK 1.500 0.0400\n"))
    answering.start()
    assert gripper.read_state().width_m == 0.04
    answering.join()
    gripper.timeout_s = 0.0
    with pytest.raises(GripperError, match="did not answer"):
        gripper.read_state()
    heard = os.read(gripper_end, 100)
    for clock.now_s in (0.5, 1.9):
        with pytest.raises(GripperError, match="left alone"):
            gripper.read_state()
    assert heard.strip() == b"S"
    gripper.close()
    os.close(gripper_end)
    os.close(ours)


def test_a_connection_that_breaks_is_opened_again_with_the_next_line(fake):
    gripper = open_gripper(fake.address, timeout_s=2.0)
    gripper.set_force(1.0)
    fake.hang_up()
    with pytest.raises(GripperError, match="cannot be reached"):
        gripper.set_force(1.5)
    gripper.set_force(2.0)
    assert (fake.heard[0], fake.heard[-1]) == ("F 1.000", "F 2.000")
    fake.close()
    fake.hang_up()
    for told in ("cannot be reached", "no gripper answers"):
        with pytest.raises(GripperError, match=told):
            gripper.set_force(2.5)
    gripper.close()


@pytest.mark.parametrize("force_n", [4.0001, 1e9, math.inf, math.nan])
def test_no_force_passes_the_ceiling_and_one_that_is_no_number_holds(force_n):
    dry = DryRun()
    with GuardedGripper(dry, ceiling_n=4.0) as gripper:
        gripper.set_force(2.0)
        gripper.set_force(force_n)
    assert dry.sent == [2.0, 2.0 if math.isnan(force_n) else 4.0]


def test_a_reader_that_stops_makes_the_gripper_hold_and_not_open(clock):
    dry = DryRun()
    with GuardedGripper(dry, watchdog_s=SOON_S) as gripper:
        gripper.set_force(2.0)
        assert not gripper.holding
        clock.now_s += 2 * SOON_S
        wait_until(lambda: len(dry.sent) > 1)
        assert gripper.holding
        assert set(dry.sent) == {2.0}
        gripper.set_force(1.0)
        assert not gripper.holding
    assert set(dry.sent) == {2.0, 1.0}


def test_whatever_a_driver_raises_the_watchdog_lives_and_holds(monkeypatch):
    driver = DryRun()
    with GuardedGripper(driver, watchdog_s=SOON_S) as gripper:
        with monkeypatch.context() as broken:
            broken.setattr(driver, "set_force", lambda force_n: {}[force_n])
            gripper.set_force(1.5)
            assert gripper.failure == "1.5"  # words of the KeyError
            assert gripper.holding
        wait_until(lambda: driver.sent)
    assert set(driver.sent) == {1.5}


class FakeRosGripper:
    """A gripper of ROS 2 behind a router: what it is told it hears as its own messages, and it tells what it likes."""

    def __init__(self, session, address: str) -> None:
        self.bags, typesys = pytest.importorskip("ros_bags"), pytest.importorskip("rosbags.typesys")
        self.types, definition = self.bags.TYPES, "float64 position\nfloat64 max_effort"
        self.types.register(typesys.get_types_from_msg(definition, "control_msgs/msg/GripperCommand"))
        self.address, self.heard = f"zenoh:hand@{address}", []
        self.state: bytes | None = self.joints(effort=[1.0, 2.0], position=[0.5, 0.04])
        self._session, self._stop = session, threading.Event()
        self._names = {f"hand/{row.topic}": row.kind for row in ROS_MESSAGES.values()}
        self._ears = session.declare_subscriber("hand/**", self._hear)
        self._thread = threading.Thread(target=self._tell, daemon=True)
        self._thread.start()

    def joints(self, **fields: list[float]) -> bytes:
        """State of an arm's joint and of the gripper's."""
        arrays = {name: np.array(fields.get(name, []), dtype=float) for name in ("position", "velocity", "effort")}
        kind = "sensor_msgs/msg/JointState"
        message = self.bags.make(kind, header=self.bags.header(0), name=["elbow", "finger"], **arrays)
        return bytes(self.types.serialize_cdr(message, kind))

    def _hear(self, sample) -> None:
        if (kind := self._names.get(str(sample.key_expr))) is not None:
            message = self.types.deserialize_cdr(bytes(sample.payload), kind)
            names = ("data",) if kind.endswith("Array") else ("position", "max_effort")
            self.heard.append((str(sample.key_expr), *(np.asarray(getattr(message, name)).tolist() for name in names)))

    def _tell(self) -> None:
        while not self._stop.wait(0.005):
            if (state := self.state) is not None:  # which a test may change meanwhile
                self._session.put("hand/joint_states", state)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def hand():
    with open_router() as (session, address):
        gripper = FakeRosGripper(session, address)
        yield gripper
        gripper.close()


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        ("gripper-command", [("hand/command", 0.0, 1.25), ("hand/command", 0.0, 0.01)]),
        ("controllers", [("hand/effort_controller/commands", [value]) for value in (1.25, 0.0)]),
    ],
)
def test_a_gripper_of_ros_hears_forces_as_its_messages(hand, messages, told):
    gripper = open_gripper(hand.address, timeout_s=2.0, messages=messages, joint="finger")
    gripper.set_force(1.25)
    gripper.set_force(0.0)  # which some drivers take for no limit
    state = gripper.read_state()
    wait_until(lambda: len(hand.heard) == 2)
    gripper.close()
    assert hand.heard == told
    assert (state.force_n, state.width_m) == (2.0, 0.04)


def test_a_gripper_of_ros_that_misbehaves_is_told_in_a_sentence_and_held(hand):
    gripper: Any = open_gripper(hand.address, timeout_s=2.0)
    for state, told in (
        *((message, "has no force and width") for message in (b"\x00\x01", b"", hand.joints(position=[0.04, 0.04]))),
        (hand.joints(effort=[math.nan, 1.0], position=[0.04, 0.04]), "has nan N"),
    ):
        hand.state = state
        wait_until(lambda state=state: gripper._message == state)
        with pytest.raises(GripperError, match=told):
            gripper.read_state()
    gripper.timeout_s, hand.state = SOON_S, None
    wait_until(lambda: time.monotonic() - gripper._message_s > SOON_S)
    with pytest.raises(GripperError, match="sends no state on /hand/joint_states"):
        gripper.set_force(1.0)
    with GuardedGripper(gripper, ceiling_n=4.0, watchdog_s=SOON_S) as guarded:
        guarded.set_force(1e9)  # told to a gripper that has fallen silent, and again until it speaks
        assert guarded.holding
        wait_until(lambda: len(hand.heard) > 3)
        gripper.timeout_s, hand.state = 2.0, hand.joints(effort=[4.0, 0.0], position=[0.04, 0.0])
        wait_until(lambda: guarded.failure is None)
    assert {told for _, _, told in hand.heard} == {1.0, 4.0}


@pytest.mark.parametrize(
    ("make", "told"),
    [
        *(
            (partial(open_gripper, address), r"no address|no serial device|names no key")
            for address in ("tcp://nowhere", "tcp://:80", "/dev/no-such-device", "zenoh:1@")
        ),
        (partial(GuardedGripper, DryRun(), ceiling_n=math.inf), "must be positive and finite"),
        (partial(GuardedGripper, DryRun(), watchdog_s=-1.0), "must be positive and finite"),
    ],
)
def test_addresses_and_limits_that_cannot_be_are_refused(make, told):
    with pytest.raises(InputError, match=told):
        make()
