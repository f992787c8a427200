"""livedeform parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.common.errors import InputError


def parameters(
    experiment: Annotated[
        str, typer.Argument(metavar="EXPERIMENT", help="What the nodes get as their parameter 'experiment'.")
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False,
) -> None:
    """Writes the ROS parameter file of the three nodes, with every default.

    Example: livedeform parameters phantom --out nodes.yaml; fem_node --ros-args --params-file nodes.yaml
    """
    import yaml

    from livedeform.common.ros.session import parameters_yaml
    from livedeform.compare_node.node import CompareParameters
    from livedeform.fem_node.parameters import Parameters as FemParameters
    from livedeform.outputs import refuse_inputs, write_text
    from livedeform.stereo_node.parameters import StereoParameters

    refuse_inputs([out], [Path(experiment)])
    if out.exists() and not force:
        raise InputError("exists already", where=str(out), remedy="choose another name, or add --force")
    document = {
        **parameters_yaml("stereo_node", StereoParameters(experiment=experiment)),
        **parameters_yaml("fem_node", FemParameters(experiment=experiment)),
        **parameters_yaml("compare_node", CompareParameters(experiment=experiment)),
    }
    text = f"# written by: livedeform parameters {experiment}\n"
    write_text(out, text + yaml.safe_dump(document, sort_keys=False))
