"""The nodes' own parameters: what they have beside the configuration of the method."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from thegra_core.config import Section


class NodeConfig(Section):
    """Frames, topics and queues."""

    camera_file: str = Field("", description="calibration file (ROS, Kalibr or OpenCV yaml); wins over camera_info, which is then not listened to")
    image_transport: Literal["raw", "compressed"] = Field("raw", description="image_raw, or image_raw/compressed")
    queue_size: int = Field(2, ge=1, le=10000, description="images that wait at the most; a new one pushes the oldest out")
    engine: Literal["process", "thread"] = Field("process", description="where slam works, and mapping keeps its map: a process of its own, or a thread, which delays the reception of messages while it solves")
    map_file: str = Field("", description="file of ~/save_map and ~/load_map; where it is there when the node is configured the camera is sought in its map. May change at any time")
    localization_only: bool = Field(False, description="begin with localisation only: the map of map_file stays as it is. ~/localization_only changes it")
    map_frame: str = Field("map", description="frame of poses, path and points")
    odom_frame: str = Field("", description="odometry frame, if something publishes odom_frame -> base_frame on /tf; then map_frame -> odom_frame is published")
    base_frame: str = Field("", description="robot frame whose pose is published; empty: the camera's")
    camera_frame: str = Field("", description="optical frame of the camera; empty: the images' frame_id")
    base_from_camera: str = Field("", description="x y z (m) qx qy qz qw of the optical camera frame in base_frame; empty: from /tf_static, else the camera looks forward from base_frame")
    publish_tf: bool = Field(True, description="publish the pose on /tf")
    scale: float = Field(1.0, gt=0, description="metres of one map unit; one camera does not see size")
    path_length: int = Field(1000, ge=2, description="poses of path at the most; then every second one goes")
    map_period_s: float = Field(1.0, ge=0, description="seconds between two map_points and keyframe_path at the least")
    diagnostics_period_s: float = Field(1.0, gt=0, description="seconds between two words on /diagnostics at the most; a change is told at once")
