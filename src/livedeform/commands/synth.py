"""livedeform synth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def synth(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A name, a YAML file, or an earlier result's folder.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the experiment, its recordings and the truth.")],
    seed: Annotated[int, typer.Option(help="Of every random number.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace what is in --out.")] = False,
) -> None:
    """Makes a synthetic experiment with recordings, by another element on a finer mesh than the model's.

    Examples:

    livedeform synth gelatin_cuboid --out out/synthetic --seed 3

    livedeform synth list --out .   (names the scenarios)

    livedeform synth bags/breast_phantom --out out/repainted   (an earlier result with new pictures; solves nothing)
    """
    from livedeform import outputs
    from livedeform.fem_node.mesh.generate import mesh_to_file
    from livedeform.progress import Progress
    from livedeform.synthetic import scenario as scenarios
    from livedeform.synthetic.repaint import can_repaint, repaint

    if scenario == "list":
        for name in scenarios.shipped():
            typer.echo(name)
        return
    writes, source = ("experiment", "bags", "truth"), Path(scenario) if Path(scenario).exists() else None
    with outputs.prepared(out, writes, force=force, inputs=[source]) as draft, Progress() as progress:
        if can_repaint(Path(scenario)):
            repaint(Path(scenario), draft, seed, progress)
        else:
            scenarios.make(scenario, draft, seed, progress, mesher=mesh_to_file)
        outputs.write_configuration(draft, outputs.configuration("synth", {"scenario": scenario}, seed=seed))
    typer.echo(f"experiment: {out / 'experiment'}")
