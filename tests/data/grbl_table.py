"""What GRBL 1.1 boards answer, typed from the manuals: (dialects, what the host writes, the lines that come back).

The board is idle, unlocked, reports machine positions and buffers, and has homing and soft limits switched off.
Some rows differ between the dialects; those are from the dialects' own documentation and from observation.
"""

BOTH = ("gnea", "grblhal")
GNEA = ("gnea",)
HAL = ("grblhal",)

ROWS: list[tuple[tuple[str, ...], bytes, list[str]]] = [
    # Every line gets ok or error:N; blanks, comments and case do not matter.
    (BOTH, b"\n", ["ok"]),
    (BOTH, b"G21\n", ["ok"]),
    (BOTH, b"G21\r", ["ok"]),
    (BOTH, b"G21\r\n", ["ok", "ok"]),
    (BOTH, b"  g 2 1 \n", ["ok"]),
    (BOTH, b"(a comment) G90\n", ["ok"]),
    (BOTH, b"G90 ; until the end\n", ["ok"]),
    (BOTH, b"/G90\n", ["ok"]),
    (BOTH, b"G21 G90 G94 G17 G54\n", ["ok"]),
    # Words and numbers.
    (BOTH, b"21\n", ["error:1"]),
    (BOTH, b"G\n", ["error:2"]),
    (BOTH, b"G1X1.2.3F10\n", ["error:1"]),
    (BOTH, b"G1X--1F10\n", ["error:2"]),
    (BOTH, b"G1 X1 F-10\n", ["error:4"]),
    (BOTH, b"M3 S-1\n", ["error:4"]),
    (BOTH, b"G5\n", ["error:20"]),
    (GNEA, b"M6\n", ["error:20"]),
    (BOTH, b"G1.1 X1 F10\n", ["error:23"]),
    (BOTH, b"G38.1 X1 F10\n", ["error:20"]),
    (BOTH, b"G90 G91\n", ["error:21"]),
    (BOTH, b"G0 X1 X2\n", ["error:25"]),
    (BOTH, b"M3.1\n", ["error:23"]),
    (GNEA, b"G1 X1 W2 F10\n", ["error:20"]),
    # Motion.
    (BOTH, b"G1 X1\n", ["error:22"]),
    (BOTH, b"G93 G1 X1\n", ["error:22"]),
    (BOTH, b"G0 G10 L2 P1 X1\n", ["error:24"]),
    (BOTH, b"G38.2 F100\n", ["error:26"]),
    (BOTH, b"G38.2 X0 Y0 Z0 F100\n", ["error:33"]),
    (BOTH, b"G2 X1 Y1 F100\n", ["error:35"]),
    (BOTH, b"G1 X1 F10 P2\n", ["error:36"]),
    (BOTH, b"G53 G38.2 Z-1 F100\n", ["error:30"]),
    (BOTH, b"G80 X1\n", ["error:31"]),
    (BOTH, b"N10000001 G21\n", ["error:27"]),
    # Offsets, dwell.
    (BOTH, b"G4\n", ["error:28"]),
    (BOTH, b"G4 P0.01\n", ["ok"]),
    (BOTH, b"G10 L2 P1\n", ["error:26"]),
    (BOTH, b"G10 L2 X1\n", ["error:28"]),
    (GNEA, b"G10 L2 P9 X1\n", ["error:29"]),
    (BOTH, b"G92\n", ["error:26"]),
    (GNEA, b"G59.1\n", ["error:23"]),
    (HAL, b"G59.1\n", ["ok"]),
    (GNEA, b"G43.1 X1\n", ["error:37"]),
    (HAL, b"G43.1 X1\n", ["ok"]),
    (GNEA, b"T256\n", ["error:38"]),
    # Lines with a dollar sign.
    (GNEA, b"$\n", ["[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]", "ok"]),
    (GNEA, b"$G\n", ["[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", "ok"]),
    (HAL, b"$G\n", ["[GC:G0 G54 G17 G21 G90 G94 G40 G49 G98 G50 M5 M9 T0 F0 S0.]", "ok"]),
    (BOTH, b"$N\n", ["$N0=", "$N1=", "ok"]),
    (GNEA, b"$I\n", ["[VER:1.1h.20190830:]", "[OPT:V,15,128]", "ok"]),
    (BOTH, b"$X\n", ["ok"]),
    (BOTH, b"$H\n", ["error:5"]),
    (GNEA, b"$ZZ\n", ["error:2"]),
    (HAL, b"$ZZ\n", ["error:3"]),
    (GNEA, b"$999=1\n", ["error:3"]),
    (HAL, b"$999=1\n", ["error:53"]),
    (BOTH, b"$100=-1\n", ["error:4"]),
    (GNEA, b"$0=2\n", ["error:6"]),
    (HAL, b"$0=2\n", ["ok"]),
    (BOTH, b"$20=1\n", ["error:10"]),
    (BOTH, b"$X1\n", ["error:3"]),
    (GNEA, b"$SLP\n", ["ok", "[MSG:Sleeping]"]),
    (HAL, b"$SLP\n", ["error:3"]),
    (BOTH, b"$C\n", ["[MSG:Enabled]", "ok"]),
    # Jogs.
    (BOTH, b"$J=X1\n", ["error:22"]),
    (BOTH, b"$J=G91 F100\n", ["error:26"]),
    (BOTH, b"$J=X1 F100 M3\n", ["error:16"]),
    (BOTH, b"$J=X1 F100 S5\n", ["error:36"]),
    (BOTH, b"$JX1F100\n", ["error:3"]),
    (BOTH, b"$J=G91 G21 X0.01 F100\n", ["ok"]),
    # Real-time bytes are no lines and get no ok.
    (GNEA, b"?", ["<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>"]),
    (HAL, b"?", ["<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|TLR:0>"]),
    (BOTH, b"~", []),
    (BOTH, b"!", []),
    (BOTH, b"\x85", []),
    (BOTH, b"\x84", ["[MSG:Check Door]"]),
    (BOTH, b"\x91\x94\x97\x9a\xa0", []),
    (GNEA, b"\x18", ["Grbl 1.1h ['$' for help]"]),
    (HAL, b"\x18", ["GrblHAL 1.1f ['$' or '$HELP' for help]"]),
    # A line longer than the line buffer.
    (GNEA, b"G1" + b"0" * 80 + b"\n", ["error:11"]),
    (GNEA, b"(" + b"-" * 100 + b")\n", ["ok"]),
]
