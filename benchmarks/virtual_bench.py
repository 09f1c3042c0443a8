"""How fast the virtual bench is: seconds of its clock for one second of a core, stage by stage.

    python -m benchmarks.virtual_bench

The measuring is in ``studies.bench_speed``, for only studies know that a device can be emulated.
"""

from studies.bench_speed import main

if __name__ == "__main__":
    main()
