"""What the benches share: an emulated device behind a pty in real time, and a second thread."""

import contextlib
import select
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from firmware_sim.ptys import SerialPty

JOIN_S = 5.0

Action = Callable[[], None]


class SerialDevice(Protocol):
    """The other end of a serial line."""

    def receive(self, data: bytes) -> None: ...

    def transmit(self) -> bytes: ...

    def advance_to(self, time_s: float) -> None: ...


class PtyDevice:
    """A device behind a pty, in real time, on a thread of its own."""

    def __init__(self, device: SerialDevice, hear: Callable[[bytes], None] = lambda data: None) -> None:
        self._device = device
        self._hear = hear
        self._port = SerialPty()
        self.path = self._port.path
        self._lock = threading.Lock()
        self._started_s = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def inject(self, data: bytes) -> None:
        """Bytes from nobody on this side."""
        with self._lock:
            self._device.receive(data)

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join(JOIN_S)
            self._port.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            readable = select.select([self._port], [], [], 0.001)[0]
            with self._lock:
                # What has just arrived is heard now, and not when the device was last looked after.
                self._device.advance_to(time.monotonic() - self._started_s)
                if readable:
                    data = self._port.read()
                    self._hear(data)
                    self._device.receive(data)
                self._port.write(self._device.transmit())


@contextlib.contextmanager
def soon(delay_s: float) -> Iterator[Callable[[Action], None]]:
    """A function that has a second thread do something after ``delay_s``; all is done in the end."""
    threads: list[threading.Thread] = []

    def start(action: Action) -> None:
        threads.append(threading.Timer(delay_s, action))
        threads[-1].start()

    try:
        yield start
    finally:
        for thread in threads:
            thread.join(JOIN_S)


def in_second_thread(action: Action) -> None:
    """To its end. The first thread may stand in the middle of a read: an action that waits for it never ends."""
    thread = threading.Thread(target=action)
    thread.start()
    thread.join(JOIN_S)
    assert not thread.is_alive()
