"""What is rendered is where geometry puts it and as warm as physics says: against values worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import inverse, transform
from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.cameras import thermal_camera
from thegra_core.simulation.exposure import Exposure, exposure_ages
from thegra_core.simulation.paths import STYLES, HandHeldPath, upright_rotations
from thegra_core.simulation.raycast import RayCaster
from thegra_core.simulation.renderer import Renderer, pixel_rays
from thegra_core.simulation.routes import Route, Way, rounded_rectangle
from thegra_core.simulation.scene import Sky, Surface
from thegra_core.simulation.scenes import SCENES
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.texture import BRICKS, noise3_many

PINHOLE = CameraModel(np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (101, 81))
AMBIENT = 290.0
BLACK = Surface(300.0, emissivity=1.0, noise_k=0.0)
LOOKING_ALONG_X = transform(upright_rotations(np.zeros(1), np.zeros(1), np.zeros(1))[0], np.zeros(3))


def scene(*pieces, sky: float = AMBIENT):
    """A scene of rectangles (corner, along_u, along_v, surface), camera frame as world: x right, y down, z forward."""
    b = SceneBuilder("test", 0)
    for piece in pieces:
        b.quad(*piece)
    return b.scene(Sky(sky, sky), AMBIENT)


def wall(z: float, surface: Surface = BLACK, half: float = 5.0):
    return [-half, -half, z], [2 * half, 0, 0], [0, 2 * half, 0], surface


def test_depth_of_a_frontal_and_of_a_slanted_plane() -> None:
    assert np.allclose(Renderer(scene(wall(2.0)), PINHOLE).render(np.eye(4)).depth, 2.0, rtol=1e-12)
    slope = np.array([1.0, 0.0, -1.0])  # the plane x + z = 2, so z (1 + x / z) = 2
    slanted = np.array([2.0, -5.0, 0.0]) - 8 * slope, 16 * slope, [0, 10, 0], BLACK
    depth = Renderer(scene(slanted), PINHOLE).render(np.eye(4)).depth
    assert np.allclose(depth, 2 / (1 + pixel_rays(PINHOLE)[..., 0]), rtol=1e-12)
    assert depth[40, 50] == pytest.approx(2.0) and depth[40, 100] == pytest.approx(2 / 1.5)


def test_near_surfaces_hide_far_ones_and_nothing_shows_the_sky() -> None:
    rendering = Renderer(scene(wall(4.0, half=1.0), wall(2.0, replace(BLACK, kelvin=310.0), half=0.2), sky=250.0), PINHOLE).render(np.eye(4))
    assert rendering.kelvin[40, 50] == pytest.approx(310) and rendering.depth[40, 50] == pytest.approx(2.0)
    assert rendering.kelvin[40, 65] == pytest.approx(300, abs=0.01) and rendering.depth[40, 65] == pytest.approx(4.0)
    assert rendering.kelvin[40, 90] == pytest.approx(250) and np.isinf(rendering.depth[40, 90])


def test_what_is_behind_the_camera_is_not_seen() -> None:
    assert np.all(np.isinf(Renderer(scene(wall(-2.0)), PINHOLE).render(np.eye(4)).depth))


def test_an_edge_through_the_middle_of_a_pixel_is_half_of_both() -> None:
    half = [0.0, -5, 2.0], [5, 0, 0], [0, 10, 0], replace(BLACK, kelvin=310.0)  # right of x = 0, which is column 50
    kelvin = Renderer(scene(wall(3.0), half), PINHOLE).render(np.eye(4)).kelvin
    assert kelvin[40, 49] == pytest.approx(300) and kelvin[40, 50] == pytest.approx(305) and kelvin[40, 51] == pytest.approx(310)


def test_a_dull_surface_mixes_its_own_radiance_with_that_of_the_surroundings() -> None:
    kelvin = Renderer(scene(wall(2.0, replace(BLACK, emissivity=0.6))), PINHOLE).render(np.eye(4)).kelvin
    assert kelvin[40, 50] == pytest.approx(0.6 * 300 + 0.4 * AMBIENT)
    assert kelvin[0, 0] < kelvin[40, 50], "emissivity falls where the surface is seen at an angle"


def test_a_mirror_shows_what_stands_before_it_where_reflection_puts_it() -> None:
    mirror = wall(2.0, replace(BLACK, emissivity=0.1, mirror=True))
    hot = [0.35, -0.05, -2.0], [0.1, 0, 0], [0, 0.1, 0], replace(BLACK, kelvin=330.0)  # behind the camera: its mirror image stands at z = 6, x = 0.4
    kelvin = Renderer(scene(mirror, hot), PINHOLE).render(np.eye(4)).kelvin
    rows, columns = np.nonzero(kelvin > 320)
    assert columns.mean() == pytest.approx(50 + 100 * 0.4 / 6, abs=0.6) and rows.mean() == pytest.approx(40, abs=0.6)
    assert kelvin[40, 57] == pytest.approx(0.1 * 300 + 0.9 * 330, abs=0.2)
    assert kelvin[40, 40] == pytest.approx(0.1 * 300 + 0.9 * AMBIENT, abs=0.2)


def test_every_view_of_a_point_shows_the_same_temperature() -> None:
    textured = Surface(AMBIENT, 0.99, noise_k=0.5, noise_m=1.0, octaves=3, spots_k=2.0, spots_m=1.0, spots_share=1.0, pattern=BRICKS, period_u=1.0, period_v=0.5, line_k=1.0, line_m=0.1, cell_k=1.0)
    renderer = Renderer(scene(wall(2.0, textured)), PINHOLE)
    turn = upright_rotations(np.array([0.1]), np.zeros(1), np.array([0.3]))[0] @ upright_rotations(np.zeros(1), np.zeros(1), np.zeros(1))[0].T
    moved = transform(turn, [0.3, -0.1, 0.4])
    first, second = renderer.render(np.eye(4)), renderer.render(moved)
    points = (pixel_rays(PINHOLE) * first.depth[..., None]).reshape(-1, 3)
    pixels = PINHOLE.project((points - moved[:3, 3]) @ moved[:3, :3])
    inside = PINHOLE.contains(pixels, border=1)
    x, y = pixels[inside].T
    c, r = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - c, y - r
    image = second.kelvin
    seen = (1 - fy) * ((1 - fx) * image[r, c] + fx * image[r, c + 1]) + fy * ((1 - fx) * image[r + 1, c] + fx * image[r + 1, c + 1])
    assert inside.mean() > 0.3 and first.kelvin.std() > 0.4
    assert np.median(np.abs(seen - first.kelvin.ravel()[inside])) < 0.02


def test_texture_fades_where_a_pixel_is_wider_than_it() -> None:
    fine = Surface(AMBIENT, 1.0, noise_k=1.0, noise_m=0.02, octaves=1)
    near, far = (Renderer(scene(wall(z, fine, half=50.0)), PINHOLE).render(np.eye(4)).kelvin.std() for z in (0.2, 20.0))
    assert near > 0.5 and far < 1e-3


def test_noise_has_the_strength_it_is_said_to_have() -> None:
    values = noise3_many(np.random.default_rng(0).uniform(0, 500, (20000, 3)), 3)
    assert abs(values.mean()) < 0.01 and values.std() == pytest.approx(0.28, abs=0.04)


def test_pixels_and_depth_of_a_distorted_view_project_back() -> None:
    camera, kind = thermal_camera((80, 64)), SCENES["room"]
    pose = HandHeldPath(kind.route(), STYLES["robust"], 5.0, 0).pose(1.0)
    depth = Renderer(kind.make(0), camera).render(pose).depth
    x, y = np.meshgrid(np.arange(80), np.arange(64))
    assert np.allclose(camera.project((pixel_rays(camera) * depth[..., None]).reshape(-1, 3)), np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-6)


def test_rays_beyond_the_lens_see_no_surface() -> None:
    turning_back = CameraModel(np.array([[30.0, 0, 50], [0, 30.0, 40], [0, 0, 1]]), np.array([-0.5, 0, 0, 0, 0]), DistortionModel.PLUMB_BOB, (101, 81))
    assert np.isnan(pixel_rays(turning_back)[0, 0]).any()
    rendering = Renderer(scene(wall(2.0)), turning_back).render(np.eye(4))
    assert np.isinf(rendering.depth[0, 0]) and rendering.kelvin[0, 0] == AMBIENT and rendering.depth[40, 50] == pytest.approx(2.0)


# ---- a moving camera ------------------------------------------------------------------------------------------------------------------


def ball_room(where: np.ndarray, radius: float = 0.06):
    """A hot ball in the open."""
    b = SceneBuilder("ball", 0)
    b.ellipsoid(where, (radius, radius, radius), replace(BLACK, kelvin=400.0))
    return b.scene(Sky(AMBIENT, AMBIENT), AMBIENT)


def center_of_warmth(kelvin: np.ndarray) -> np.ndarray:
    weights = np.clip(kelvin - AMBIENT, 0, None)
    y, x = np.mgrid[: kelvin.shape[0], : kelvin.shape[1]]
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


ROUND = Route(np.c_[2 * np.cos(np.arange(12) * np.pi / 6), 2 * np.sin(np.arange(12) * np.pi / 6), np.full(12, 1.0)], 0.8, "across", 1.0, (0.0, 0.0, 1.0))


@pytest.mark.parametrize("style", sorted(STYLES))
def test_true_poses_project_a_point_where_the_image_shows_it(style: str) -> None:
    camera, path = thermal_camera((320, 256)), HandHeldPath(ROUND, STYLES[style], 6.0, 1)
    exposure = Exposure(Renderer(ball_room(np.array([0.0, 0.0, 1.0])), camera), path, SensorConfig())
    seen = 0
    for t in (1.0, 2.3, 3.1, 4.4, 5.2):
        (pixel,) = camera.project(np.atleast_2d(inverse(path.pose(t))[:3, 3] + inverse(path.pose(t))[:3, :3] @ [0.0, 0.0, 1.0]))
        if camera.contains(pixel[None], border=25)[0]:
            seen += 1
            assert np.allclose(center_of_warmth(exposure.at(t)), pixel, atol=0.25)
    assert seen >= 2


def test_fast_motion_smears_by_the_time_constant() -> None:
    camera, path = thermal_camera((320, 256)), HandHeldPath(ROUND, STYLES["aggressive"], 6.0, 1)
    renderer = Renderer(ball_room(np.array([0.0, 0.0, 1.0]), radius=0.02), camera)
    sharp, smeared = (Exposure(renderer, path, SensorConfig(time_constant_ms=ms)) for ms in (0.0, 12.0))
    fast = max((1.0, 2.3, 3.1, 4.4, 5.2), key=smeared.motion_px)
    assert sharp.count(fast) == 1 and smeared.count(fast) > 1
    assert smeared.at(fast).max() < sharp.at(fast).max() - 20
    assert (smeared.at(fast) - AMBIENT).sum() == pytest.approx((sharp.at(fast) - AMBIENT).sum(), rel=0.1)


def test_exposures_are_those_of_an_exponential_lag_about_its_mean() -> None:
    ages = exposure_ages(2000, 0.01)
    assert ages.mean() == pytest.approx(0, abs=1e-12) and ages.std() == pytest.approx(0.01, rel=0.02)
    assert ages.min() == pytest.approx(-0.01, rel=0.01), "nothing is seen before it happens"
    assert exposure_ages(1, 0.01).tolist() == [0.0]


def test_rows_of_a_rolling_readout_are_seen_one_after_the_other() -> None:
    camera, path = thermal_camera((320, 256)), HandHeldPath(ROUND, STYLES["robust"], 6.0, 1)
    still = SensorConfig(time_constant_ms=0.0)
    where, t, row_us = np.array([0.0, 0.0, 1.45]), 2.0, 100.0
    renderer = Renderer(ball_room(where), camera)
    for moment in (t, 3.0):
        row = center_of_warmth(Exposure(renderer, path, still).at(moment))[1]
        rolled = center_of_warmth(Exposure(renderer, path, still.model_copy(update={"row_time_us": row_us})).at(moment))
        later = Exposure(renderer, path, still).at(moment + row_us * 1e-6 * (row - 127.5))
        assert np.allclose(rolled, center_of_warmth(later), atol=0.1)


# ---- paths and scenes -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("style", sorted(STYLES))
def test_paths_are_rigid_and_smooth_to_the_second_derivative(style: str) -> None:
    path, dt = HandHeldPath(SCENES["room"].route(), STYLES[style], 10.0, 0), 1e-3
    poses = path.poses(np.arange(0, 10, dt))
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3)) and np.allclose(np.linalg.det(rotations), 1)
    acceleration = np.diff(poses[:, :3], 2, axis=0) / dt**2
    assert np.abs(np.diff(acceleration, axis=0)).max() < 0.01 * np.abs(acceleration).max() + 0.5, "no steps in acceleration"


def test_styles_turn_as_fast_as_they_say() -> None:
    limits = {"robust": (8, 30), "unstable": (30, 70), "aggressive": (70, 140)}
    for style, (low, high) in limits.items():
        poses = HandHeldPath(SCENES["room"].route(), STYLES[style], 30.0, 0).poses(np.arange(0, 30, 0.02))
        relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
        rate = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))) / 0.02
        assert low < np.percentile(rate, 95) < high


def distances(scene, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """How far (N,) along rays, in their lengths, the first surface is."""
    hits = RayCaster(scene).first_hit(origins, rays)
    corner, *ends = (scene.vertices[scene.faces[hits, k]] for k in range(3))
    normal = np.cross(ends[0] - corner, ends[1] - corner)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(hits >= 0, np.einsum("ni,ni->n", corner - origins, normal) / np.einsum("ni,ni->n", rays, normal), np.inf)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_paths_keep_clear_of_everything_and_come_back(name: str) -> None:
    kind = SCENES[name]
    kind_scene = kind.make(0)
    directions = np.random.default_rng(0).standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for style in STYLES.values():
        lap = HandHeldPath(kind.route(), style, 1.0, 0).lap_s
        path = HandHeldPath(kind.route(), style, 1.1 * lap, 0)
        positions = path.poses(np.linspace(0, 1.1 * lap, 90))[:, :3, 3]
        origins, rays = np.repeat(positions, len(directions), axis=0), np.tile(directions, (len(positions), 1))
        distance = distances(kind_scene, origins, rays)
        assert distance.min() > 0.2, f"{distance.min():.2f} m from something"
        assert distances(kind_scene, positions[:-1], np.diff(positions, axis=0)).min() > 1, "nothing stands between one position and the next"
        if not kind.outdoors:
            assert np.all(np.isfinite(distance)), "a closed scene has no holes"
        start, after = path.poses([0.0, lap])[:, :3, 3]
        assert np.linalg.norm(after - start) < 2.0


def test_the_corridor_is_a_loop_of_sixty_metres() -> None:
    assert Way(SCENES["corridor"].route()).length_m > 60


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scenes_are_the_same_for_the_same_seed_only(name: str) -> None:
    first, again, other = (SCENES[name].make(seed) for seed in (3, 3, 4))
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.surfaces, again.surfaces)
    assert first.surfaces.shape != other.surfaces.shape or not np.array_equal(first.surfaces, other.surfaces)


def test_bare_surfaces_have_little_contrast() -> None:
    """By design: the room's walls differ by fractions of a kelvin, a few times the noise."""
    from thegra_core.simulation.materials import PLASTER

    kelvin = Renderer(scene(wall(2.0, PLASTER)), PINHOLE).render(np.eye(4)).kelvin
    assert 0.04 < kelvin.std() < 0.3


def test_way_by_arc_length_has_the_length_and_the_points_of_the_route() -> None:
    way = Way(Route(rounded_rectangle(10, 6, 1.0, 1.5), 1.0, "ahead", 1.0))
    assert way.length_m == pytest.approx(2 * (10 + 6) - 8 + 2 * np.pi, rel=2e-3)
    steps = np.linalg.norm(np.diff(way.at(np.linspace(0, way.length_m, 400)), axis=0), axis=1)
    assert np.allclose(steps, steps.mean(), rtol=0.02)


def test_looking_along_x_is_upright() -> None:
    assert np.allclose(LOOKING_ALONG_X[:3, :3], np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
