"""Messages between bench and guardian: whole, torn, too long, and what is none."""

import json
import math
import socket
import struct

import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.base import BenchError, DeviceConnectionError, DeviceError, errors
from bench.execution.guardian.channel import Channel, ChannelError, to_error, to_message

LONG = 60.0
"""Wall-clock time that a busy machine may take, s."""

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=10,
)
messages = st.dictionaries(st.text(), values, max_size=4)


def frame(body):
    return struct.pack(">I", len(body)) + body


def same(a, b):
    """Whether two messages are equal to the last bit, nan included."""
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b) or (math.isnan(a) and math.isnan(b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


class Pair:
    """A channel, and the bare socket at its other end."""

    def __enter__(self):
        ours, self.other = socket.socketpair()
        self.channel = Channel(ours)
        return self

    def __exit__(self, *_):
        self.channel.close()
        self.other.close()


@pytest.fixture
def pair():
    with Pair() as made:
        yield made


@settings(deadline=None)
@given(st.lists(messages, max_size=5))
def test_what_is_sent_is_received_to_the_last_bit(sent):
    ours, theirs = (Channel(each) for each in socket.socketpair())
    try:
        received = []
        for message in sent:
            ours.send(message)
            assert theirs.wait(LONG)
            received += theirs.receive()
        assert same(received, sent)
        assert theirs.receive() == []
    finally:
        ours.close()
        theirs.close()


@settings(deadline=None)
@given(st.lists(messages, min_size=1, max_size=4), st.data())
def test_frames_may_be_torn_anywhere(sent, data):
    stream = b"".join(frame(json.dumps(each).encode()) for each in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    with Pair() as pair:
        received = []
        for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            pair.other.sendall(stream[begin:end])
            received += pair.channel.receive()
        assert same(received, sent)


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_garbage_is_refused_and_never_more(garbage):
    """It is no message, or the beginning of one that may still come; no other error leaves the channel."""
    with Pair() as pair:
        pair.other.sendall(garbage)
        try:
            received = pair.channel.receive()
        except ChannelError:
            return
        assert all(isinstance(each, dict) for each in received)


@pytest.mark.parametrize(
    "body",
    [b"", b"[1, 2]", b"3", b"null", b'"end"', b"{", b"\xff\xfe", b"[" * 100000, b'{"n": 1} {"n": 2}', b"1" * 5000],
    ids=lambda body: repr(body[:40]),
)
def test_a_body_that_is_no_object_is_refused(pair, body):
    pair.other.sendall(frame(body))
    with pytest.raises(ChannelError, match=r"no JSON|object of JSON"):
        pair.channel.receive()


def test_a_message_that_is_announced_too_long_is_refused_before_it_comes(pair):
    pair.other.sendall(struct.pack(">I", 0xFFFFFFFF))
    with pytest.raises(ChannelError, match="4294967295 bytes was announced"):
        pair.channel.receive()


def test_a_message_that_is_too_long_is_not_sent(pair):
    with pytest.raises(ChannelError, match="are allowed"):
        pair.channel.send({"text": "x" * (1 << 24)})
    pair.other.setblocking(False)
    with pytest.raises(BlockingIOError):
        pair.other.recv(1)


def test_messages_before_the_end_are_still_received(pair):
    pair.other.sendall(frame(b'{"n": 1}') + frame(b'{"n": 2')[:9])
    pair.other.close()
    assert pair.channel.receive() == [{"n": 1}]
    with pytest.raises(ChannelError, match="gone"):
        pair.channel.receive()


def test_a_long_message_leaves_in_pieces(pair):
    """A second of a loop at 20 kHz is longer than what a socket takes at once."""
    other = Channel(pair.other)
    block = {"setpoints": [[1.0 / (k + 3)] for k in range(40_000)]}
    pair.channel.send(block)
    assert pair.channel.is_sending
    received = []
    while not received:
        pair.channel.wait(0.01)
        assert other.wait(LONG)
        received = other.receive()
    assert received == [block]
    assert not pair.channel.is_sending


def test_one_that_does_not_read_is_as_good_as_gone(pair):
    while not pair.channel.is_sending:
        pair.channel.send({"text": "x" * 10_000})
    with pytest.raises(ChannelError, match="does not read"):
        pair.channel.send({"n": 1})


def test_one_that_is_gone_is_noticed(pair):
    pair.other.close()
    with pytest.raises(ChannelError, match="gone"):
        pair.channel.send({"n": 1})
    with pytest.raises(ChannelError, match="gone"):
        pair.channel.receive()


KINDS = sorted(
    (kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, BenchError)),
    key=lambda kind: kind.__name__,
)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_error_arrives_as_it_was(kind):
    of_device = issubclass(kind, DeviceError)
    error = kind("tec", "tec: open circuit") if of_device else kind("open circuit")
    arrived = to_error(json.loads(json.dumps(to_message(error))))
    assert type(arrived) is kind
    assert str(arrived) == str(error)
    assert arrived.exit_code == error.exit_code
    assert getattr(arrived, "device", None) == ("tec" if of_device else None)


def test_an_error_of_a_driver_arrives_as_the_nearest_that_both_sides_know():
    class ChecksumError(DeviceConnectionError):
        pass

    arrived = to_error(to_message(ChecksumError("tec", "wrong check sum")))
    assert type(arrived) is DeviceConnectionError
    assert str(arrived) == "tec: wrong check sum"


@cases("error", [ZeroDivisionError("division by zero"), KeyboardInterrupt(), SystemExit(3)])
def test_a_defect_arrives_with_its_kind(error):
    arrived = to_error(to_message(error))
    assert type(arrived) is BenchError
    assert str(arrived).startswith(type(error).__name__)
