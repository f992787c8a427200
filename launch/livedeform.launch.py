"""The three nodes: ros2 launch livedeform livedeform.launch.py experiment:=/path/to/experiment

Arguments: ``experiment``; ``parameters``, a ROS parameter file; ``expected``, a recording of poses along which the live
model is prepared; ``nodes``, which of stereo_node, fem_node and compare_node to start (another tracker needs no
stereo_node); ``namespace`` of the nodes.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node

NODES = ("stereo_node", "fem_node", "compare_node")
PARAMETERS = Path(__file__).resolve().parents[1] / "config" / "nodes.yaml"


def generate_launch_description() -> LaunchDescription:
    """stereo_node, fem_node and compare_node; the argument ``experiment`` takes the parameter file's place."""
    own = {"fem_node": {"expected": LaunchConfiguration("expected")}}
    nodes = [
        Node(
            package="livedeform",
            executable=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("parameters"),
                {"experiment": LaunchConfiguration("experiment")} | own.get(name, {}),
            ],
            condition=IfCondition(
                PythonExpression(["'", name, "' in '", LaunchConfiguration("nodes"), "'.split(',')"])
            ),
            output="screen",
        )
        for name in NODES
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("experiment", description="folder with experiment.yaml"),
            DeclareLaunchArgument("parameters", default_value=str(PARAMETERS), description="ROS parameter file"),
            DeclareLaunchArgument("expected", default_value="", description="recording of poses as they will come"),
            DeclareLaunchArgument("nodes", default_value=",".join(NODES), description="which nodes to start"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the nodes"),
            *nodes,
        ]
    )
