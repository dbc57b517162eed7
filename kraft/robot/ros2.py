"""ROS 2 topics over DDS without ROS: type names, topic names and quality of service as Humble to Jazzy use them."""

from __future__ import annotations

import os
import threading
import time
from functools import cache
from typing import Any, Final

from kraft.errors import Code, InputError, MissingDependency
from kraft.logs.bag_tables import typestore
from kraft.provenance import install_command
from kraft.robot.messages import from_cdr, to_cdr
from kraft.robot.robot_file import Ros2
from kraft.robot.transport import Peers, Receive, Receiver, Refused

try:
    from cyclonedds import idl
    from cyclonedds.builtin import (
        BuiltinDataReader,
        BuiltinTopicDcpsPublication,
        BuiltinTopicDcpsSubscription,
    )
    from cyclonedds.core import DDSException, Policy, Qos, ReadCondition, WaitSet
    from cyclonedds.core import InstanceState as Instance
    from cyclonedds.core import SampleState as Sample
    from cyclonedds.core import ViewState as View
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import types as idl_types
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:
    raise MissingDependency(f"transport: ros2 needs cyclonedds: {install_command('ros2')}") from error

WAIT: Final = 0.1
"""Longest time between two looks at whether the transport is closed, s."""
HISTORY: Final = 50
"""Number of messages that wait to be received."""
BLOCKING: Final = 1
"""Longest time for which sending may wait, ms."""
DISCOVERY: Final = 1000
"""Number of endpoints that are read at once."""
_BASE, _NAME, _ARRAY = 1, 2, 3
_SCALARS: Final = {
    "bool": bool, "byte": idl_types.uint8, "char": idl_types.uint8, "string": str,
    **{name: getattr(idl_types, name) for name in (
        "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64",
    )},
}  # fmt: skip


def dds_type(kind: str) -> str:
    """Name of a type in DDS: ``geometry_msgs::msg::dds_::PoseStamped_``."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def dds_topic(topic: str) -> str:
    """Name of a topic in DDS: ``rt/drive``."""
    return f"rt{topic}"


@cache
def _structure(kind: str) -> Any:
    """Type description of messages, from the definitions of rosbags."""
    fields = {name: _field(node) for name, node in typestore().fielddefs[kind][1]}
    return idl.make_idl_struct(kind.replace("/", "_"), dds_type(kind).replace("::", "."), fields)


def _field(node: Any) -> Any:
    kind, detail = int(node[0]), node[1]
    if kind == _NAME:
        return _structure(detail)
    if kind == _BASE:
        return _SCALARS[detail[0]]
    inner, size = detail
    listed: Any = idl_types  # its generic types are not described
    return listed.array[_field(inner), size] if kind == _ARRAY else listed.sequence[_field(inner)]


@cache
def _samples(kind: str) -> Any:
    """Type of samples that carry the CDR bytes of rosbags' messages, with the description of the type."""
    description = _structure(kind)

    class Serialised(description):  # type: ignore[misc, valid-type]
        """A message as CDR bytes."""

        def __init__(self, content: bytes) -> None:
            self.content = content

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return self.content

        @classmethod
        def deserialize(cls, content: bytes, *_: Any, **__: Any) -> Any:
            return cls(content)

    Serialised.__idl__ = description.__idl__
    return Serialised


