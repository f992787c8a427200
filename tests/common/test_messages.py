"""Types to ROS messages and back, in the published layouts; the same bytes with and without ROS."""

from dataclasses import replace

import numpy as np
import other_side
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, PointCloud2
from visualization_msgs.msg import Marker

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.schema import Lesion
from livedeform.common.ros import messages as m
from livedeform.common.types import CameraCalibration, Image, MarkerFrame, Pose, Prediction, Wrench

NS = 1_700_000_000_123_456_789


@pytest.fixture
def markers(rng):
    A = rng.normal(size=(5, 3, 3)) * 1e-5
    return MarkerFrame(NS, np.arange(5, dtype=np.uint32), rng.normal(size=(5, 3)), A @ A.swapaxes(1, 2), rng.random(5))


@pytest.fixture
def prediction(rng):
    surface = rng.normal(size=(4, 3))
    return Prediction(
        stamp_ns=NS,
        ids=np.array([3, 1], np.uint32),
        markers=rng.normal(size=(2, 3)),
        surface=surface,
        surface_nodes=np.array([0, 2, 5, 9], np.uint32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]]),
        lesions=rng.normal(size=(1, 3)),
        force=np.array([0.0, 0.0, -1.0]),
        torque=np.zeros(3),
        converged=True,
    )


def names_and_types(cloud: PointCloud2) -> list[tuple[str, int]]:
    return [(field.name, field.datatype) for field in cloud.fields]


