"""The simulated recording is exact: pixels, depth, poses and the bag agree with hand-computed and brute-force values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import inverse, rotation_from_quaternion
from thegra_core.simulation.bag_writer import CAMERA_TOPIC, IMAGE_TOPIC, TRUTH_TOPIC, write_bag
from thegra_core.simulation.demo import START_NS, make_demo_bag, thermal_camera
from thegra_core.simulation.paths import PATHS, ROOM_PATH, look_at
from thegra_core.simulation.renderer import pixel_rays, render
from thegra_core.simulation.scene import SCENES, Face, Scene, Texture, room

PINHOLE = CameraModel(np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (101, 81))
X, Y, Z = np.eye(3)


def flat(level: float, size: tuple[float, float]) -> Texture:
    return Texture(np.full((int(size[1] * 10) + 2, int(size[0] * 10) + 2), level), per_m=10.0)


def wall(z: float, level: float, half: float = 5.0) -> Face:
    return Face(np.array([-half, -half, z]), X, Y, (2 * half, 2 * half), flat(level, (2 * half, 2 * half)))


def nearest_hits(scene: Scene, directions: np.ndarray, world_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and counts of rays (N, 3), one linear solve a ray and face: origin + a u + b v = center + z ray."""
    depth, counts = np.full(len(directions), np.inf), np.full(len(directions), scene.background)
    center = world_from_camera[:3, 3]
    for i, ray in enumerate(directions @ world_from_camera[:3, :3].T):
        for face in scene.faces:
            a, b, z = np.linalg.solve(np.stack([face.u, face.v, -ray], axis=1), center - face.origin)
            if 0 <= a <= face.size[0] and 0 <= b <= face.size[1] and 1e-6 < z < depth[i]:
                depth[i] = z
                counts[i] = face.texture.sample(np.array([a]), np.array([b]))[0]
    return depth, counts


def test_point_appears_at_its_hand_computed_pixel() -> None:
    per_m, spot = 100.0, (1.2, 0.9)  # the world point (0.2, -0.1, 2): pixel (50 + 100 * 0.1, 40 - 100 * 0.05)
    v, u = np.mgrid[0:202, 0:202] / per_m
    texture = Texture(1000 + 5000 * np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / (2 * 0.03**2)), per_m)
    scene = Scene((Face(np.array([-1.0, -1.0, 2.0]), X, Y, (2.0, 2.0), texture),))
    image = render(scene, pixel_rays(PINHOLE), np.eye(4)).image.astype(float) - 1000
    rows, columns = np.mgrid[25:46, 50:71]
    weights = image[25:46, 50:71]
    assert np.unravel_index(np.argmax(image), image.shape) == (35, 60)
    assert (weights * columns).sum() / weights.sum() == pytest.approx(60, abs=0.01)
    assert (weights * rows).sum() / weights.sum() == pytest.approx(35, abs=0.01)


def test_depth_of_a_frontal_and_of_a_slanted_plane() -> None:
    rays = pixel_rays(PINHOLE)
    assert np.allclose(render(Scene((wall(2.0, 7000),)), rays, np.eye(4)).depth, 2.0, atol=1e-12)
    slanted = Face(np.array([2.0, -5.0, 0.0]) - 8 * (X - Z) / np.sqrt(2), (X - Z) / np.sqrt(2), Y, (16.0, 10.0), flat(7000, (16, 10)))
    depth = render(Scene((slanted,)), rays, np.eye(4)).depth  # the plane x + z = 2, so z (1 + x/z) = 2
    assert np.allclose(depth, 2 / (1 + rays[..., 0]), atol=1e-12)
    assert depth[40, 50] == pytest.approx(2.0) and depth[40, 100] == pytest.approx(2 / 1.5)


def test_near_faces_hide_far_ones_whatever_their_order() -> None:
    rays, near, far = pixel_rays(PINHOLE), wall(2.0, 7500, half=0.2), wall(4.0, 6500)
    for faces in ((near, far), (far, near)):
        rendering = render(Scene(faces), rays, np.eye(4))
        assert rendering.image[40, 50] == 7500 and rendering.depth[40, 50] == 2.0
        assert rendering.image[40, 61] == 6500 and rendering.depth[40, 61] == 4.0  # x = 0.22 at z = 2: past the near wall
        assert np.count_nonzero(rendering.image == 7500) == 21 * 21