class Ros2Transport:
    """Transport over DDS.  A thread waits for messages of all topics."""

    def __init__(self, settings: Ros2) -> None:
        """Join the domain.

        Raises:
            InputError: if ROS_DOMAIN_ID is no number of a domain, or DDS cannot use the interface.
        """
        number = domain_number(settings)
        self._domain = _configure(number, settings.interface)
        try:
            self._participant = DomainParticipant(number)
        except DDSException as error:
            problem = f"DDS cannot join domain {number} ({error})"
            raise InputError.of("transport", problem, "expected a network interface that DDS can use") from error
        self.connections: Final = 1
        self._problem = ""
        self._writers: dict[str, Any] = {}
        self._readers: dict[Any, tuple[Any, str, Receive, Refused | None]] = {}
        self._waitset = WaitSet(self._participant)
        self._lock = threading.Lock()
        self._closed = False
        self._seen = {
            "publishers": BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication),
            "subscribers": BuiltinDataReader(self._participant, BuiltinTopicDcpsSubscription),
        }
        self._receiver = Receiver(self._receive, "dds receiver")

    @property
    def problem(self) -> str:
        """Why nothing travels now; empty while messages do."""
        return self._receiver.defect or self._problem

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages: reliable, and transient local if they are latched."""
        quality = _quality(reliable=True, latched=latched)
        named = Topic(self._participant, dds_topic(topic), _samples(kind), quality)
        self._writers[topic] = DataWriter(self._participant, named, quality)

    def publish(self, topic: str, message: Any) -> None:
        """Send a message; one that cannot be sent at once is dropped."""
        writer = self._writers[topic]
        try:
            writer.write(writer.data_type(to_cdr(message)))
            self._problem = ""
        except DDSException as error:
            self._problem = f"DDS cannot send on {topic} ({error})"

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive the messages of a topic; latched ones are reliable and transient local."""
        quality = _quality(reliable=reliable or latched, latched=latched)
        named = Topic(self._participant, dds_topic(topic), _samples(kind), quality)
        reader = DataReader(self._participant, named, quality)
        condition = ReadCondition(reader, View.Any | Instance.Any | Sample.NotRead)
        with self._lock:
            self._readers[condition] = (reader, kind, receive, refused)
            self._waitset.attach(condition)

    def peers(self, topic: str) -> Peers:
        """Endpoints of other participants."""
        own, name = self._participant.guid, dds_topic(topic)
        found = {}
        for what, reader in self._seen.items():
            there = reader.read(DISCOVERY)
            found[what] = frozenset(
                str(each.key) for each in there
                if each.topic_name == name and each.participant_key != own
                and each.sample_info.instance_state == Instance.Alive
            )  # fmt: skip
        return Peers(found["publishers"], found["subscribers"])

    def close(self) -> None:
        """Leave the domain."""
        self._closed = True
        self._receiver.join(10 * WAIT)

    def _receive(self) -> None:
        while not self._closed:
            self._waitset.wait(duration(seconds=WAIT))
            arrival = time.monotonic_ns()
            with self._lock:
                readers = list(self._readers.values())
            for reader, kind, receive, refused in readers:
                for sample in reader.take(HISTORY):
                    if sample.sample_info.valid_data:
                        _deliver(sample.content, kind, receive, arrival, refused)


def _deliver(content: bytes, kind: str, receive: Receive, arrival: int, refused: Refused | None = None) -> None:
    """Hand over a message; bytes that are none of this type come from a publisher of another type and are dropped."""
    try:
        message = from_cdr(content, kind)
    except Exception as error:  # rosbags may raise anything on bytes that are no message
        if refused is not None:
            refused(f"is not a {kind}: {error}")
        return
    receive(message, arrival)


def domain_number(settings: Ros2) -> int:
    """DDS domain: that of the robot file, else ROS_DOMAIN_ID, else 0.

    Raises:
        InputError: if ROS_DOMAIN_ID is no such number.
    """
    if settings.domain is not None:
        return settings.domain
    given = os.environ.get("ROS_DOMAIN_ID", "0") or "0"
    if not given.isdecimal() or int(given) > 232:
        expected = "expected a number from 0 to 232"
        raise InputError.of("ROS_DOMAIN_ID", f"is {given!r}", expected, Code.VALUE)
    return int(given)


def _configure(number: int, interface: str | None) -> Any:
    """Domain on an interface, unless CYCLONEDDS_URI configures DDS; it is kept as long as the transport."""
    if interface is None or "CYCLONEDDS_URI" in os.environ:
        return None
    chosen = f'<Interfaces><NetworkInterface name="{interface}" multicast="default"/></Interfaces>'
    local = interface == "lo"  # without multicast, which a loopback interface often lacks
    general = f"<General>{chosen}{'<AllowMulticast>false</AllowMulticast>' if local else ''}</General>"
    peers = "<Peers><Peer address='localhost'/></Peers><ParticipantIndex>auto</ParticipantIndex>"
    text = f"<Domain id='any'>{general}{f'<Discovery>{peers}</Discovery>' if local else ''}</Domain>"
    try:
        return Domain(number, text)
    except DDSException as error:
        if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            return None  # this process has configured the domain before
        problem, expected = f"DDS cannot use {interface!r}", "expected a network interface that is up"
        raise InputError.of("transport.interface", problem, expected, Code.MISMATCH) from None


def _quality(*, reliable: bool, latched: bool) -> Any:
    """Quality of service of a publisher or subscriber of ROS 2."""
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=BLOCKING)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(1 if latched else HISTORY),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.TypeConsistency.AllowTypeCoercion(True, True, True, False, False),
    )
