"""Topic and frame names, and the one table that says what each topic is (`TOPICS`; interfaces.md, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

LEFT_IMAGE = "/stereo/left/image_raw"
RIGHT_IMAGE = "/stereo/right/image_raw"
LEFT_COMPRESSED = LEFT_IMAGE + "/compressed"
RIGHT_COMPRESSED = RIGHT_IMAGE + "/compressed"
LEFT_CAMERA_INFO = "/stereo/left/camera_info"
RIGHT_CAMERA_INFO = "/stereo/right/camera_info"
STEREO_MARKERS = "/stereo/markers"
STEREO_MARKERS_RAW = "/stereo/markers/uncorrected"  # a recording's markers on their way to a measuring effect
STEREO_SURFACE = "/stereo/surface"  # points of the body's surface of which nobody knows which is which
STEREO_STATUS = "/stereo/status"
STEREO_REGISTRATION = "/stereo/registration"  # T_phantom_left and T_left_right, which the recorder writes to /tf_static
PROBE_POSE = "/probe/pose"
PROBE_WRENCH = "/probe/wrench"
FEM_SURFACE = "/fem/surface"
FEM_MARKERS = "/fem/markers"
FEM_LESIONS = "/fem/lesions"
FEM_MESH = "/fem/mesh"
FEM_WRENCH = "/fem/wrench"
FEM_STATUS = "/fem/status"
COMPARE_MARKERS = "/compare/markers"
COMPARE_RMSE = "/compare/rmse"
COMPARE_MEAN = "/compare/mean"
COMPARE_P95 = "/compare/p95"
COMPARE_MAX = "/compare/max"
COMPARE_METRICS = "/compare/metrics"
TF_STATIC = "/tf_static"
TF = "/tf"
SCENE_PROBE = "/scene/probe"  # for viewers: derived by the recorder from what passes by
SCENE_ERRORS = "/scene/errors"
SCENE_LEFT = "/scene/left"
SCENE_RIGHT = "/scene/right"
DIAGNOSTICS_ALL = "/diagnostics"  # the nodes' status, where ROS's tools look for it

IMAGES = (LEFT_IMAGE, RIGHT_IMAGE)
COMPRESSED_IMAGES = (LEFT_COMPRESSED, RIGHT_COMPRESSED)
CAMERA_INFOS = (LEFT_CAMERA_INFO, RIGHT_CAMERA_INFO)

NUMBERS = (STEREO_MARKERS, STEREO_MARKERS_RAW, PROBE_POSE, PROBE_WRENCH, FEM_MARKERS, FEM_WRENCH, COMPARE_MARKERS)
LOADED = frozenset({*NUMBERS, *CAMERA_INFOS, TF_STATIC})
"""What a recording is loaded from: it is read without the pictures, the meshes and what is drawn."""

FRAME_PHANTOM = "phantom"
FRAME_PROBE = "probe"
FRAME_LEFT = "stereo_left_optical"
FRAME_RIGHT = "stereo_right_optical"

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
MARKER = "visualization_msgs/msg/Marker"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
IMAGE_MARKER = "visualization_msgs/msg/ImageMarker"
FLOAT64 = "std_msgs/msg/Float64"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

LATCHED_DEPTH = 10
"""How many messages of a latched topic a late subscriber gets: enough where a few together say everything, as
transforms."""


@dataclass(frozen=True)
class Topic:
    """One topic: its message ``type`` and who publishes it.

    ``latched`` topics are offered as transient local, so that a subscriber that comes late still hears the last
    messages. An ``input`` may come from outside the graph: a camera, a robot, another tracker or a recording.
    ``publisher`` is the node of the graph that publishes it, or the recorder; empty where only the outside does.
    """

    name: str
    type: str
    latched: bool = False
    input: bool = False
    publisher: str = ""


TOPICS = {
    topic.name: topic
    for topic in (
        Topic(LEFT_IMAGE, IMAGE, input=True),
        Topic(RIGHT_IMAGE, IMAGE, input=True),
        Topic(LEFT_COMPRESSED, COMPRESSED_IMAGE, input=True),
        Topic(RIGHT_COMPRESSED, COMPRESSED_IMAGE, input=True),
        # camera drivers send a calibration with every picture: it is a stream like the pictures, and not latched
        Topic(LEFT_CAMERA_INFO, CAMERA_INFO, input=True),
        Topic(RIGHT_CAMERA_INFO, CAMERA_INFO, input=True),
        Topic(PROBE_POSE, POSE_STAMPED, input=True),
        Topic(PROBE_WRENCH, WRENCH_STAMPED, input=True),
        Topic(STEREO_MARKERS, POINT_CLOUD, input=True, publisher="stereo_node"),
        Topic(STEREO_MARKERS_RAW, POINT_CLOUD, input=True, publisher="stereo_node"),
        Topic(STEREO_SURFACE, POINT_CLOUD, input=True),
        Topic(STEREO_STATUS, DIAGNOSTICS, publisher="stereo_node"),
        Topic(STEREO_REGISTRATION, TRANSFORM_STAMPED, latched=True, publisher="stereo_node"),
        Topic(FEM_SURFACE, POINT_CLOUD, publisher="fem_node"),
        Topic(FEM_MARKERS, POINT_CLOUD, publisher="fem_node"),
        Topic(FEM_LESIONS, MARKER_ARRAY, publisher="fem_node"),
        Topic(FEM_MESH, MARKER, latched=True, publisher="fem_node"),
        Topic(FEM_WRENCH, WRENCH_STAMPED, publisher="fem_node"),
        Topic(FEM_STATUS, DIAGNOSTICS, publisher="fem_node"),
        Topic(COMPARE_MARKERS, POINT_CLOUD, publisher="compare_node"),
        Topic(COMPARE_RMSE, FLOAT64, publisher="compare_node"),
        Topic(COMPARE_MEAN, FLOAT64, publisher="compare_node"),
        Topic(COMPARE_P95, FLOAT64, publisher="compare_node"),
        Topic(COMPARE_MAX, FLOAT64, publisher="compare_node"),
        Topic(COMPARE_METRICS, DIAGNOSTICS, publisher="compare_node"),
        Topic(TF_STATIC, TRANSFORMS, latched=True, publisher="recorder"),
        Topic(TF, TRANSFORMS, publisher="recorder"),
        Topic(SCENE_PROBE, MARKER, publisher="recorder"),
        Topic(SCENE_ERRORS, MARKER_ARRAY, publisher="recorder"),
        Topic(SCENE_LEFT, IMAGE_MARKER, publisher="recorder"),
        Topic(SCENE_RIGHT, IMAGE_MARKER, publisher="recorder"),
        Topic(DIAGNOSTICS_ALL, DIAGNOSTICS, publisher="recorder"),
    )
}
"""Every topic of the interface by name."""
