"""Following points from image to image, on pictures whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thegra_core.config import FlowConfig
from thegra_core.features.flow import follow, normalize_contrast, patch_similarity
from thegra_core.features.front_end import DetectAndFollow, DetectEach
from thegra_core.features.protocols import Wanted
from thegra_core.features.registration import coarse_shift, follow_far, overlap_shift
from thegra_core.features.tracks import TrackMatcher, only_followed, shared_tracks
from thegra_core.messages import Features, Matches

WIDTH, HEIGHT = 320, 256
CONFIG = FlowConfig()


def texture(seed: int = 0) -> np.ndarray:
    """Smooth random blobs, larger than the image."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT + 128, WIDTH + 128)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def view(picture: np.ndarray, dx: float, dy: float, turn_deg: float = 0.0, gain: float = 1.0, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The part of the picture that a camera moved by (dx, dy) px and turned sees, and the (2, 3) map from picture to image."""
    matrix = cv2.getRotationMatrix2D(((WIDTH + 128) / 2, (HEIGHT + 128) / 2), turn_deg, 1.0)
    matrix[:, 2] -= [64 + dx, 64 + dy]
    seen = cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return np.clip(gain * seen.astype(np.float32) + offset, 0, 255).astype(np.uint8), matrix


def grid(step: int = 20, margin: int = 60) -> np.ndarray:
    y, x = np.mgrid[margin : HEIGHT - margin : step, margin : WIDTH - margin : step]
    return np.stack((x.ravel(), y.ravel()), axis=1).astype(np.float32)


