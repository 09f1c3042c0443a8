"""Rows of (bytes, value), typed from the CiA 301, CiA 402 and LAWICEL manuals, for both ends of the wire.

The driver must make the value of the bytes, or the bytes of the value; so must the emulated drive and adapter.
"""

# (mask and value of the statusword, the state's name, how a drive is brought there from power-up).
# How: controlwords; "..." for 20 ms and "slow" for 0.4 s; "silence" for a host that stops to beat while 6007h says
# fault; None for a drive that still boots.
STATES = [
    (0x4F, 0x00, "not ready to switch on", None),
    (0x4F, 0x40, "switch on disabled", ""),
    (0x6F, 0x21, "ready to switch on", "0006"),
    (0x6F, 0x23, "switched on", "0006 0007"),
    (0x6F, 0x27, "operation enabled", "0006 0007 000F"),
    (0x6F, 0x07, "quick stop active", "0006 0007 000F 0002"),
    (0x4F, 0x0F, "fault reaction active", "0006 0007 000F ... ... silence"),
    (0x4F, 0x08, "fault", "0006 0007 silence ..."),
]

# (number of the transition, how a drive is brought before it, what comes then, the statusword & 006Fh behind it).
TRANSITIONS = [
    ("0, 1", None, "...", 0x40),
    ("2", "", "0006", 0x21),
    ("3", "0006", "0007", 0x23),
    ("4", "0006 0007", "000F", 0x27),
    ("3 and 4", "0006", "000F", 0x27),
    ("5", "0006 0007 000F", "0007 ...", 0x23),
    ("6", "0006 0007", "0006", 0x21),
    ("7", "0006", "0000", 0x40),
    ("7 by quick stop", "0006", "0002", 0x40),
    ("8", "0006 0007 000F", "0006", 0x21),
    ("9", "0006 0007 000F", "0000", 0x40),
    ("10", "0006 0007", "0000", 0x40),
    ("10 by quick stop", "0006 0007", "0002", 0x40),
    ("11", "0006 0007 000F", "0002", 0x07),
    ("12", "0006 0007 000F 0002", "0000", 0x40),
    ("12 by standstill", "0006 0007 000F 0002", "...", 0x40),
    ("13", "0006 0007 000F ... ...", "silence", 0x0F),
    ("14", "0006 0007 000F silence", "slow", 0x08),
    ("15", "0006 0007 silence ...", "0080", 0x40),
    ("no way by 15 without an edge", "0006 0007 silence ... 0080 silence ...", "0080", 0x08),
    ("no way out of a fault but by 15", "0006 0007 silence ...", "0006 0007 000F", 0x08),
    ("no way from disabled but by 2", "", "000F", 0x40),
]

# (the driver's name for it, mask and value of the controlword) of CiA 402-2, table 27.
COMMANDS = [
    ("SHUTDOWN", 0x87, 0x06),
    ("SWITCH_ON", 0x8F, 0x07),
    ("ENABLE", 0x8F, 0x0F),
    ("DISABLE_VOLTAGE", 0x82, 0x00),
    ("QUICK_STOP", 0x86, 0x02),
    ("FAULT_RESET", 0x80, 0x80),
]

# (state, the command that leads on towards operation).
TOWARDS = [
    ("switch on disabled", "SHUTDOWN"),
    ("ready to switch on", "SWITCH_ON"),
    ("switched on", "ENABLE"),
    ("quick stop active", "DISABLE_VOLTAGE"),
]

