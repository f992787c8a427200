"""livedeform play."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def play(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="A .mcap file or a rosbag2 folder.")],
    rate: Annotated[float, typer.Option(help="Times the recorded speed.", min=0.001)] = 1.0,
    topics: Annotated[
        str | None, typer.Option(help="Topics to play, separated by commas; what a camera, tracker or robot sent.")
    ] = None,
    now: Annotated[bool, typer.Option("--now", help="Move the stamps: the recording happens as it is played.")] = False,
    wait: Annotated[float, typer.Option(help="Seconds to wait for somebody who listens.", min=0.0)] = 10.0,
    start: Annotated[float, typer.Option(help="Seconds into the recording.", min=0.0)] = 0.0,
    duration: Annotated[float | None, typer.Option(help="Seconds to play.", min=0.0)] = None,
) -> None:
    """Play a recording onto live topics, as 'ros2 bag play' does, without ROS's own tools.

    ROS_DOMAIN_ID works as for any ROS node.

    Examples:

    livedeform play recording.mcap            (in one terminal; in another: livedeform live phantom --out out/live)

    livedeform play out/run/run.mcap --topics /compare/markers,/fem/mesh --rate 0.5
    """
    from livedeform.progress import Progress
    from livedeform.run.playing import PlayOptions
    from livedeform.run.playing import play as play_bag

    names = tuple(name.strip() for name in topics.split(",") if name.strip()) if topics else None
    with Progress() as progress:
        sent = play_bag(bag, PlayOptions(rate, names, now, wait, start, duration), progress)
    for topic, n in sorted(sent.items()):
        typer.echo(f"{n:7d}  {topic}")