def moved(points: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where points of one image lie in another one of the same picture."""
    whole_before, whole_after = (np.vstack((m, [0, 0, 1])) for m in (before, after))
    mapped = np.column_stack((points, np.ones(len(points)))) @ (whole_after @ np.linalg.inv(whole_before)).T
    return mapped[:, :2]


@pytest.mark.parametrize(("dx", "dy", "turn_deg"), [(0, 0, 0), (3.4, -2.2, 0), (31, 18, 0), (-40, 25, 2), (4, 2, 6)])
def test_points_are_found_where_they_went(dx: float, dy: float, turn_deg: float) -> None:
    picture = texture()
    (first, at_first), (second, at_second) = view(picture, 0, 0), view(picture, dx, dy, turn_deg)
    first, second, points = normalize_contrast(first), normalize_contrast(second), grid()
    result = follow(first, second, points, points + coarse_shift(first, second), CONFIG)
    error = np.linalg.norm(result.points - moved(points, at_first, at_second), axis=1)
    assert result.found.mean() > 0.9
    assert np.median(error[result.found]) < 0.1 + 0.03 * abs(turn_deg) and error[result.found].max() < 1.5
    assert result.similarity[result.found].min() >= CONFIG.min_similarity


def test_gain_control_is_no_motion() -> None:
    picture = texture()
    (first, _), (second, _) = view(picture, 0, 0, gain=0.3, offset=30), view(picture, 5, 3, gain=0.6, offset=80)
    first, second, points = normalize_contrast(first), normalize_contrast(second), grid()
    result = follow(first, second, points, points, CONFIG)
    error = np.linalg.norm(result.points - (points - [5, 3]), axis=1)
    assert result.found.mean() > 0.9 and np.percentile(error[result.found], 95) < 0.25


def test_little_is_found_in_another_picture() -> None:
    first, second, points = normalize_contrast(view(texture(0), 0, 0)[0]), normalize_contrast(view(texture(1), 0, 0)[0]), grid()
    assert follow(first, second, points, points, CONFIG).found.mean() < 0.2


def test_points_that_leave_the_image_are_lost() -> None:
    picture = texture()
    first, second = (normalize_contrast(view(picture, dx, 0)[0]) for dx in (0, 30))
    points = np.array([[10, 100], [200, 100]], np.float32)
    assert follow(first, second, points, points - [30, 0], CONFIG).found.tolist() == [False, True]


def test_no_points_are_no_trouble() -> None:
    image = normalize_contrast(view(texture(), 0, 0)[0])
    result = follow(image, image, np.empty((0, 2), np.float32), np.empty((0, 2), np.float32), CONFIG)
    assert result.points.shape == (0, 2) and len(result.found) == len(result.similarity) == 0


def test_similarity_knows_neither_brightness_nor_contrast() -> None:
    image = view(texture(), 0, 0)[0]
    darker, inverted = (0.4 * image + 20).astype(np.uint8), 255 - image
    points = grid()
    assert patch_similarity(image, darker, points, points, 9).min() > 0.95
    assert patch_similarity(image, inverted, points, points, 9).max() < -0.99


# ---- what has moved far -----------------------------------------------------------------------------------------------------------


def large(seed: int = 0) -> np.ndarray:
    """A picture wide enough for images that share but a part."""
    noise = np.random.default_rng(seed).normal(size=(2 * HEIGHT, 3 * WIDTH)).astype(np.float32)
    blobs = cv2.GaussianBlur(noise, (0, 0), 4) + 6 * cv2.GaussianBlur(noise, (0, 0), 25)
    return cv2.normalize(blobs, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def part(picture: np.ndarray, dx: float, dy: float, zoom: float = 1.0, turn_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """As `view`, of a large picture: the camera has also come nearer by `zoom`."""
    matrix = cv2.getRotationMatrix2D((1.5 * WIDTH, HEIGHT), turn_deg, zoom)
    matrix[:, 2] -= [WIDTH + dx, HEIGHT / 2 + dy]
    return cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR), matrix


FAR = [(150, -40, 1.0, 0.0), (-130, 30, 1.05, 3.0), (0, 0, 1.35, 0.0), (100, 20, 1.15, -6.0)]


@pytest.mark.parametrize(("dx", "dy", "zoom", "turn_deg"), FAR)
def test_what_moved_far_is_found_with_more_effort(dx: float, dy: float, zoom: float, turn_deg: float) -> None:
    picture = large()
    (first, at_first), (second, at_second) = part(picture, 0, 0), part(picture, dx, dy, zoom, turn_deg)
    first, second, points = normalize_contrast(first), normalize_contrast(second), grid(16, 20)
    there = moved(points, at_first, at_second)
    shared = ((there > 12) & (there < np.array([WIDTH, HEIGHT]) - 13)).all(axis=1)
    near = follow(first, second, points, points + coarse_shift(first, second), CONFIG)
    far = follow_far(first, second, points, near, CONFIG)
    right = far.found & (np.linalg.norm(far.points - there, axis=1) < 1.5)
    assert right[shared].mean() > 0.7
    assert right.sum() > 0.8 * far.found.sum()


def test_the_shift_of_what_two_images_share_is_found() -> None:
    picture = large()
    first, second = (normalize_contrast(part(picture, dx, dy)[0]) for dx, dy in ((0, 0), (150, -40)))
    np.testing.assert_allclose(overlap_shift(first, second), [-150, 40], atol=8)


def test_another_picture_is_not_found_with_more_effort() -> None:
    first, second, points = normalize_contrast(part(large(0), 0, 0)[0]), normalize_contrast(part(large(1), 0, 0)[0]), grid(16, 20)
    near = follow(first, second, points, points, CONFIG)
    assert follow_far(first, second, points, near, CONFIG).found.mean() < 0.2


# ---- the front ends ---------------------------------------------------------------------------------------------------------------


class Corners:
    """Corners of the image, each with a descriptor of its place and of how often was detected."""

    name = "corners"

    def __init__(self) -> None:
        self.calls = 0
        self.stamps: list[int] = []

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        self.calls += 1
        self.stamps.append(stamp_ns)
        found = cv2.goodFeaturesToTrack(image, 150, 0.01, 8)
        points = np.empty((0, 2), np.float32) if found is None else found[:, 0].astype(np.float32)
        descriptors = np.column_stack((points, np.full(len(points), self.calls))).astype(np.float32)
        return Features(stamp_ns, points, np.full(len(points), 0.8, np.float32), descriptors, (image.shape[1], image.shape[0]), self.name)


def front_end(max_points: int = 200) -> tuple[DetectAndFollow, Corners]:
    corners = Corners()
    return DetectAndFollow(corners, CONFIG.model_copy(update={"max_points": max_points})), corners


def test_one_detection_serves_many_images() -> None:
    picture, (end, corners) = texture(), front_end()
    assert end.follow(view(picture, 0, 0)[0], 0) is None
    first = end.detect()
    for i in range(1, 8):
        followed = end.follow(view(picture, 3 * i, i)[0], i)
        assert followed is not None and followed.stamp_ns == i
    assert corners.calls == 1
    pairs = shared_tracks(followed, first)
    assert len(pairs) == len(followed) > 0.6 * len(first)
    there = first.keypoints[pairs.indices[:, 1]] - [21, 7]
    assert np.median(np.linalg.norm(followed.keypoints[pairs.indices[:, 0]] - there, axis=1)) < 0.2
    np.testing.assert_array_equal(followed.descriptors[pairs.indices[:, 0]], first.descriptors[pairs.indices[:, 1]])
    assert (followed.scores <= 0.8).all() and (followed.scores > 0).all()


def test_detecting_more_keeps_the_tracks_where_they_are() -> None:
    picture, (end, corners) = texture(), front_end()
    end.follow(view(picture, 0, 0)[0], 0)
    end.detect()
    followed = end.follow(view(picture, 30, 0)[0], 1)
    assert followed is not None
    more = end.detect(Wanted.MORE)
    pairs = shared_tracks(more, followed)
    assert len(pairs) == len(followed) < len(more) and corners.calls == 2
    np.testing.assert_array_equal(more.keypoints[pairs.indices[:, 0]], followed.keypoints[pairs.indices[:, 1]])
    new = np.setdiff1d(np.arange(len(more)), pairs.indices[:, 0])
    assert len(set(more.track_ids.tolist())) == len(more)
    assert (more.descriptors[new, 2] == 2).all(), "what is new comes from this image"
    distance = np.linalg.norm(more.keypoints[new][:, None] - followed.keypoints[None], axis=2).min(axis=1)
    assert (distance > CONFIG.near_px).all()


@pytest.mark.parametrize("likely", [False, True])
def test_a_detection_that_has_begun_is_the_one_that_is_asked_for(likely: bool) -> None:
    picture, (end, corners) = texture(), front_end()
    end.follow(view(picture, 0, 0)[0], 0, likely)
    end.detect()
    followed = end.follow(view(picture, 4, 1)[0], 1, likely)
    assert followed is not None
    more = end.detect(Wanted.MORE)
    assert corners.calls == 2 and corners.stamps == [0, 1], "each image once"
    plain, _ = front_end()
    plain.follow(view(picture, 0, 0)[0], 0)
    plain.detect()
    for mine, theirs in ((followed, plain.follow(view(picture, 4, 1)[0], 1)), (more, plain.detect(Wanted.MORE))):
        assert theirs is not None
        np.testing.assert_array_equal(mine.keypoints, theirs.keypoints)
        np.testing.assert_array_equal(mine.track_ids, theirs.track_ids)


def test_a_detection_that_nobody_asks_for_changes_nothing() -> None:
    picture, (end, corners) = texture(), front_end()
    end.follow(view(picture, 0, 0)[0], 0)
    first = end.detect()
    end.follow(view(picture, 4, 1)[0], 1, likely=True)
    followed = end.follow(view(picture, 8, 2)[0], 2)
    assert followed is not None
    pairs = shared_tracks(followed, first)
    there = first.keypoints[pairs.indices[:, 1]] - [8, 2]
    assert len(pairs) == len(followed) and np.median(np.linalg.norm(followed.keypoints[pairs.indices[:, 0]] - there, axis=1)) < 0.2
    assert end.detect(Wanted.MORE).stamp_ns == 2 and corners.stamps == [0, 1, 2]


def test_detecting_anew_forgets_the_tracks() -> None:
    picture, (end, _) = texture(), front_end()
    end.follow(view(picture, 0, 0)[0], 0)
    first = end.detect()
    end.follow(view(picture, 2, 0)[0], 1)
    assert len(shared_tracks(end.detect(Wanted.ANEW), first)) == 0


def test_images_may_be_missing_between_two_that_share_half() -> None:
    picture, (end, corners) = large(), front_end()
    end.follow(part(picture, 0, 0)[0], 0)
    first = end.detect()
    end.follow(part(picture, 150, -40)[0], 1)
    pairs = shared_tracks(end.detect(), first)
    assert len(pairs) > 30 and corners.calls == 2


def test_another_scene_is_not_followed() -> None:
    end, corners = front_end()
    end.follow(view(texture(0), 0, 0)[0], 0)
    end.detect()
    assert end.follow(view(texture(1), 0, 0)[0], 1) is None
    assert len(end.detect()) > 50 and corners.calls == 2


def test_a_forgotten_image_is_not_followed_from() -> None:
    picture, (end, _) = texture(), front_end()
    end.follow(view(picture, 0, 0)[0], 0)
    first = end.detect()
    end.forget()
    assert end.follow(view(picture, 1, 0)[0], 1) is None
    assert len(shared_tracks(end.detect(), first)) == 0


def test_images_without_contrast_are_survived() -> None:
    end, _ = front_end()
    for i in range(3):
        assert end.follow(np.full((HEIGHT, WIDTH), 90, np.uint8), i) is None
        assert len(end.detect()) == 0


def test_detecting_each_is_the_extractor_itself() -> None:
    corners = Corners()
    end, image = DetectEach(corners), view(texture(), 0, 0)[0]
    assert end.follow(image, 5) is None
    found = end.detect()
    assert found.stamp_ns == 5 and found.track_ids is None and corners.calls == 1


def features(count: int, ids: list[int] | None, stamp_ns: int = 0) -> Features:
    points = np.random.default_rng(count).uniform(0, 200, (count, 2)).astype(np.float32)
    return Features(
        stamp_ns, points, np.ones(count, np.float32), np.zeros((count, 4), np.float32), (WIDTH, HEIGHT), "x", None if ids is None else np.array(ids, np.int64)
    )  # fmt: skip


class Learned:
    name = "learned"

    def __init__(self, *pairs: tuple[int, int]) -> None:
        self.asked = 0
        self.pairs = np.array(pairs, np.int32).reshape(-1, 2)

    def match(self, query: Features, reference: Features) -> Matches:
        self.asked += 1
        return Matches(query.stamp_ns, reference.stamp_ns, self.pairs, np.full(len(self.pairs), 0.5, np.float32))

    def match_many(self, query: Features, references: list[Features]) -> list[Matches]:
        return [self.match(query, r) for r in references]


def test_tracks_are_matches_where_they_are_enough() -> None:
    learned = Learned()
    matcher = TrackMatcher(learned, 3)
    query, near, far, plain = features(4, [7, 5, 9, 2], 1), features(5, [9, 1, 2, 7, 0], 2), features(3, [9, 20, 21], 3), features(4, None, 4)
    found = matcher.match(query, near)
    assert found.indices.tolist() == [[0, 3], [2, 0], [3, 2]] and (found.stamp_ns, found.reference_stamp_ns) == (1, 2)
    assert learned.asked == 0
    assert [len(m) for m in matcher.match_many(query, [near, far, plain])] == [3, 1, 0]
    assert learned.asked == 2


def test_too_few_tracks_are_kept_beside_what_the_matcher_finds() -> None:
    matcher = TrackMatcher(Learned((0, 1), (1, 0), (2, 2)), 3)
    query, reference = features(4, [7, 5, 9, 2], 1), features(5, [8, 10, 11, 7, 0], 2)
    found = matcher.match(query, reference)
    assert found.indices.tolist() == [[0, 3], [1, 0], [2, 2]], "a track is believed, and its keypoints are free for nothing else"
    assert found.confidence.tolist() == [1.0, 0.5, 0.5]


def test_keypoints_beyond_those_that_are_followed_are_there_to_be_matched() -> None:
    picture, (end, _) = texture(), front_end(100)
    end.follow(view(picture, 0, 0)[0], 0)
    first = end.detect()
    assert len(first) > 120 and len(only_followed(first)) == 100
    followed = end.follow(view(picture, 3, 1)[0], 1)
    assert followed is not None and 60 < len(followed) <= 100, "those alone are followed"
    more = end.detect()
    assert len(more) > 120 and len(only_followed(more)) == 100, "what was lost is made up for"
    pairs = shared_tracks(more, first)
    assert len(pairs) == len(shared_tracks(followed, first)), "keypoints that are not followed are not the same for that"
    assert (first.track_ids[pairs.indices[:, 1]] >= 0).all()  # type: ignore[index]


def test_keypoints_that_are_not_followed_are_matched_where_tracks_are_never_enough() -> None:
    """Rows that the inner matcher names are those of what it was shown."""
    query, reference = features(5, [-1, 7, -1, 9, 2], 1), features(4, [-1, 8, -1, 7], 2)
    found = TrackMatcher(Learned((0, 0), (1, 1), (2, 0)), 3).match(query, reference)
    assert found.indices.tolist() == [[1, 3], [4, 1]], "1 and 3 are a track; of what the matcher found among those followed (0, 1), the second is left"
    everything = TrackMatcher(Learned((0, 0), (2, 2), (1, 1)), None).match(query, reference)
    assert everything.indices.tolist() == [[0, 0], [1, 3], [2, 2]]
