"""What sets the two firmwares apart: sizes, pauses, words."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Dialect:
    """One firmware. Sizes in bytes, blocks and segments; times in seconds.

    ``idle_delay`` says that ``$1`` is waited out by the stepper's interrupt, with the program standing still.
    ``poll_s`` is how often the program looks at its input; 0 means at once.
    ``drops_segments`` says that a jog cancel and a probe contact throw away motion that is already prepared.
    """

    name: str
    banner: str
    help: str
    rx_size: int
    tx_size: int
    line_size: int
    blocks: int
    segments: int
    idle_delay: bool
    delay_stretch: float
    poll_s: float
    line_cost_s: float
    alarm_pause_s: float
    drops_segments: bool
    latches_errors: bool


GNEA = Dialect(
    name="gnea",
    banner="Grbl 1.1h ['$' for help]",
    help="[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]",
    rx_size=128,
    tx_size=104,
    line_size=80,
    blocks=15,
    segments=5,
    idle_delay=True,
    delay_stretch=1.09,
    poll_s=0.0,
    line_cost_s=0.0003,
    alarm_pause_s=0.5,
    drops_segments=False,
    latches_errors=False,
)
GRBLHAL = Dialect(
    name="grblhal",
    banner="GrblHAL 1.1f ['$' or '$HELP' for help]",
    help="[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H $B ~ ! ? ctrl-x]",
    rx_size=1023,
    tx_size=512,
    line_size=257,
    blocks=100,
    segments=9,
    idle_delay=False,
    delay_stretch=1.0,
    poll_s=0.001,
    line_cost_s=0.0002,
    alarm_pause_s=0.1,
    drops_segments=True,
    latches_errors=True,
)
DIALECTS = {dialect.name: dialect for dialect in (GNEA, GRBLHAL)}
