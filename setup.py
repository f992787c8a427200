"""The few words that colcon needs in setup.py; everything else is in pyproject.toml."""

from setuptools import setup

setup(
    python_requires=">=3.11,<3.15",
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/livedeform"]),
        ("share/livedeform", ["package.xml"]),
    ],
)