def test_what_is_behind_the_camera_is_not_seen() -> None:
    rendering = render(Scene((wall(-2.0, 7500),), background=6000), pixel_rays(PINHOLE), np.eye(4))
    assert np.all(rendering.image == 6000) and np.all(np.isinf(rendering.depth))


@pytest.mark.parametrize("name", sorted(SCENES))
@pytest.mark.parametrize("t_s", [0.0, 3.7, 8.2])
def test_rendering_equals_brute_force_through_a_distorted_lens(name: str, t_s: float) -> None:
    camera, scene, pose = thermal_camera((80, 64)), SCENES[name](3), PATHS[name].world_from_camera(t_s)
    rays = pixel_rays(camera)
    rendering = render(scene, rays, pose)
    pixels = np.random.default_rng(0).choice(80 * 64, 150, replace=False)
    depth, counts = nearest_hits(scene, rays.reshape(-1, 3)[pixels], pose)
    assert np.allclose(rendering.depth.ravel()[pixels], depth, rtol=1e-9)
    assert np.abs(rendering.image.ravel()[pixels] - counts).max() <= 0.5 + 1e-6


def test_pixels_and_depth_give_points_that_project_back() -> None:
    camera = thermal_camera((80, 64))
    pose0, pose1 = ROOM_PATH.world_from_camera(1.0), ROOM_PATH.world_from_camera(1.4)
    scene, rays = room(1), pixel_rays(camera)
    first, second = render(scene, rays, pose0), render(scene, rays, pose1)
    points_camera = (rays * first.depth[..., None]).reshape(-1, 3)
    x, y = np.meshgrid(np.arange(80), np.arange(64))
    assert np.allclose(camera.project(points_camera), np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-6)

    points_second = np.c_[points_camera, np.ones(len(points_camera))] @ (inverse(pose1) @ pose0)[:3].T
    pixels = camera.project(points_second)
    inside = camera.contains(pixels)
    nearest = np.rint(pixels[inside]).astype(int)
    seen = second.depth[nearest[:, 1], nearest[:, 0]]
    error = np.abs(seen - points_second[inside, 2]) / seen
    assert inside.mean() > 0.7 and np.mean(error < 0.03) > 0.9  # the rest is hidden, or beside a depth edge


def test_levels_are_those_of_a_thermal_camera() -> None:
    image = render(room(), pixel_rays(thermal_camera()), ROOM_PATH.world_from_camera(0)).image
    assert image.dtype == np.uint16 and image.shape == (256, 320)
    assert 6900 < image.mean() < 7150 and 150 < image.std() < 400


def test_same_seed_same_picture() -> None:
    rays, pose = pixel_rays(thermal_camera((80, 64))), ROOM_PATH.world_from_camera(2.0)
    images = [render(room(seed), rays, pose, 3.0, np.random.default_rng(seed)).image for seed in (5, 5, 6)]
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[0], images[2])


def test_noise_has_the_strength_asked_for_and_needs_a_generator() -> None:
    rays, scene = pixel_rays(thermal_camera((160, 128))), Scene((wall(2.0, 7000, half=50.0),))
    assert render(scene, rays, np.eye(4), 5.0, np.random.default_rng(0)).image.std() == pytest.approx(5.0, rel=0.02)
    with pytest.raises(ValueError, match="rng="):
        render(scene, rays, np.eye(4), 5.0)


def test_look_at_is_upright_then_rolled() -> None:
    pose = look_at([1, 2, 3], [5, 2, 3])  # along +x with z up: right is -y, down is -z
    assert np.allclose(pose[:3, :3], np.stack([-Y, -Z, X], axis=1)) and np.allclose(pose[:3, 3], [1, 2, 3])
    assert np.allclose(look_at([1, 2, 3], [5, 2, 3], np.pi / 2)[:3, 0], -Z)
    with pytest.raises(ValueError, match="straight up or down"):
        look_at([0, 0, 0], [0, 0, 2])


