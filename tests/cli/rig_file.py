"""A rig file with nothing wrong in it."""

GOOD = """
schema = 1
name = "bench"
[motion]
backend = "grbl"
port = "/dev/mill-motion"
origin_mm = [-25.0, -10.0, -20.0]
[motion.settings]
"$100" = 1000.0
[spindle]
backend = "cia402"
channel = "/dev/mill-spindle"
[camera]
left = "/dev/mill-left"
right = "/dev/mill-right"
exposure = 150
"""
