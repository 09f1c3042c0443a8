"""Serves one annotator's page until somebody ends it."""

from collections.abc import Callable

import uvicorn

from annotate.app import MOST_MESSAGE_BYTES, desk_app
from annotate.desk import Desk
from live.gate import Gate
from live.patience import patient
from live.server import listen

PING_S = 20.0
"""Loading a network may keep a busy computer from answering for seconds, and nobody's safety waits here."""
NEXT_STEP = "end `mill annotate` and start it again for a new link"


def serve(desk: Desk, told: Callable[[str], None]) -> None:
    """Serve on a free port of the loopback until Ctrl-C.

    Args:
        desk: one annotator's.
        told: given the address, once it answers.
    """
    with listen() as listening:
        gate = Gate(desk_app(desk), listening.getsockname()[1], next_step=NEXT_STEP)
        listening.listen()
        told(gate.address)
        uvicorn.Server(patient(gate, message_bytes=MOST_MESSAGE_BYTES, ping_s=PING_S)).run([listening])
