"""Serves a record until somebody ends it."""

from collections.abc import Callable

import uvicorn

from live.app import recorded
from live.gate import Gate
from live.patience import patient
from live.player import Player
from live.server import listen


def play(player: Player, told: Callable[[str], None]) -> None:
    """Serve on a free port of the loopback until Ctrl-C.

    Args:
        player: of the record.
        told: given the address, once it answers.
    """
    with listen() as listening:
        gate = Gate(recorded(player), listening.getsockname()[1])
        listening.listen()
        told(gate.address)
        uvicorn.Server(patient(gate)).run([listening])