@pytest.mark.parametrize("name", sorted(PATHS))
def test_paths_are_smooth_rigid_motions(name: str) -> None:
    poses = np.stack([PATHS[name].world_from_camera(t) for t in np.arange(0, 20, 0.02)])
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3)) and np.allclose(np.linalg.det(rotations), 1)
    velocity = np.diff(poses[:, :3], axis=0) / 0.02
    assert np.abs(velocity).max() < 1.5 and np.abs(np.diff(velocity, axis=0)).max() < 0.05  # no steps in position or speed
    assert np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)) > 1.0


def test_bag_holds_what_was_rendered(tmp_path: Path) -> None:
    camera = thermal_camera((80, 64))
    poses = [ROOM_PATH.world_from_camera(t) for t in (0.0, 0.5, 1.0)]
    stamps = [START_NS + 7, START_NS + 500_000_007, START_NS + 1_000_000_007]
    images = [render(room(), pixel_rays(camera), pose).image for pose in poses]
    folder = write_bag(tmp_path / "new" / "bag", camera, zip(stamps, images, poses, strict=True))

    types, read = get_typestore(Stores.ROS2_JAZZY), {IMAGE_TOPIC: [], CAMERA_TOPIC: [], TRUTH_TOPIC: []}
    with Reader(folder) as bag:
        for connection, received_ns, data in bag.messages():
            message = types.deserialize_cdr(data, connection.msgtype)
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert received_ns > stamp_ns
            read[connection.topic].append((stamp_ns, message))
    assert all([stamp for stamp, _ in messages] == stamps for messages in read.values())
    for (_, message), image in zip(read[IMAGE_TOPIC], images, strict=True):
        assert (message.width, message.height, message.encoding, message.step, message.is_bigendian) == (80, 64, "mono16", 160, 0)
        assert np.array_equal(message.data.view("<u2").reshape(64, 80), image)
    info = read[CAMERA_TOPIC][0][1]
    assert (info.width, info.height, info.distortion_model) == (80, 64, "plumb_bob")
    assert np.array_equal(info.k.reshape(3, 3), camera.matrix) and np.array_equal(info.d, camera.distortion)
    for (_, message), pose in zip(read[TRUTH_TOPIC], poses, strict=True):
        position, q = message.pose.pose.position, message.pose.pose.orientation
        assert np.allclose([position.x, position.y, position.z], pose[:3, 3])
        assert np.allclose(rotation_from_quaternion([q.x, q.y, q.z, q.w]), pose[:3, :3])
    rows = np.loadtxt(folder / "groundtruth.txt")
    assert (folder / "groundtruth.txt").read_text().splitlines()[2].split()[0] == "1700000000.500000007"
    assert np.allclose(rows[:, 1:4], np.stack(poses)[:, :3, 3], atol=1e-8)
    assert np.allclose([rotation_from_quaternion(q) for q in rows[:, 4:]], np.stack(poses)[:, :3, :3], atol=1e-8)


def test_camera_file_holds_the_camera(tmp_path: Path) -> None:
    camera = thermal_camera((80, 64))
    folder = write_bag(tmp_path / "bag", camera, [(START_NS, np.zeros((64, 80), np.uint16), np.eye(4))])
    values = yaml.safe_load((folder / "camera.yaml").read_text())
    assert (values["image_width"], values["image_height"], values["distortion_model"]) == (80, 64, "plumb_bob")
    assert values["camera_matrix"]["data"] == camera.matrix.ravel().tolist()
    assert values["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": camera.distortion.tolist()}


def test_demo_bag_has_the_rate_asked_for_and_is_not_overwritten(tmp_path: Path) -> None:
    folder = make_demo_bag(tmp_path / "demo", duration_s=0.5, rate_hz=10, image_size=(64, 48))
    stamps = [line.split()[0] for line in (folder / "groundtruth.txt").read_text().splitlines()[1:]]
    assert stamps == [f"1700000000.{tenth}00000000" for tenth in range(5)]
    with pytest.raises(InputError, match="exists already"):
        make_demo_bag(folder)
