"""The graph on two hosts, which are two network namespaces joined by a cable; the cable is pulled for three seconds."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ros_graph import FAST, LIMIT_S

ROOT = Path(__file__).resolve().parents[2]
PARTS = Path(__file__).with_name("two_hosts_parts.py")
CUT_S = 3.0
IMAGE_BYTES = 320 * 256
NODE = [argument for name, value in FAST.items() for argument in ("-p", f"{name}:={value}")]


def can_make_hosts() -> str:
    """Why there can be no two hosts here, or nothing."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return "network namespaces need root"
    for tool, package in (("ip", "iproute2"), ("nsenter", "util-linux")):
        if shutil.which(tool) is None:
            return f"{package} is not installed"
    probe = subprocess.run(["ip", "netns", "add", f"thegra_probe_{os.getpid()}"], capture_output=True, text=True, check=False)
    subprocess.run(["ip", "netns", "delete", f"thegra_probe_{os.getpid()}"], capture_output=True, check=False)
    return f"no network namespaces here: {probe.stderr.strip()}" if probe.returncode else ""


class Hosts:
    """Two hosts, `robot` and `base`, and what runs on them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.names = {host: f"thegra_{host}_{os.getpid()}" for host in ("robot", "base")}
        self._links = {"robot": "vr", "base": "vb"}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        for name in self.names.values():
            ip("netns", "add", name)
        ip("link", "add", "vr", "netns", self.names["robot"], "type", "veth", "peer", "name", "vb", "netns", self.names["base"])
        for number, host in enumerate(self.names, 1):
            self._ip(host, "address", "add", f"10.77.0.{number}/24", "dev", self._links[host])
            for link in ("lo", self._links[host]):
                self._ip(host, "link", "set", link, "up")
        for host in self.names:
            self.wait(lambda host=host: self._link(host)["operstate"] == "UP", "links that are up: a node does not look again for those that come up later")
        # two hosts share no memory: each has its own, in which only its own processes meet
        own_memory = "mount -t tmpfs tmpfs /dev/shm && echo && exec sleep infinity"
        self._hosts = {host: subprocess.Popen(["ip", "netns", "exec", name, "sh", "-c", own_memory], stdout=subprocess.PIPE) for host, name in self.names.items()}
        for process in self._hosts.values():
            assert process.stdout is not None and process.stdout.readline() == b"\n"

    def run(self, host: str, name: str, *command: str) -> None:
        environment = {
            **os.environ, "ROS_DOMAIN_ID": "42", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_LOG_DIR": str(self._folder), "OMP_NUM_THREADS": "1",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(ROOT / "config" / "fastdds.xml"),
        }  # fmt: skip
        with (self._folder / f"{name}.log").open("w") as log:
            self.processes[name] = subprocess.Popen(
                ["nsenter", "-t", str(self._hosts[host].pid), "-m", "-n", sys.executable, *command], env=environment, stdout=log, stderr=subprocess.STDOUT
            )

    def node(self, host: str, name: str, *extra: str) -> None:
        self.run(host, name, "-m", f"thegra_ros.nodes.{name}", "--ros-args", "-r", "__ns:=/thegra", *NODE, *extra)

    def log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT_S
        while not condition():
            ended = [name for name, process in self.processes.items() if process.poll() is not None]
            if ended or time.monotonic() > end:
                logs = "\n".join(f"--- {name}\n{self.log(name)}" for name in self.processes if name != "listener")
                raise AssertionError(f"{ended} ended:\n{logs}" if ended else f"waited in vain for {what}:\n{logs}")
            time.sleep(0.2)

    def cable(self, state: str) -> None:
        self._ip("robot", "link", "set", "vr", state)

    def bytes_sent(self) -> int:
        return int(self._link("robot")["stats64"]["tx"]["bytes"])

    def close(self) -> None:
        for process in (*self.processes.values(), *self._hosts.values()):
            process.kill()
            process.communicate()
        for name in self.names.values():
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    def _link(self, host: str) -> dict[str, Any]:
        told = subprocess.run(["ip", "-n", self.names[host], "-s", "-j", "link", "show", self._links[host]], capture_output=True, text=True, check=True).stdout
        link: dict[str, Any] = json.loads(told)[0]
        return link

    def _ip(self, host: str, *arguments: str) -> None:
        ip("-n", self.names[host], *arguments)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    reason = can_make_hosts()
    if reason:
        pytest.skip(reason)
    made = Hosts(tmp_path)
    yield made
    made.close()


@pytest.mark.slow
@pytest.mark.parametrize("split", ["preprocessing on the robot", "raw", "compressed"])
def test_the_map_goes_on_when_the_link_was_cut(hosts: Hosts, recording_path: Path, tmp_path: Path, split: str) -> None:
    heard = tmp_path / "heard"
    hosts.run("base", "listener", str(PARTS), "listener", str(heard))
    if split == "preprocessing on the robot":
        hosts.node("robot", "preprocessing")
        for name in ("frontend", "tracking", "mapping"):
            hosts.node("base", name)
        works_on_poses = "tracking"
    else:
        hosts.node("base", "slam", "-p", f"image_transport:={split}")
        works_on_poses = "slam"
    hosts.run("robot", "camera", str(PARTS), "camera", str(recording_path), "compressed" if split == "compressed" else "raw", works_on_poses)

    def lines() -> list[dict[str, str]]:
        return [json.loads(line) for line in heard.read_text().splitlines() if line.endswith("}")] if heard.exists() else []

    def poses() -> list[int]:
        return [int(line["pose"]) for line in lines() if "pose" in line]

    def said(key: str) -> str:
        return next((line[key] for line in reversed(lines()) if line.get("node", "").endswith(works_on_poses) and key in line), "")

    hosts.wait(lambda: len(poses()) >= 8, "poses")
    map_before, news = said("map"), hosts.log(works_on_poses).count("a new map")
    hosts.cable("down")
    time.sleep(CUT_S)  # what is tested, not a wait for something
    before = len(poses())
    hosts.cable("up")
    hosts.wait(lambda: len(poses()) >= before + 8, "poses after the cut")
    assert said("map") == map_before and hosts.log(works_on_poses).count("a new map") == news, "the same map goes on"
    assert hosts.bytes_sent() > 20 * IMAGE_BYTES, "images went through the cable"
