"""`thegra info`."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import typer
from bag_making import IMAGE, ROS1, T0, image_message, infos, picture, stream, write_ros1
from typer.testing import CliRunner

from thegra_core.cli.info import gather, info
from thegra_core.errors import InputError

app = typer.Typer()
app.command()(info)


def invoke(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_bag_as_json(tmp_path):
    images = [picture(i) for i in range(20)]
    images[11] = images[10]
    images[12] = images[10]
    times = T0 + np.arange(20) * 10**8
    times[18:] += 10**9
    items = [("/thermal/image_raw", IMAGE, image_message(ROS1, image, int(t)), int(t) + 55) for image, t in zip(images, times, strict=True)]
    path = write_ros1(tmp_path / "a.bag", items + infos(ROS1))
    facts = json.loads(invoke(path, "--json"))
    assert facts["topics"] == [
        {"name": "/thermal/camera_info", "type": "sensor_msgs/msg/CameraInfo", "messages": 1},
        {"name": "/thermal/image_raw", "type": "sensor_msgs/msg/Image", "messages": 20},
    ]
    images_facts = facts["images"]
    assert (images_facts["frames"], facts["stored_images"], images_facts["repeated"]) == (20, 20, 2)
    assert images_facts["sizes"] == {"32x24 uint16": 20}
    assert images_facts["duration_s"] == pytest.approx(2.9)
    assert images_facts["period_s"] == pytest.approx(0.1)
    assert images_facts["gaps"] == [[pytest.approx(1.7), pytest.approx(1.1)]]
    assert images_facts["closures"] == [[pytest.approx(1.1), pytest.approx(1.3)], [pytest.approx(1.7), pytest.approx(2.8)]]
    assert 2900 <= images_facts["quantiles"][0] < images_facts["quantiles"][1] < images_facts["quantiles"][2] <= 3300
    assert facts["camera"]["fx"] == 100
    assert facts["command"] == f"thegra run {path}"


def test_bag_as_text(tmp_path):
    text = invoke(write_ros1(tmp_path / "a.bag", stream(ROS1)))
    for part in ("/thermal/image_raw", "6 readable of 6", "32x24 uint16", "10 Hz", "[FX, 0.0, CX", "--camera camera.yaml"):
        assert part in text


def test_topics_that_cannot_be_guessed_are_listed(tmp_path):
    path = write_ros1(tmp_path / "a.bag", stream(ROS1, topic="/left") + stream(ROS1, topic="/right"))
    facts = gather(path)
    assert [t["name"] for t in facts["image_topics"]] == ["/left", "/right"]
    assert "several image topics" in facts["problem"]
    assert "--topic /left" in invoke(path)
    assert gather(path, "/right")["command"] == f"thegra run {path} --topic /right --camera camera.yaml"
    with pytest.raises(InputError):
        gather(path, "/middle")


def test_folder_with_damage(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((24, 32), np.uint8))
    (tmp_path / "images.txt").write_text("0 0.png\n1 gone.png\n2 0.png\n2 0.png\n")
    facts = gather(tmp_path)
    assert facts["unreadable"] == {"image file missing or unreadable": 1}
    assert facts["images"]["stamps_not_increasing"] == 1
    assert facts["images"]["repeated"] == 2
    assert "1 x image file missing" in invoke(tmp_path)


def test_nothing_readable(tmp_path):
    (tmp_path / "images.txt").write_text("0 gone.png\n")
    facts = json.loads(invoke(tmp_path, "--json"))
    assert facts["images"]["frames"] == 0
    assert facts["images"]["period_s"] is None
    assert "0 readable of 1" in invoke(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        gather(tmp_path / "none")
