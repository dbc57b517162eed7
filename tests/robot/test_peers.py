"""Other publishers of commands are told from the processes of the drive, also after a reconnection."""

from __future__ import annotations

from kraft.robot.loopback import LoopbackBus, LoopbackNode
from kraft.robot.peers import PeerWatch, wait_for_another
from kraft.robot.transport import Peers


class Listed(LoopbackNode):
    """A transport that lists given publishers."""

    def __init__(self, *names: str) -> None:
        super().__init__(LoopbackBus(), "kraft")
        self.names: frozenset[str] | None = frozenset(names)
        self.connections = 1  # type: ignore[misc]

    def peers(self, topic: str) -> Peers:
        return Peers(self.names, frozenset())


class Later(Listed):
    """A transport that lists the guard at the third look."""

    def __init__(self) -> None:
        super().__init__()
        self.looks = 0

    def peers(self, topic: str) -> Peers:
        self.looks += 1
        return Peers(frozenset(("a", "guard") if self.looks > 2 else ("a",)), frozenset())


def test_a_guard_that_is_listed_late_is_waited_for_beside_the_controller() -> None:
    transport = Later()
    wait_for_another(transport, "/drive", frozenset(("a",)), 10.0)
    watch = PeerWatch(transport, "/drive")
    watch.look()
    assert not watch.foreign
    wait_for_another(Listed("a"), "/drive", None, 10.0)  # nothing can be told
    wait_for_another(Listed("a"), "/drive", frozenset(("a",)), 0.1)  # one that does not come


def test_own_clients_with_new_names_are_no_others_after_a_reconnection() -> None:
    transport = Listed("a", "b")
    watch = PeerWatch(transport, "/drive")
    transport.connections += 1
    for names in ((), ("c",), ("c", "d")):
        transport.names = frozenset(names)
        watch.look()
        assert not watch.foreign
    transport.names = frozenset(("c", "d", "joystick"))
    watch.look()
    assert watch.foreign == "somebody else publishes commands on /drive (joystick)"
    transport.names = frozenset(("c", "d"))
    watch.look()
    assert not watch.foreign


def test_a_new_publisher_without_a_reconnection_or_besides_it_is_another_one() -> None:
    transport = Listed("bridge")
    watch = PeerWatch(transport, "/drive")
    transport.names = frozenset(("bridge", "joystick"))
    watch.look()
    assert "(joystick)" in watch.foreign
    transport.names = None
    watch.look()
    assert "(joystick)" in watch.foreign, "nothing new is known"
    watch.reconnected()
    transport.names = frozenset(("bridge", "joystick"))
    watch.look()
    assert "(joystick)" in watch.foreign


def test_a_guard_that_alone_connects_again_is_no_other() -> None:
    transport = Listed("a", "b")
    watch = PeerWatch(transport, "/drive")
    watch.reconnected()
    transport.names = frozenset(("a", "c"))
    watch.look()
    assert not watch.foreign


def test_who_publishes_first_when_that_is_known_is_of_the_drive() -> None:
    """The first answer of the network may come too late."""
    transport = Listed("guard")
    transport.names = None
    watch = PeerWatch(transport, "/drive")
    for names in (None, frozenset(("guard",)), frozenset(("guard",))):
        transport.names = names
        watch.look()
        assert not watch.foreign
    transport.names = frozenset(("guard", "joystick"))
    watch.look()
    assert "(joystick)" in watch.foreign