# (index, sub-index, struct layout, value, the host's request, the node's answer), expedited uploads.
UPLOADS = [
    (0x1000, 0, "I", 0x00020192, "40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
    (0x1017, 0, "H", 0, "40 17 10 00 00 00 00 00", "4b 17 10 00 00 00 00 00"),
    (0x1001, 0, "B", 0, "40 01 10 00 00 00 00 00", "4f 01 10 00 00 00 00 00"),
    (0x1400, 1, "I", 0x201, "40 00 14 01 00 00 00 00", "43 00 14 01 01 02 00 00"),
    (0x1800, 1, "I", 0x40000181, "40 00 18 01 00 00 00 00", "43 00 18 01 81 01 00 40"),
    (0x605A, 0, "h", 2, "40 5a 60 00 00 00 00 00", "4b 5a 60 00 02 00 00 00"),
    (0x606C, 0, "i", 0, "40 6c 60 00 00 00 00 00", "43 6c 60 00 00 00 00 00"),
    (0x6061, 0, "b", 0, "40 61 60 00 00 00 00 00", "4f 61 60 00 00 00 00 00"),
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
    (0x60FF, 0, "i", -30_000, "23 ff 60 00 d0 8a ff ff", "60 ff 60 00 00 00 00 00"),
]

# TPDO1 with statusword, velocity and torque at each SYNC, RPDO1 with controlword and target velocity at once, in the
# order that CiA 301 asks for; as DOWNLOADS.
PDO_MAPPING = [
    (0x1800, 1, "I", 0xC0000181, "23 00 18 01 81 01 00 c0", "60 00 18 01 00 00 00 00"),
    (0x1800, 2, "B", 1, "2f 00 18 02 01 00 00 00", "60 00 18 02 00 00 00 00"),
    (0x1A00, 0, "B", 0, "2f 00 1a 00 00 00 00 00", "60 00 1a 00 00 00 00 00"),
    (0x1A00, 1, "I", 0x60410010, "23 00 1a 01 10 00 41 60", "60 00 1a 01 00 00 00 00"),
    (0x1A00, 2, "I", 0x606C0020, "23 00 1a 02 20 00 6c 60", "60 00 1a 02 00 00 00 00"),
    (0x1A00, 3, "I", 0x60770010, "23 00 1a 03 10 00 77 60", "60 00 1a 03 00 00 00 00"),
    (0x1A00, 0, "B", 3, "2f 00 1a 00 03 00 00 00", "60 00 1a 00 00 00 00 00"),
    (0x1800, 1, "I", 0x40000181, "23 00 18 01 81 01 00 40", "60 00 18 01 00 00 00 00"),
    (0x1400, 1, "I", 0x80000201, "23 00 14 01 01 02 00 80", "60 00 14 01 00 00 00 00"),
    (0x1400, 2, "B", 255, "2f 00 14 02 ff 00 00 00", "60 00 14 02 00 00 00 00"),
    (0x1600, 0, "B", 0, "2f 00 16 00 00 00 00 00", "60 00 16 00 00 00 00 00"),
    (0x1600, 1, "I", 0x60400010, "23 00 16 01 10 00 40 60", "60 00 16 01 00 00 00 00"),
    (0x1600, 2, "I", 0x60FF0020, "23 00 16 02 20 00 ff 60", "60 00 16 02 00 00 00 00"),
    (0x1600, 0, "B", 2, "2f 00 16 00 02 00 00 00", "60 00 16 00 00 00 00 00"),
    (0x1400, 1, "I", 0x00000201, "23 00 14 01 01 02 00 00", "60 00 14 01 00 00 00 00"),
]

# (data of that RPDO1, controlword, target velocity in rpm).
COMMAND_FRAMES = [
    ("06 00 00 00 00 00", 0x0006, 0),
    ("0f 00 30 75 00 00", 0x000F, 30_000),
    ("0f 00 60 ea 00 00", 0x000F, 60_000),
]

# (data of that TPDO1, statusword, velocity in rpm, torque in per mille).
REPORT_FRAMES = [
    ("50 12 00 00 00 00 00 00", 0x1250, 0, 0),
    ("37 06 30 75 00 00 64 00", 0x0637, 30_000, 100),
    ("17 02 d0 8a ff ff 9c ff", 0x0217, -30_000, -100),
]

# (abort code, the host's requests, the node's answer to the last one, and for a single download what the host wrote:
# index, sub-index, struct layout, value).
ABORTS = [
    (0x05030000, ["40 08 10 00 00 00 00 00", "70 00 00 00 00 00 00 00"], "80 08 10 00 00 00 03 05", None),
    (0x05040001, ["e0 00 10 00 00 00 00 00"], "80 00 10 00 01 00 04 05", None),
    (
        0x06010000,
        ["23 00 1a 01 10 00 41 60"],
        "80 00 1a 01 00 00 01 06",
        (0x1A00, 1, "I", 0x60410010),
    ),
    (0x06010002, ["2b 41 60 00 00 00 00 00"], "80 41 60 00 02 00 01 06", (0x6041, 0, "H", 0)),
    (0x06020000, ["2b 34 12 00 01 00 00 00"], "80 34 12 00 00 00 02 06", (0x1234, 0, "H", 1)),
    (
        0x06040041,
        ["2f 01 1a 00 00 00 00 00", "23 01 1a 01 20 00 00 10"],
        "80 01 1a 01 41 00 04 06",
        None,
    ),
    (0x06040043, ["23 16 10 01 fa 00 01 00"], "80 16 10 01 43 00 04 06", (0x1016, 1, "I", 0x000100FA)),
    (0x06070012, ["23 17 10 00 f4 01 00 00"], "80 17 10 00 12 00 07 06", (0x1017, 0, "I", 500)),
    (0x06070013, ["2f 17 10 00 64 00 00 00"], "80 17 10 00 13 00 07 06", (0x1017, 0, "B", 100)),
    (0x06090011, ["2f 18 10 05 00 00 00 00"], "80 18 10 05 11 00 09 06", (0x1018, 5, "B", 0)),
    (0x06090030, ["2f 60 60 00 07 00 00 00"], "80 60 60 00 30 00 09 06", (0x6060, 0, "b", 7)),
    (0x06090031, ["23 80 60 00 61 ea 00 00"], "80 80 60 00 31 00 09 06", (0x6080, 0, "I", 60_001)),
    (0x06090032, ["23 83 60 00 00 00 00 00"], "80 83 60 00 32 00 09 06", (0x6083, 0, "I", 0)),
    (0x08000024, ["40 03 10 01 00 00 00 00"], "80 03 10 01 24 00 00 08", None),
]

# (code, the data of node 1's frame, a word of the standard's text, what makes the emulated drive say it: frames to it,
# and "..." for 0.1 s; None where it has no such fault).
EMERGENCIES = [
    (0x2310, "10 23 03 00 00 00 00 00", "over-current at the output", None),
    (0x2320, "20 23 03 00 00 00 00 00", "short circuit", None),
    (0x3120, "20 31 05 00 00 00 00 00", "mains under-voltage", None),
    (0x3210, "10 32 05 00 00 00 00 00", "over-voltage", None),
    (0x3220, "20 32 05 00 00 00 00 00", "under-voltage", None),
    (0x4210, "10 42 09 00 00 00 00 00", "device temperature", None),
    (0x4310, "10 43 09 00 00 00 00 00", "drive temperature", None),
    (0x5112, "12 51 05 00 00 00 00 00", "24 V", None),
    (0x5530, "30 55 01 00 00 00 00 00", "EEPROM", None),
    (0x6320, "20 63 01 00 00 00 00 00", "parameter", None),
    (0x7121, "21 71 21 00 00 00 00 00", "motor blocked", None),
    (0x7305, "05 73 21 00 00 00 00 00", "incremental sensor 1", None),
    (0x8110, "10 81 11 00 00 00 00 00", "overrun", None),
    (0x8120, "20 81 11 00 00 00 00 00", "passive", None),
    (0x8130, "30 81 11 00 00 00 00 00", "heartbeat", ["601 23 16 10 01 14 00 7f 00", "77f 05", "..."]),
    (0x8140, "40 81 11 00 00 00 00 00", "bus-off", None),
    (0x8210, "10 82 11 00 00 00 00 00", "PDO too short", ["000 01 01", "201 06"]),
    (0x8400, "00 84 01 00 00 00 00 00", "speed", None),
    (0x8611, "11 86 01 00 00 00 00 00", "following error", None),
    (0xFF01, "01 ff 81 00 00 00 00 00", "maker", None),
]

# (NMT command, the host's frame to node 1, the state that the node's heartbeat tells afterwards).
NMT = [
    ("NMT_START", "01 01", 0x05),
    (None, "02 01", 0x04),
    ("NMT_ENTER_PRE_OPERATIONAL", "80 01", 0x7F),
    (None, "01 00", 0x05),
    # Another node is meant.
    (None, "01 02", 0x7F),
    # Reset of the node and of its communication: 00 is the boot-up, and the heartbeat is off again.
    (None, "81 01", 0x00),
    (None, "82 01", 0x00),
]

# (what the host writes to an adapter whose channel is closed, all that comes back).
SLCAN_COMMANDS = [
    (b"\r", b"\r"),
    *[(b"S%d\r" % number, b"\r") for number in range(9)],
    (b"S9\r", b"\a"),
    (b"O\r", b"\a"),  # no bit rate yet
    (b"C\r", b"\a"),  # not open
    (b"S8\rO\r", b"\r\r"),
    (b"S8\rL\r", b"\r\r"),
    (b"S8\rO\rO\r", b"\r\r\a"),
    (b"S8\rO\rS6\r", b"\r\r\a"),
    (b"S8\rO\rC\r", b"\r\r\r"),
    (b"s031C\r", b"\r"),
    (b"V\r", b"V1013\r"),
    (b"N\r", b"NML01\r"),
    (b"Z0\r", b"\r"),
    (b"Z1\r", b"\r"),
    (b"M00000000\r", b"\r"),
    (b"mFFFFFFFF\r", b"\r"),
    (b"F\r", b"\a"),  # not open
    (b"S8\rO\rF\r", b"\r\rF00\r"),
    (b"t1002AABB\r", b"\a"),  # not open
    (b"S8\rO\rt1002AABB\r", b"\r\rz\r"),
    (b"S8\rO\rT000001002AABB\r", b"\r\rZ\r"),
    (b"S8\rO\rr1002\r", b"\r\rz\r"),
    (b"S8\rO\rR000001002\r", b"\r\rZ\r"),
    (b"S8\rO\rt1003AABB\r", b"\r\r\a"),
    (b"S8\rL\rt1002AABB\r", b"\r\r\a"),  # listening only
    (b"Q\r", b"\a"),
]

# (bit rate in bit/s, the command that sets it).
BIT_RATES = [
    (10_000, b"S0\r"),
    (20_000, b"S1\r"),
    (50_000, b"S2\r"),
    (100_000, b"S3\r"),
    (125_000, b"S4\r"),
    (250_000, b"S5\r"),
    (500_000, b"S6\r"),
    (800_000, b"S7\r"),
    (1_000_000, b"S8\r"),
]

# (what an adapter with an open channel says, what a host takes it for: a frame, None for nothing to be told, or a word
# of the complaint).
SLCAN_ANSWERS = [
    (b"\r", None),
    (b"z\r", None),
    (b"Z\r", None),
    (b"\a", "BEL"),
    (b"F00\r", None),
    (b"F01\r", "receive queue full"),
    (b"F02\r", "transmit queue full"),
    (b"F04\r", "error warning"),
    (b"F08\r", "data overrun"),
    (b"F20\r", "error passive"),
    (b"F40\r", None),  # arbitration lost
    (b"F80\r", "bus error"),
    (b"r1002\r", None),
    (b"R000001002\r", None),
    (b"t1002AABB\r", (0x100, False, "AABB")),
    (b"t1002AABB1234\r", (0x100, False, "AABB")),  # with a time stamp
    (b"T000001002AABB\r", (0x100, True, "AABB")),
    (b"T1FFFFFFF0\r", (0x1FFFFFFF, True, "")),
    (b"t1003AABB\r", "no CAN frame"),
    (b"t8000\r", "no CAN frame"),
]

# (identifier, data, the frame as a line on the serial side).
SLCAN_FRAMES = [
    (0x000, "8001", b"t00028001\r"),
    (0x080, "", b"t0800\r"),
    (0x201, "0F0030750000", b"t20160F0030750000\r"),
    (0x601, "4000100000000000", b"t60184000100000000000\r"),
    (0x77F, "05", b"t77F105\r"),
    (0x7FF, "1122334455667788", b"t7FF81122334455667788\r"),
]
