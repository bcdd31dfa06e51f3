"""The stages' records over topics: a replica that lives on messages stays equal to the map, bit by bit."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from dataclasses import fields, is_dataclass, replace

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from thegra_core.config import load_config
from thegra_core.features.protocols import Wanted
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import Absorbed, Features, MapUpdate, RemovedKeyframe, Revisit
from thegra_core.preprocessing.chain import Chain
from thegra_core.tracking.stage import TrackingStage
from thegra_ros.codec.clouds import cloud_table
from thegra_ros.codec.records import (
    Assembler,
    features_table,
    initial_map_tables,
    keyframe_tables,
    matches_table,
    record_clouds,
    table_features,
    table_matches,
    tables_initial_map,
    tables_keyframes,
    tables_update,
    update_tables,
)
from thegra_ros.codec.rounds import SecondRound, is_followed, read_verdict, round_clouds, verdict_message
from thegra_ros.codec.stamps import header, stamp_ns


def send(tables):
    """Tables over the wire."""
    assembler = Assembler()
    for cloud in record_clouds(header(10**18, "camera"), "record", tables):
        assert cloud.width * cloud.point_step == len(cloud.data)
        done = assembler.add(deserialize_message(serialize_message(cloud), type(cloud)))
    assert done is not None and assembler.broken == 0
    return done[1]


def same(a, b) -> bool:
    """Equal in type and in every bit."""
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


@pytest.fixture(scope="module")
def records(frames, camera):
    """What the stages say to each other over thirty frames."""
    config = load_config("fast", overrides={"extractor.name": "orb", "preprocessing.filters": "[{filter: he_clip}]", "loop.enabled": "false"})
    chain, extractor, matcher = Chain(config.preprocessing), make_extractor(config.extractor), make_matcher(config.matcher, config.extractor)
    tracking, mapper = TrackingStage(camera, config, matcher), Mapper(camera, config, matcher)
    said = {"features": [], "matches": [], "initial": [], "keyframe": [], "update": []}
    for frame in frames:
        features = extractor.extract(chain(frame.image, frame.stamp_ns), frame.stamp_ns)
        reference = tracking.reference_features
        matches = matcher.match(features, reference) if reference is not None else None
        output = tracking.process(features, matches)
        said["features"].append(features)
        said["matches"] += [matches] if matches is not None else []
        if output.initial_map is not None:
            said["initial"].append(output.initial_map)
            said["update"].append(mapper.initialize(output.initial_map))
        elif output.keyframe is not None:
            said["keyframe"].append(output.keyframe)
            said["update"].append(mapper.insert(output.keyframe))
        if output.initial_map is not None or output.keyframe is not None:
            tracking.apply(said["update"][-1])
    return said


def test_records_are_exact(records) -> None:
    assert all(len(records[kind]) > 0 for kind in records)
    for features in records["features"]:
        assert same(table_features(*send([features_table(features)])), features)
    for matches in records["matches"]:
        assert same(table_matches(*send([matches_table(matches)])), matches)
    for keyframe in records["keyframe"]:
        (back,) = tables_keyframes(send(keyframe_tables(keyframe)))
        assert same(back, keyframe)
    for initial in records["initial"]:
        assert same(tables_initial_map(send(initial_map_tables(initial))), initial)
    for update in records["update"]:
        assert same(tables_update(send(update_tables(update))), update)


def test_updates_of_loops_are_exact() -> None:
    update = MapUpdate(
        7, 2, removed_keyframes=(RemovedKeyframe(3, 2**60 + 1, 4, np.random.default_rng(1).normal(size=(4, 4))),), removed_landmark_ids=np.array([1, 9], np.int64), covisibility={4: ((1, 20), (2, 17)), 6: ()},
        absorbed=Absorbed(5, np.random.default_rng(0).normal(size=(4, 4)), 1.7), scales={4: 1.25, 6: 0.1},
        revisits=(Revisit(2**60 + 3, 2, 8, 4, 77, 0.1, 1.0 / 3), Revisit(5, 2, 9, 4, 50, 0.0, 0.7, 5)), adjusted_id=6,
    )  # fmt: skip
    assert same(tables_update(send(update_tables(update))), update)


def test_tracks_keep_their_numbers(records) -> None:
    features = records["features"][0]
    numbered = replace(features, track_ids=np.arange(len(features), dtype=np.int64) + 2**40)
    assert same(table_features(*send([features_table(numbered)])), numbered)
    followed = replace(records["keyframe"][0], features=replace(records["keyframe"][0].features, track_ids=np.arange(len(records["keyframe"][0].features), dtype=np.int64)))
    assert same(*tables_keyframes(send(keyframe_tables(followed))), followed)


@pytest.mark.parametrize("followed", [True, False])
def test_both_messages_of_a_round_tell_its_kind(records, followed: bool) -> None:
    clouds = round_clouds(header(5, "camera"), records["features"][0], records["matches"][0], followed)
    tables = [cloud_table(deserialize_message(serialize_message(cloud), type(cloud))) for cloud in clouds]
    assert [is_followed(table) for table in tables] == [followed, followed]
    assert same(table_features(tables[0]), records["features"][0]) and same(table_matches(tables[1]), records["matches"][0])


@pytest.mark.parametrize("wanted", [None, *Wanted])
def test_what_is_wanted_is_told(wanted: Wanted | None) -> None:
    message = deserialize_message(serialize_message(verdict_message(7, wanted)), Header)
    assert read_verdict(message) is wanted and stamp_ns(message) == 7


def test_a_second_round_is_there_with_both_parts_in_either_order() -> None:
    second = SecondRound()
    for order in (("features", "matches"), ("matches", "features")):
        second.expect(7)
        assert second.stamp_ns == 7 and second.add(order[0], "a") is None
        assert second.add(order[1], "b") == {order[0]: "a", order[1]: "b"} and second.stamp_ns is None


def test_a_frame_without_keypoints_keeps_its_facts() -> None:
    nothing = Features(5, np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 64), np.float32), (640, 512), "xfeat", turns=3)
    assert same(table_features(*send([features_table(nothing)])), nothing)


def test_a_record_that_lacks_a_part_is_thrown_away(records) -> None:
    clouds = record_clouds(header(0, ""), "update", update_tables(records["update"][0]))
    assembler = Assembler()
    assert all(assembler.add(cloud) is None for cloud in [*clouds[:2], *clouds[3:]])
    assert assembler.broken > 0
    done = [assembler.add(cloud) for cloud in clouds][-1]
    assert done is not None and same(tables_update(done[1]), records["update"][0])
