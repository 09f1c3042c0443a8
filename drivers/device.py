"""What every device promises."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


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
