"""A real UDP socket on this machine."""

import pytest

from drivers.errors import ConnectionLostError, DeviceBusyError
from drivers.motion.udp_line import open_udp
from firmware_sim.udp_port import UdpPort


def test_datagrams_go_both_ways_whole() -> None:
    port = UdpPort()
    line = open_udp(port.host, port.port)
    line.write(b"first")
    line.write(b"second")
    assert [port.read(), port.read(), port.read()] == [b"first", b"second", b""]
    port.write(b"one")
    port.write(b"two")
    assert [line.read(1.0), line.read(1.0), line.read(0.0)] == [b"one", b"two", b""]
    line.close()
    port.close()


def test_nobody_there_is_named() -> None:
    port = UdpPort()
    line = open_udp(port.host, port.port)
    port.close()
    line.write(b"anybody?")
    with pytest.raises(ConnectionLostError, match=r"127\.0\.0\.1.*nobody is there"):
        line.read(1.0)
    line.close()


def test_a_host_without_an_address_is_named() -> None:
    with pytest.raises(ConnectionLostError, match=r"correct \[motion\] host"):
        open_udp("no-such-host.invalid", 5007)


def test_one_process_at_a_time_speaks_to_a_controller() -> None:
    port = UdpPort()
    line = open_udp(port.host, port.port)
    with pytest.raises(DeviceBusyError, match="in use by pid"):
        open_udp(port.host, port.port)
    line.close()
    line.close()
    open_udp(port.host, port.port).close()
    with pytest.raises(ConnectionLostError, match="closed"):
        line.write(b"late")
    port.close()
