"""Rows of (bytes, value), typed from the GRBL, CiA 301, CiA 402 and LAWICEL manuals, for both ends of each wire.

The driver must make the value of the bytes, or the bytes of the value; so must the emulated device.
"""

# (dialects, what the host writes, what the board answers, what a host understands: class name and its fields).
# The board is idle, unlocked, reports machine positions and buffers, and has homing and soft limits switched off.
GRBL = [
    (("gnea", "grblhal"), b"G21\n", b"ok\r\n", [("Ok",)]),
    (("gnea", "grblhal"), b"21\n", b"error:1\r\n", [("Refused", 1)]),
    (("gnea", "grblhal"), b"G\n", b"error:2\r\n", [("Refused", 2)]),
    (("gnea",), b"$ZZ\n", b"error:2\r\n", [("Refused", 2)]),
    (("grblhal",), b"$ZZ\n", b"error:3\r\n", [("Refused", 3)]),
    (("gnea", "grblhal"), b"$H\n", b"error:5\r\n", [("Refused", 5)]),
    (("gnea", "grblhal"), b"$20=1\n", b"error:10\r\n", [("Refused", 10)]),
    (("gnea", "grblhal"), b"G1X1\n", b"error:22\r\n", [("Refused", 22)]),
    (("gnea",), b"G38.2X0Y0Z0F100\n", b"error:33\r\n", [("Refused", 33)]),
    (("gnea",), b"T999\n", b"error:38\r\n", [("Refused", 38)]),
    (("gnea", "grblhal"), b"$C\n", b"[MSG:Enabled]\r\nok\r\n", [("Feedback", "MSG", "Enabled"), ("Ok",)]),
    (("gnea", "grblhal"), b"$N\n", b"$N0=\r\n$N1=\r\nok\r\n", [("Startup", ""), ("Startup", ""), ("Ok",)]),
    (
        ("gnea",),
        b"$I\n",
        b"[VER:1.1h.20190830:]\r\n[OPT:V,15,128]\r\nok\r\n",
        [("Feedback", "VER", "1.1h.20190830:"), ("Feedback", "OPT", "V,15,128"), ("Ok",)],
    ),
    (
        ("gnea",),
        b"$G\n",
        b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\nok\r\n",
        [("Feedback", "GC", "G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0"), ("Ok",)],
    ),
    (
        ("gnea",),
        b"?",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>\r\n",
        [("Report", "Idle", None, (0.0, 0.0, 0.0), 15)],
    ),
    (
        ("grblhal",),
        b"?",
        b"<Idle|MPos:0.000,0.000,0.000|Bf:100,1023|FS:0,0|Ov:100,100,100|A:|TLR:0>\r\n",
        [("Report", "Idle", None, (0.0, 0.0, 0.0), 100)],
    ),
    (("gnea",), b"\x18", b"\r\nGrbl 1.1h ['$' for help]\r\n", [("Welcome", "1.1h", False)]),
    (
        ("grblhal",),
        b"\x18",
        b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n",
        [("Welcome", "1.1f", True)],
    ),
]

# (controlwords written one after the other from power-up, statusword & 006Fh, the state's name).
STATES = [
    ("", 0x40, "switch on disabled"),
    ("0006", 0x21, "ready to switch on"),
    ("0006 0007", 0x23, "switched on"),
    ("0006 0007 000F", 0x27, "operation enabled"),
    ("0006 0007 000F 0002", 0x07, "quick stop active"),
    ("0006 0007 000F 0000", 0x40, "switch on disabled"),
    ("0006 0007 000F 0006", 0x21, "ready to switch on"),
    ("0006 0007 0002", 0x40, "switch on disabled"),
]

# (index, sub-index, struct layout, value, the host's request, the node's answer), expedited uploads.
UPLOADS = [
    (0x1000, 0, "I", 0x00020192, "40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
    (0x1017, 0, "H", 0, "40 17 10 00 00 00 00 00", "4b 17 10 00 00 00 00 00"),
    (0x1001, 0, "B", 0, "40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00"),
    (0x1400, 1, "I", 0x201, "40 00 14 01 00 00 00 00", "43 00 14 01 01 02 00 00"),
    (0x605A, 0, "h", 2, "40 5a 60 00 00 00 00 00", "4b 5a 60 00 02 00 00 00"),
    (0x6502, 0, "I", 4, "40 02 65 00 00 00 00 00", "43 02 65 00 04 00 00 00"),
    (0x1234, 0, "I", None, "40 34 12 00 00 00 00 00", "80 34 12 00 00 00 02 06"),
    (0x1018, 5, "I", None, "40 18 10 05 00 00 00 00", "80 18 10 05 11 00 09 06"),
]

# (index, sub-index, struct layout, value, the host's request, the node's answer), expedited downloads.
DOWNLOADS = [
    (0x1017, 0, "H", 500, "2b 17 10 00 f4 01 00 00", "60 17 10 00 00 00 00 00"),
    (0x1016, 1, "I", 0x007F00FA, "23 16 10 01 fa 00 7f 00", "60 16 10 01 00 00 00 00"),
    (0x6060, 0, "b", 3, "2f 60 60 00 03 00 00 00", "60 60 60 00 00 00 00 00"),
    (0x6007, 0, "h", 3, "2b 07 60 00 03 00 00 00", "60 07 60 00 00 00 00 00"),
    (0x6083, 0, "I", 100_000, "23 83 60 00 a0 86 01 00", "60 83 60 00 00 00 00 00"),
]

# (identifier, data, the frame as a line on the serial side).
SLCAN = [
    (0x000, "8001", b"t00028001\r"),
    (0x080, "", b"t0800\r"),
    (0x201, "0F0030750000", b"t20160F0030750000\r"),
    (0x601, "4000100000000000", b"t60184000100000000000\r"),
    (0x77F, "05", b"t77F105\r"),
    (0x7FF, "1122334455667788", b"t7FF81122334455667788\r"),
]
