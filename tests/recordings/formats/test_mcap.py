"""Exported MCAP files: the format's own library reads them with nothing but the file."""

import io
from collections import defaultdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from readers import read_rosbag, refused

from sliplens.recordings import Dataset
from sliplens.recordings.exporting import export_mcap
from sliplens.recordings.formats.stored import read_stored
from sliplens.recordings.trial import LABEL_SIGNALS

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("mcap_ros2")

from mcap.reader import McapReader, make_reader
from mcap_ros2.decoder import DecoderFactory

LABELS, IMAGE, REFERENCE = "/tactile/labels", "/tactile/image", "/tactile/reference"
WRENCH, MARGIN = "/tactile/wrench", "/tactile/safety_margin"


@pytest.fixture(scope="module")
def exported(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mcap") / "bags"
    export_mcap(data, folder)
    return folder


def decode(path: Path) -> tuple[dict[str, list[tuple[Any, Any]]], McapReader]:
    """Records and decoded messages by topic, by the format's own library from the schemas of the file."""
    messages = defaultdict(list)
    reader = make_reader(io.BytesIO(path.read_bytes()), validate_crcs=True, decoder_factories=[DecoderFactory()])
    for _, channel, record, message in reader.iter_decoded_messages(log_time_order=False):
        messages[channel.topic].append((record, message))
    return messages, reader


def test_the_library_of_the_format_decodes_every_message_from_the_file_alone(data, exported):
    for trial in read_stored(data.folder):
        messages, _ = decode(exported / f"{trial.trial}.mcap")
        labels = trial.labels
        assert labels is not None
        ((_, reference),) = messages[REFERENCE]
        np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(reference.data))), trial.reference)
        for (_, message), frame in zip(messages[IMAGE], trial.read_frames(), strict=True):
            assert message.format == "png"
            np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(message.data))), frame)
        rows = [message for _, message in messages[LABELS]]
        for name in LABEL_SIGNALS:
            np.testing.assert_array_equal([getattr(row, name) for row in rows], getattr(labels, name))
        sigma, valid, count = labels.safety_margin_sigma, labels.valid, len(rows)
        np.testing.assert_array_equal(
            [row.safety_margin_sigma for row in rows], np.full(count, np.nan) if sigma is None else sigma
        )
        np.testing.assert_array_equal(
            [row.valid for row in rows], np.isfinite(labels.safety_margin) if valid is None else valid
        )
        assert [row.contact_state for row in rows] == [str(state) for state in labels.contact_state]
        assert [row.invalid_reason for row in rows] == list(labels.reason or [""] * count)
        np.testing.assert_array_equal([message.data for _, message in messages[MARGIN]], labels.safety_margin)
        forces = [(force.x, force.y, force.z) for force in (message.wrench.force for _, message in messages[WRENCH])]
        np.testing.assert_array_equal(forces, [] if trial.forces is None else trial.forces.force_n)
        torques = [(torque.x, torque.y, torque.z) for torque in (m.wrench.torque for _, m in messages[WRENCH])]
        assert not np.any(torques)


def test_stamps_are_the_times_to_the_nanosecond_later_by_whole_seconds(data, exported):
    for trial in read_stored(data.folder):
        messages, reader = decode(exported / f"{trial.trial}.mcap")
        (metadata,) = reader.iter_metadata()
        offset_s = int(metadata.metadata["stamp_offset_s"])
        # -2.71 s goes to 1.29 s, 0.03 to 1.03; seconds since 1970 stay
        assert offset_s == {"full": 4, "since-1970": 0, "bare": 1}[trial.trial]
        series = {IMAGE: trial.frame_time_s, LABELS: trial.frame_time_s}
        if trial.forces is not None:
            series[WRENCH] = trial.forces.time_s
        assert [message.time_s for _, message in messages[LABELS]] == trial.frame_time_s.tolist()
        for topic, time_s in series.items():
            for (record, message), time in zip(messages[topic], time_s.tolist(), strict=True):
                stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                assert record.log_time == record.publish_time == stamp_ns
                # half a nanosecond, and what 53 bits round of a fraction of a second: 1e9 / 2**53 = 1e-7 ns
                assert abs(stamp_ns - (Fraction(time) + offset_s) * 10**9) <= Fraction(1, 2) + Fraction(1, 10**6)


def test_messages_are_in_the_order_of_time_and_indexed(exported):
    for path in exported.glob("*.mcap"):
        with path.open("rb") as stream:
            reader = make_reader(stream)
            records = [
                (channel.topic, record.log_time) for _, channel, record in reader.iter_messages(log_time_order=False)
            ]
            summary = reader.get_summary()
            assert reader.get_header().profile == "ros2"
        assert records[0][0] == REFERENCE
        times = [time for _, time in records]
        assert times == sorted(times)
        assert times[0] >= 10**9  # to ROS a stamp of zero is none
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert summary.chunk_indexes


def test_a_file_that_is_cut_off_is_refused(exported, tmp_path):
    path = tmp_path / "full.mcap"
    path.write_bytes((exported / path.name).read_bytes()[:-5000])
    refused(read_rosbag, path, r"full\.mcap is not a readable ROS 2 bag")
