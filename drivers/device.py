"""What every device promises."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self, TypeVar

from drivers.errors import DeviceError


class Device(ABC):
    """Open from construction; a constructor that raises leaves nothing open.

    ``close()`` leaves the hardware safe and may be called twice. There is no ``__del__``: use a with-statement.
    """

    @abstractmethod
    def close(self) -> None:
        """Leave the hardware safe and give the wire back. A second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


Opened = TypeVar("Opened", bound=Device)


@contextmanager
def closed_in_the_end(device: Opened, told: Callable[[DeviceError], None]) -> Iterator[Opened]:
    """A with-statement whose end hands the error of closing to ``told``.

    A device that fails is often one that cannot be closed in peace; that must not hide how the work with it ended.
    """
    try:
        yield device
    finally:
        try:
            device.close()
        except DeviceError as error:
            told(error)
