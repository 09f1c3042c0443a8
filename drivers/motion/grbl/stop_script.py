"""What a supervisor, which knows no make, writes to a GRBL controller to stop it: bytes, and seconds to wait."""

from drivers.motion.grbl import protocol

STOP_SCRIPT = ((protocol.HOLD, 0.2), (protocol.RESET, 0.5), (b"$J=G91G21Z1.5F900\n", 0.4))
"""Hold; a reset at standstill, which drops the queue; 1.5 mm up at 15 mm/s, and the time that takes. If it was not
standing at the reset, its position is lost, and it locks itself and refuses to lift."""
DRILL_OFF = ((protocol.RESET, 0.1),)
"""Nothing but the host stops a drill on this controller: the script's reset, and one more should that get lost."""
