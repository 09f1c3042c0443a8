"""A stage and a drill of an invented make: what a package looks like that adds devices to mill.

The wire. A line from the host gets one line back: ``ok``, ``no REASON``, or what was asked for. The bytes 01 (hold),
02 (go on) and 03 (stop) act at once, wherever they stand, and get nothing back.

    stage   who, travel, home, go X Y Z F (mm, mm/s), where, drop, floor Z
    drill   who, spin RPM, say
"""
