"""The three nodes: ros2 launch livedeform livedeform.launch.py experiment:=/path/to/experiment"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(__file__).resolve().parents[1] / "config" / "nodes.yaml"


def generate_launch_description() -> LaunchDescription:
    """stereo_node, fem_node and compare_node; the argument ``experiment`` takes the parameter file's place."""
    nodes = [
        Node(
            package="livedeform",
            executable=name,
            parameters=[LaunchConfiguration("parameters"), {"experiment": LaunchConfiguration("experiment")}],
            output="screen",
        )
        for name in ("stereo_node", "fem_node", "compare_node")
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("experiment", description="folder with experiment.yaml"),
            DeclareLaunchArgument("parameters", default_value=str(PARAMETERS), description="ROS parameter file"),
            *nodes,
        ]
    )
