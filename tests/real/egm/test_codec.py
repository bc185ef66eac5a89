"""EGM messages: units, round trips, refusal of invalid data, and agreement with the schema field by field."""

import dataclasses
import math

import numpy as np
import pytest
from ABBRobotEGM._egm_protobuf import egm_pb2
from hypothesis import given, settings
from hypothesis import strategies as st

from gelflow.errors import PeerError
from gelflow.real.egm.codec import (
    EgmFeedback,
    EgmReference,
    decode_robot,
    decode_sensor,
    encode_robot,
    encode_sensor,
)

FEEDBACK = EgmFeedback(
    sequence=7,
    time=1.234,
    position=(0.374, -0.01, 0.63),
    quaternion=(0.5, 0.5, -0.5, 0.5),
    joints=(0.1, -0.2, 0.3, -0.4, 0.5, -6.0),
)


def test_feedback_is_encoded_in_millimetres_and_degrees() -> None:
    message = egm_pb2.EgmRobot.FromString(encode_robot(FEEDBACK))
    assert (message.header.seqno, message.header.tm, message.header.mtype) == (7, 1234, 2)
    measured = message.feedBack
    assert (measured.cartesian.pos.x, measured.cartesian.pos.y) == pytest.approx((374.0, -10.0))
    assert measured.cartesian.orient.u2 == -0.5
    assert list(measured.joints.joints) == pytest.approx([math.degrees(a) for a in FEEDBACK.joints])
    assert (message.motorState.state, message.mciState.state, message.rapidExecState.state) == (1, 3, 2)


def test_feedback_round_trip() -> None:
    for states in ({}, {"motors": "off"}, {"mci": "error"}, {"rapid": "stopped"}, {"converged": True}):
        sent = dataclasses.replace(FEEDBACK, **states)
        received = decode_robot(encode_robot(sent))
        assert np.allclose(received.position, sent.position, atol=1e-15)
        assert np.allclose(received.joints, sent.joints, atol=1e-14)
        assert received.quaternion == pytest.approx(sent.quaternion, abs=1e-15)
        for name in ("sequence", "time", "motors", "mci", "rapid", "converged"):
            assert getattr(received, name) == getattr(sent, name)


def test_reference_round_trip_has_message_type_3() -> None:
    sent = EgmReference(sequence=9, time=2.5, position=(0.4, 0.1, 0.2), quaternion=(0.0, 0.6, 0.8, 0.0))
    data = encode_sensor(sent)
    message = egm_pb2.EgmSensor.FromString(data)
    assert (message.header.mtype, message.header.seqno, message.header.tm) == (3, 9, 2500)
    assert message.planned.cartesian.pos.x == pytest.approx(400.0)
    received = decode_sensor(data)
    assert received.position == pytest.approx(sent.position, abs=1e-15)
    assert received.quaternion == pytest.approx(sent.quaternion, abs=1e-15)
    assert (received.sequence, received.time) == (9, 2.5)


def test_counters_wrap_at_32_bits() -> None:
    sent = dataclasses.replace(FEEDBACK, sequence=2**32 + 3, time=2**32 * 1e-3 + 0.005)
    received = decode_robot(encode_robot(sent))
    assert (received.sequence, received.time) == (3, 0.005)


def test_stop_reason_names_the_cause() -> None:
    assert FEEDBACK.stop_reason == ""
    # After a restart, a controller reports a running RAPID program as undefined.
    assert dataclasses.replace(FEEDBACK, rapid="undefined").stop_reason == ""
    assert dataclasses.replace(FEEDBACK, motors="off").stop_reason == "motors off"
    assert dataclasses.replace(FEEDBACK, rapid="stopped").stop_reason == "RAPID stopped"
    assert dataclasses.replace(FEEDBACK, mci="stopped").stop_reason == "EGM motion stopped"


def test_euler_angles_override_the_quaternion_of_a_reference() -> None:
    message = egm_pb2.EgmSensor.FromString(encode_sensor(EgmReference(0, 0.0, (0.4, 0.0, 0.2), (1.0, 0.0, 0.0, 0.0))))
    euler = message.planned.cartesian.euler
    euler.x, euler.y, euler.z = 0.0, 0.0, 90.0
    received = decode_sensor(message.SerializeToString())
    assert received.quaternion == pytest.approx((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))


def test_encoded_euler_angles_match_the_quaternion() -> None:
    """Feedback contains both; a reference with its Euler angles must have the same orientation."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        q = rng.normal(size=4)
        q = q / np.linalg.norm(q)
        robot = egm_pb2.EgmRobot.FromString(encode_robot(dataclasses.replace(FEEDBACK, quaternion=tuple(q))))
        sensor = egm_pb2.EgmSensor()
        sensor.header.mtype = 3
        sensor.planned.cartesian.CopyFrom(robot.feedBack.cartesian)
        received = decode_sensor(sensor.SerializeToString())
        assert abs(float(np.dot(received.quaternion, q))) == pytest.approx(1.0, abs=1e-9)


def _message(change: str) -> bytes:
    message = egm_pb2.EgmRobot.FromString(encode_robot(FEEDBACK))
    if change == "type":
        message.header.mtype = 3
    elif change == "nan":
        message.feedBack.cartesian.pos.x = math.nan
    elif change == "joint":
        message.feedBack.joints.joints[2] = math.inf
    elif change == "quaternion":
        message.feedBack.cartesian.orient.u0 = 3.0
    elif change == "no pose":
        message.feedBack.ClearField("cartesian")
    elif change == "five joints":
        del message.feedBack.joints.joints[5]
    elif change == "no position":
        message.feedBack.cartesian.ClearField("pos")
    elif change == "no motion control":
        message.ClearField("mciState")
    return message.SerializeToString()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("type", "of type 2 .data., got type 3"),
        ("nan", "expected a finite pose"),
        ("joint", "expected finite joint angles"),
        ("quaternion", "unit quaternion"),
        ("no pose", "no pose; set EGM up with"),
        ("five joints", "got 5 joints"),
        ("no position", "got an incomplete pose"),
        ("no motion control", "it is cut off"),
    ],
)
def test_invalid_feedback_is_refused(change: str, text: str) -> None:
    with pytest.raises(PeerError, match=text):
        decode_robot(_message(change))


def test_invalid_references_are_refused() -> None:
    with pytest.raises(PeerError, match="that are not one"):
        decode_sensor(encode_robot(FEEDBACK))
    empty = egm_pb2.EgmSensor()
    empty.header.mtype = 4
    with pytest.raises(PeerError, match="got type 4"):
        decode_sensor(empty.SerializeToString())
    empty.header.mtype = 3
    with pytest.raises(PeerError, match="planned pose, got none"):
        decode_sensor(empty.SerializeToString())
    with pytest.raises(PeerError, match="finite pose"):
        decode_sensor(encode_sensor(EgmReference(0, 0.0, (math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 400), st.integers(0, 255))
def test_arbitrary_bytes_raise_only_peer_errors(noise: bytes, position: int, value: int) -> None:
    whole = bytearray(encode_robot(FEEDBACK))
    whole[position % len(whole)] = value
    for data in (noise, bytes(whole), bytes(whole[: position % len(whole)])):
        for decode in (decode_robot, decode_sensor):
            try:
                decode(data)
            except PeerError as error:
                assert "\n" not in str(error)


def test_front_part_of_a_feedback_message_is_no_feedback() -> None:
    data = encode_robot(FEEDBACK)
    for size in range(len(data)):
        try:
            feedback = decode_robot(data[:size])
        except PeerError:
            continue
        assert feedback.stop_reason == "", f"{size} of {len(data)} bytes"