def test_layouts_are_the_published_ones(markers, prediction):
    f4, u4 = 7, 6
    covariance = [(f"cov_{axes}", f4) for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
    xyz = [("x", f4), ("y", f4), ("z", f4)]
    assert names_and_types(m.to_marker_cloud(markers)) == [*xyz, ("id", u4), *covariance, ("reprojection_error", f4)]
    assert names_and_types(m.to_predicted_surface(prediction)) == [*xyz, ("node", u4)]
    assert names_and_types(m.to_predicted_markers(prediction)) == [*xyz, ("id", u4)]
    compare = m.to_compare_cloud(NS, prediction.ids, prediction.markers, prediction.markers)
    assert names_and_types(compare) == [*xyz, ("ex", f4), ("ey", f4), ("ez", f4), ("error", f4), ("id", u4)]
    assert compare.header.frame_id == "phantom"


def test_markers_come_back(markers):
    message = deserialize_message(serialize_message(m.to_marker_cloud(markers)), PointCloud2)
    back = m.from_marker_cloud(message)
    assert back.stamp_ns == NS
    np.testing.assert_array_equal(back.ids, markers.ids)
    np.testing.assert_allclose(back.points, markers.points, rtol=1e-6)
    np.testing.assert_allclose(back.covariances, markers.covariances, rtol=1e-5, atol=1e-16)
    np.testing.assert_allclose(back.reprojection_error_px, markers.reprojection_error_px, rtol=1e-6)


def test_another_trackers_cloud_is_read(rng):
    """Doubles, another order, padding, rows of an organised cloud, no covariance."""
    formats = {"names": ["id", "z", "y", "x"], "formats": ["<i2", "<f8", "<f8", "<f8"], "offsets": [0, 8, 16, 24]}
    dtype = np.dtype({**formats, "itemsize": 40})
    rows = np.zeros(6, dtype)
    rows["x"], rows["y"], rows["z"], rows["id"] = *rng.normal(size=(3, 6)), np.arange(6)
    cloud = m.to_cloud(NS, rows)
    cloud.height, cloud.width, cloud.row_step = 2, 3, 3 * 40
    back = m.from_marker_cloud(cloud)
    np.testing.assert_array_equal(back.points[:, 2], rows["z"])
    assert back.ids.tolist() == list(range(6))
    assert np.isnan(back.covariances).all() and np.isnan(back.reprojection_error_px).all()


def test_a_cloud_that_is_too_short(markers):
    cloud = m.to_marker_cloud(markers)
    cloud.width = 50
    with pytest.raises(RecordingError, match="announces 50 points, but holds 5"):
        m.from_marker_cloud(cloud)


def test_messages_are_the_same_with_and_without_ros(tmp_path, markers, rng):
    """Not compared byte by byte: rclpy leaves whatever was in memory in the padding between fields."""
    pose = Pose(NS, rng.normal(size=3), np.array([0.0, 0.6, 0.0, 0.8]))
    image = Image(NS, rng.integers(0, 255, (8, 9), dtype=np.uint8), "mono8", t.FRAME_LEFT)
    with BagWriter(tmp_path / "x.mcap") as bag:
        writer = RecordingWriter(bag)
        writer.marker_frame(markers)
        writer.pose(pose)
        writer.image(image, t.LEFT_IMAGE)
    with read_bag(tmp_path / "x.mcap") as bag:
        written = {raw.topic: bytes(raw.data) for raw in bag.messages()}
    for topic, message in (
        (t.STEREO_MARKERS, m.to_marker_cloud(markers)),
        (t.PROBE_POSE, other_side.to_pose_stamped(pose)),
        (t.LEFT_IMAGE, m.to_image(image)),
    ):
        assert deserialize_message(written[topic], type(message)) == message
        assert len(written[topic]) == len(serialize_message(message))


def test_poses_and_wrenches_come_back(rng):
    pose = Pose(NS, rng.normal(size=3), np.array([0.0, 0.6, 0.0, 0.8]))
    back = m.from_pose_stamped(other_side.to_pose_stamped(pose))
    assert back.stamp_ns == NS
    np.testing.assert_array_equal(back.position, pose.position)
    np.testing.assert_allclose(back.orientation_xyzw, pose.orientation_xyzw, rtol=1e-15)
    message = other_side.to_pose_stamped(Pose(NS, np.zeros(3), np.zeros(4)))
    with pytest.raises(RecordingError, match="quaternion zero"):
        m.from_pose_stamped(message)
    wrench = Wrench(NS, rng.normal(size=3), rng.normal(size=3))
    np.testing.assert_array_equal(other_side.from_wrench(m.to_wrench(wrench)).torque, wrench.torque)


def test_numpy_scalars_become_floats():
    """ROS_PYTHON_CHECK_FIELDS makes rclpy look; without it an np.float32 is serialised to garbage."""
    other_side.to_pose_stamped(Pose(np.int64(5), np.ones(3, np.float32), np.array([0, 0, 0, 1], np.float32)))
    assert m.to_float64(np.float32(0.5)).data == 0.5


@pytest.mark.parametrize("encoding", ["mono8", "bgr8", "rgb8"])
def test_pictures_come_back(rng, encoding):
    shape = (9, 11) if encoding == "mono8" else (9, 11, 3)
    image = Image(NS, rng.integers(0, 255, shape, dtype=np.uint8), encoding, t.FRAME_LEFT)
    raw = m.from_image(m.to_image(image))
    np.testing.assert_array_equal(raw.pixels, image.pixels)
    assert (raw.stamp_ns, raw.encoding, raw.frame_id) == (NS, encoding, t.FRAME_LEFT)
    packed = m.from_image(other_side.to_compressed_image(image, "png"))
    np.testing.assert_array_equal(packed.pixels, image.pixels[..., ::-1] if encoding == "bgr8" else image.pixels)


def test_jpeg_is_read(rng):
    pixels = np.full((32, 32), 90, np.uint8)
    pixels[8:24, 8:24] = 180
    back = m.from_image(other_side.to_compressed_image(Image(NS, pixels), "jpeg"))
    assert np.abs(back.pixels.astype(int) - pixels).max() <= 12


def test_padded_rows_and_wide_pixels_are_read():
    from array import array

    image = m.to_image(Image(NS, np.arange(12, dtype=np.uint8).reshape(3, 4)))
    rows = np.zeros((3, 6), np.uint8)
    rows[:, :4] = np.arange(12).reshape(3, 4)
    image.step, image.data = 6, array("B", rows.tobytes())
    np.testing.assert_array_equal(m.from_image(image).pixels, np.arange(12).reshape(3, 4))
    image.encoding, image.step, image.data = "mono16", 8, array("B", (np.arange(12, dtype="<u2") * 256).tobytes())
    np.testing.assert_array_equal(m.from_image(image).pixels, np.arange(12).reshape(3, 4))


def test_camera_info_comes_back(rng):
    camera = CameraCalibration(
        "left", 640, 480, rng.random((3, 3)), rng.random(5), rng.random((3, 3)), rng.random((3, 4))
    )
    message = deserialize_message(serialize_message(other_side.to_camera_info(camera, NS, t.FRAME_LEFT)), CameraInfo)
    back = m.from_camera_info(message, "left")
    for name in ("camera_matrix", "dist_coeffs", "rectification", "projection"):
        np.testing.assert_array_equal(getattr(back, name), getattr(camera, name))
    assert (back.width, back.height, back.name) == (640, 480, "left")


def test_predictions_come_back(prediction):
    back = m.from_predicted_markers(m.to_predicted_markers(prediction))
    stamp, ids, points = back.stamp_ns, back.ids, back.points
    assert stamp == NS and ids.tolist() == [3, 1]
    np.testing.assert_allclose(points, prediction.markers, rtol=1e-6)
    _, nodes, surface = other_side.from_predicted_surface(m.to_predicted_surface(prediction))
    assert nodes.tolist() == [0, 2, 5, 9]
    np.testing.assert_allclose(surface, prediction.surface, rtol=1e-6)
    names, centres, diameters = other_side.from_lesions(
        m.to_lesions(prediction, [Lesion(name="t1", centre=(0, 0, 0), diameter=0.02)])
    )
    assert names == ["t1"] and diameters.tolist() == [0.02]
    np.testing.assert_array_equal(centres, prediction.lesions)


def test_a_mesh_that_is_written_at_once_is_the_message_that_ros_writes(prediction):
    mesh = deserialize_message(m.to_mesh_data(prediction), Marker)
    assert mesh.type == Marker.TRIANGLE_LIST and mesh.header.frame_id == t.FRAME_PHANTOM
    assert len(mesh.points) == 6 and mesh.points[4].x == prediction.surface[2, 0]
    assert mesh.text == mesh.mesh_resource == "" and not mesh.colors
    assert len(m.to_mesh_data(prediction)) == len(serialize_message(mesh))  # what pads the fields may differ
    corners, triangles = m.from_mesh_marker(mesh)
    np.testing.assert_array_equal(corners[triangles], prediction.surface[prediction.triangles])
    for name in ("f", "ns1", "fem surface"):  # strings before the points move them
        mesh.ns = name
        mesh.points = mesh.points[:3]
        again = deserialize_message(m._with_points(mesh, prediction.surface[:2]), Marker)
        assert again.ns == name and [p.x for p in again.points] == prediction.surface[:2, 0].tolist()
    gone = deserialize_message(m.to_mesh_data(replace(prediction, converged=False)), Marker)
    assert gone.action == Marker.DELETE and not gone.points


def test_errors_come_back(tmp_path, prediction):
    errors = np.array([[3e-3, 4e-3, 0.0], [0.0, 0.0, 1e-3]])
    message = m.to_compare_cloud(NS, prediction.ids, prediction.markers, errors)
    _, ids, measured, back = other_side.from_compare_cloud(message)
    assert ids.tolist() == [3, 1]
    np.testing.assert_allclose(measured, prediction.markers, rtol=1e-6)
    np.testing.assert_allclose(back, errors, rtol=1e-6)
    with BagWriter(tmp_path / "x.mcap") as bag:
        bag.write(t.COMPARE_MARKERS, "sensor_msgs/msg/PointCloud2", NS, bytes(serialize_message(message)))
        bag.write(t.FEM_MARKERS, "sensor_msgs/msg/PointCloud2", NS,
                  bytes(serialize_message(m.to_predicted_markers(prediction))))  # fmt: skip
    recording = load_recording(tmp_path / "x.mcap")
    np.testing.assert_allclose(recording.errors[0].errors, errors, rtol=1e-6)
    np.testing.assert_allclose(recording.predictions[0].points, prediction.markers, rtol=1e-6)


def test_diagnostics_come_back():
    message = m.to_diagnostics(NS, "compare_node", "WARN", "late", {"rmse": 0.1 + 0.2, "n": 5})
    assert other_side.from_diagnostics(message) == (NS, "WARN", "late", {"rmse": "0.30000000000000004", "n": "5"})
