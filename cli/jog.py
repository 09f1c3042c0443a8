"""`mill jog`."""

import math

import click

from cli.options import BenchChoice, on_a_bench
from cli.rig import rig_for
from drivers.errors import NotHomedError


@click.command()
@on_a_bench
@click.option("--home", "home_first", is_flag=True, help="Home first; a position is trusted only after homing.")
@click.option("--to", "target_mm", type=float, nargs=3, metavar="X Y Z", help="Go to this place in {R}, in mm.")
@click.option(
    "--by", "step_mm", type=float, nargs=3, metavar="DX DY DZ", help="Go this far from where the tip is, in mm."
)
@click.option("--feed", "feed_mm_s", type=click.FloatRange(0.1, 20.0), default=2.0, show_default=True, help="mm/s")
def jog(
    chosen: BenchChoice,
    home_first: bool,
    target_mm: tuple[float, float, float] | None,
    step_mm: tuple[float, float, float] | None,
    feed_mm_s: float,
) -> None:
    """Move the drill by hand, or home it; prints where the tip is. The spindle stays off."""
    if target_mm and step_mm:
        raise click.UsageError("--to and --by exclude each other; give one")
    with rig_for(chosen) as bench, bench.open_motion() as motion:
        if home_first:
            click.echo("homing", err=True)
            motion.home()
        here = motion.status().position_mm
        if step_mm:
            target_mm = (here[0] + step_mm[0], here[1] + step_mm[1], here[2] + step_mm[2])
        if target_mm:
            try:
                motion.start_move(target_mm, feed_mm_per_s=feed_mm_s)
            except NotHomedError as error:
                raise NotHomedError(f"{str(error).partition(';')[0]}; add --home to this command") from None
            click.echo(f"moving to {_place(target_mm)} at {feed_mm_s:g} mm/s", err=True)
            motion.wait_until_idle(timeout_s=10.0 + 2.0 * math.dist(here, target_mm) / feed_mm_s)
        status = motion.status()
        click.echo(f"{status.state.value}  tip in {{R}}: {_place(status.position_mm)}")


def _place(point_mm: tuple[float, float, float]) -> str:
    x, y, z = point_mm
    return f"x {x:.3f}  y {y:.3f}  z {z:.3f} mm"
