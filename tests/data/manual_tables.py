"""Rows of (bytes, value), typed from the GRBL 1.1 manual and grblHAL's, for both ends of the wire.

The driver must make the value of the bytes, or the bytes of the value; so must the emulated board. Neither is asked
what the other makes. The tables of the CAN side are in ``can_manual_tables.py``.
"""

BOTH, GNEA, HAL = ("gnea", "grblhal"), ("gnea",), ("grblhal",)

# (dialects, what the host writes, what the board answers, what a host understands: class name and its fields).
# The board is idle, unlocked, reports machine positions and buffers, and has homing and soft limits switched off.
GRBL = [
    (BOTH, b"G21\n", b"ok\r\n", [("Ok",)]),
    (BOTH, b"\n", b"ok\r\n", [("Ok",)]),
    (BOTH, b"G21\r\n", b"ok\r\nok\r\n", [("Ok",), ("Ok",)]),
    (BOTH, b"$C\n", b"[MSG:Enabled]\r\nok\r\n", [("Feedback", "MSG", "Enabled"), ("Ok",)]),
    (BOTH, b"$N\n", b"$N0=\r\n$N1=\r\nok\r\n", [("Startup", ""), ("Startup", ""), ("Ok",)]),
    (
        GNEA,
        b"$I\n",
        b"[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok\r\n",
        [("Feedback", "VER", "1.1h.20190830:"), ("Feedback", "OPT", "V,15,128"), ("Ok",)],
    ),
    (
        GNEA,
        b"$I=mill 7\n$I\n",
        b"ok\r\n[VER:1.1h.20190830:MILL7]\r\n[OPT:V,15,128]\r\nok\r\n",
        [("Ok",), ("Feedback", "VER", "1.1h.20190830:MILL7"), ("Feedback", "OPT", "V,15,128"), ("Ok",)],
    ),
    (
        GNEA,
        b"$G\n",
        b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\nok\r\n",
        [("Feedback", "GC", "G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0"), ("Ok",)],
    ),
    (GNEA, b"$SLP\n", b"ok\r\n[MSG:Sleeping]\r\n", [("Ok",), ("Feedback", "MSG", "Sleeping")]),
    (GNEA, b"\x18", b"\r\nGrbl 1.1h ['$' for help]\r\n", [("Welcome", "1.1h", False)]),
    (HAL, b"\x18", b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n", [("Welcome", "1.1f", True)]),
]

# (code, a word of the manual's message, how a board is brought to say it: dialects, lines before, the line refused).
# Without rows: no line of the host alone makes this board say it.
ERRORS = [
    (1, "letter", [(BOTH, b"", b"21\n"), (GNEA, b"", b"%\n")]),
    (2, "number", [(BOTH, b"", b"G\n"), (GNEA, b"", b"$ZZ\n")]),
    (3, "'$'", [(BOTH, b"", b"$X1\n"), (GNEA, b"", b"$999=1\n"), (HAL, b"", b"$ZZ\n"), (HAL, b"", b"$SLP\n")]),
    (4, "negative", [(BOTH, b"", b"$100=-1\n"), (BOTH, b"", b"G1X1F-10\n")]),
    (5, "homing", [(BOTH, b"", b"$H\n")]),
    (6, "pulse", [(GNEA, b"", b"$0=2\n")]),
    (7, "read", []),
    (8, "standstill", [(BOTH, b"G1X-50F10\n", b"$I\n"), (BOTH, b"G1X-50F10\n", b"$10=3\n")]),
    (9, "locked", [(BOTH, b"$J=G91X-5F10\n", b"G1X1F10\n")]),
    (10, "soft limits", [(BOTH, b"", b"$20=1\n")]),
    (11, "too long", [(GNEA, b"", b"G1" + b"0" * 80 + b"\n")]),
    (12, "step rate", []),
    (13, "door", []),
    (14, "startup line", []),
    (15, "travel", [(GNEA, b"$22=1\n$20=1\n", b"$J=G91X5F600\n")]),
    (16, "jog", [(BOTH, b"", b"$J=X1F10M3\n")]),
    (17, "laser", []),
    (20, "not supported", [(BOTH, b"", b"G5\n"), (GNEA, b"", b"M6\n")]),
    (21, "modal group", [(BOTH, b"", b"G90G91\n"), (BOTH, b"", b"M3M5\n")]),
    (22, "feed rate", [(BOTH, b"", b"G1X1\n"), (BOTH, b"", b"$J=X1\n")]),
    (23, "whole number", [(BOTH, b"", b"G1.1X1F10\n"), (BOTH, b"", b"M3.1\n")]),
    (24, "axis words", [(BOTH, b"", b"G0G10L2P1X1\n")]),
    (25, "repeated", [(BOTH, b"", b"G0X1X2\n")]),
    (26, "no axis words", [(BOTH, b"", b"G38.2F100\n"), (BOTH, b"", b"G92\n")]),
    (27, "line number", [(BOTH, b"", b"N10000001G21\n")]),
    (28, "missing", [(BOTH, b"", b"G4\n")]),
    (29, "coordinate system", [(GNEA, b"", b"G10L2P9X1\n")]),
    (30, "G53", [(BOTH, b"", b"G53G38.2Z-1F100\n")]),
    (31, "without a command", [(BOTH, b"", b"G80X1\n")]),
    (32, "plane", []),
    (33, "target", [(BOTH, b"", b"G38.2X0Y0Z0F100\n")]),
    (34, "radius", []),
    (35, "offset", [(BOTH, b"", b"G2X1Y1F100\n")]),
    (36, "unused", [(BOTH, b"", b"G1X1F10P2\n")]),
    (37, "tool length", [(GNEA, b"", b"G43.1X1\n")]),
    (38, "tool number", [(GNEA, b"", b"T999\n")]),
    (53, "not available", [(HAL, b"", b"$999=1\n")]),
]

# (code, a word of the manual's message, whether the position is lost, how a board is brought to say it).
# How: what is odd about the machine, and what the host writes and how long it waits, in seconds; the board is locked,
# its switches are 1 mm up, its probe is 6 mm down.
HOME = (b"$H\n", 3.0)
ALARMS = [
    (1, "hard limit", True, ("", [HOME, (b"$21=1\n", 0.1), (b"G91G1X3F600\n", 1.0)])),
    (2, "soft limits", False, ("", [HOME, (b"$20=1\n", 0.1), (b"G53G1X5F600\n", 1.0)])),
    (3, "in motion", True, ("", [HOME, (b"G53G1X-20F600\n", 0.3), (b"\x18", 0.6)])),
    (4, "before probing", False, ("probe closed", [HOME, (b"G91G38.2Z-1F100\n", 1.0)])),
    (5, "no contact", False, ("", [HOME, (b"G91G38.2Z-1F600\n", 1.0)])),
    (6, "homing", True, ("", [(b"$H\n", 0.05), (b"\x18", 0.6)])),
    (7, "door", True, ("", [(b"$H\n", 0.05), (b"\x84", 0.6)])),
    (8, "pull-off", True, ("switch sticks", [HOME])),
    (9, "no switch", True, ("no switch", [(b"$H\n", 9.0)])),
    # grblHAL goes on where GRBL ends.
    (10, "emergency stop", True, None),
    (11, "homing is required", True, None),
    (12, "limit switch", True, None),
    (13, "probe protection", True, None),
    (14, "spindle", False, None),
    (15, "second switch", True, None),
    (16, "self test", True, None),
    (17, "motor", True, None),
    (18, "configured", True, None),
]

_ZERO = (0.0, 0.0, 0.0)
# (dialects, $10, what the host writes before, the answer to `?`, what a host reads in it: state, sub-state, machine
# position, free blocks; None where the host needs what the report leaves out).
# Before: bytes, of which each `?` gets an answer that is not looked at.
REPORTS = [
    (GNEA, 0, b"", b"<Idle|WPos:0.000,0.000,0.000|FS:0,0>", None),
    (GNEA, 2, b"", b"<Idle|WPos:0.000,0.000,0.000|Bf:15,128|FS:0,0>", None),
    (HAL, 0, b"", b"<Idle|WPos:0.000,0.000,0.000|TLR:0>", None),
    (GNEA, 1, b"", b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>", ("Idle", None, _ZERO, None)),
    (GNEA, 1, b"?", b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|Ov:100,100,100>", ("Idle", None, _ZERO, None)),
    (GNEA, 3, b"??", b"<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0>", ("Idle", None, _ZERO, 15)),
    (HAL, 3, b"", b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|TLR:0>", ("Idle", None, _ZERO, 100)),
    (HAL, 19, b"?", b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0>", ("Idle", None, _ZERO, 100)),
    (
        HAL,
        511,
        b"",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|TLR:0>",
        ("Idle", None, _ZERO, 100),
    ),
    (
        GNEA,
        3,
        b"G10L2P1X1Y2Z3\n",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:1.000,2.000,3.000>",
        ("Idle", None, _ZERO, 15),
    ),
    (
        HAL,
        511,
        b"?G10L2P1X1Y2Z3\n",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|WCO:1.000,2.000,3.000>",
        ("Idle", None, _ZERO, 100),
    ),
    (
        GNEA,
        2,
        b"G10L2P1X1Y2Z3\n??",
        b"<Idle|WPos:-1.000,-2.000,-3.000|Bf:15,128|FS:0,0>",
        None,
    ),
    (
        GNEA,
        3,
        b"??M3S500\nM8\n",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,500|Ov:100,100,100|A:SF>",
        ("Idle", None, _ZERO, 15),
    ),
    (
        HAL,
        511,
        b"??M3S500\n",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,500|A:S>",
        ("Idle", None, _ZERO, 100),
    ),
    (
        GNEA,
        3,
        b"??\x91\x94\x97\x9b",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0|Ov:109,25,90>",
        ("Idle", None, _ZERO, 15),
    ),
    # A probe and a switch that are closed.
    (
        GNEA,
        3,
        b"??G1Z-6X1F600\n",
        b"<Idle|MPos:1.000,0.000,-6.000|Bf:15,128|FS:0,0|Pn:PX>",
        ("Idle", None, (1.0, 0.0, -6.0), 15),
    ),
    (GNEA, 3, b"!", b"<Hold:0|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>", ("Hold", 0, _ZERO, 15)),
    (GNEA, 1, b"?\x84??", b"<Door:0|MPos:0.000,0.000,0.000|FS:0,0>", ("Door", 0, _ZERO, None)),
    (GNEA, 1, b"??$C\n", b"<Check|MPos:0.000,0.000,0.000|FS:0,0>", ("Check", None, _ZERO, None)),
    (GNEA, 1, b"??$SLP\n", b"<Sleep|MPos:0.000,0.000,0.000|FS:0,0>", ("Sleep", None, _ZERO, None)),
]

# Reports of boards that are built otherwise or in a state that this board is not brought to: the host's side only.
REPORTS_OF_OTHER_BOARDS = [
    (b"<Idle|MPos:3.000,2.000,0.000|FS:0,8000|Pn:RS|Ov:100,100,100>", ("Idle", None, (3.0, 2.0, 0.0), None)),
    (b"<Run|MPos:23.036,1.620,0.000|Bf:9,118|Ln:99999|F:500>", ("Run", None, (23.036, 1.62, 0.0), 9)),
    (b"<Run|MPos:-5.529,0.560,7.000|FS:500,8000|A:SFM>", ("Run", None, (-5.529, 0.56, 7.0), None)),
    (b"<Hold:1|MPos:5.000,2.000,0.000|FS:123,0>", ("Hold", 1, (5.0, 2.0, 0.0), None)),
    (b"<Jog|MPos:0.000,0.000,0.000|FS:100,0>", ("Jog", None, _ZERO, None)),
    (b"<Home|MPos:0.000,0.000,0.000|FS:0,0>", ("Home", None, _ZERO, None)),
    (b"<Alarm|MPos:0.000,0.000,0.000|FS:0,0|Pn:XYZPDHRS>", ("Alarm", None, _ZERO, None)),
    (b"<Door:3|MPos:0.000,0.000,0.000|FS:0,0>", ("Door", 3, _ZERO, None)),
    (b"<Tool|MPos:0.000,0.000,0.000|FS:0,0>", ("Tool", None, _ZERO, None)),
    (b"<Idle|MPos:1.000,2.000,3.000,4.000|Bf:35,1023|FS:0,0>", ("Idle", None, (1.0, 2.0, 3.0), 35)),
]

# (real-time byte, the driver's name for it, what the host wrote before, `?` afterwards begins with, and contains).
REALTIME = [
    (b"?", "STATUS", b"", b"<Idle|", b""),
    (b"!", "HOLD", b"G1X-9F600\n", b"<Hold:", b""),
    (b"~", "RESUME", b"!", b"<Idle|", b""),
    (b"\x18", "RESET", b"$J=X-9F600\n", b"<Alarm|", b""),
    (b"\x84", None, b"", b"<Door:0|", b""),
    (b"\x85", None, b"$J=X-9F600\n", b"<Idle|", b""),
    (b"\x91", None, b"??", b"<Idle|", b"|Ov:110,100,100"),
    (b"\x92", None, b"??", b"<Idle|", b"|Ov:90,100,100"),
    (b"\x93", None, b"??", b"<Idle|", b"|Ov:101,100,100"),
    (b"\x94", None, b"??", b"<Idle|", b"|Ov:99,100,100"),
    (b"\x90", None, b"\x91??", b"<Idle|", b"|Ov:100,100,100"),
    (b"\x96", None, b"??", b"<Idle|", b"|Ov:100,50,100"),
    (b"\x97", None, b"??", b"<Idle|", b"|Ov:100,25,100"),
    (b"\x95", None, b"\x97??", b"<Idle|", b"|Ov:100,100,100"),
    (b"\x9a", None, b"??", b"<Idle|", b"|Ov:100,100,110"),
    (b"\x9b", None, b"??", b"<Idle|", b"|Ov:100,100,90"),
    (b"\x9c", None, b"??", b"<Idle|", b"|Ov:100,100,101"),
    (b"\x9d", None, b"??", b"<Idle|", b"|Ov:100,100,99"),
    (b"\x99", None, b"\x9a??", b"<Idle|", b"|Ov:100,100,100"),
    (b"\x9e", None, b"M3S500\n!", b"<Hold:0|", b"|FS:0,0"),
    (b"\xa0", None, b"??", b"<Idle|", b"|A:F"),
]

# (dialects, what the host writes, the line of `$$` that shows it, number, value as a number).
SETTINGS = [
    (BOTH, b"$0=10\n", b"$0=10\r\n", 0, 10.0),
    (BOTH, b"$1=255\n", b"$1=255\r\n", 1, 255.0),
    (BOTH, b"$10=3\n", b"$10=3\r\n", 10, 3.0),
    (BOTH, b"$11=0.02\n", b"$11=0.020\r\n", 11, 0.02),
    (BOTH, b"$13=0\n", b"$13=0\r\n", 13, 0.0),
    (BOTH, b"$23=5\n", b"$23=5\r\n", 23, 5.0),
    (BOTH, b"$27=1.5\n", b"$27=1.500\r\n", 27, 1.5),
    (BOTH, b"$100=314.9606\n", b"$100=314.961\r\n", 100, 314.961),
    (BOTH, b"$112=500\n", b"$112=500.000\r\n", 112, 500.0),
    (BOTH, b"$120=10.\n", b"$120=10.000\r\n", 120, 10.0),
    (BOTH, b"$132=27.999\n", b"$132=27.999\r\n", 132, 27.999),
    (GNEA, b"$30=1000\n", b"$30=1000\r\n", 30, 1000.0),
    (HAL, b"$30=1000\n", b"$30=1000.000\r\n", 30, 1000.0),
]
