# Thegra on ROS 2 Jazzy. The project's own checks do not build it: there is no Docker where they run. It was read line by line only.
#
#   docker build -t thegra .
#   docker run --rm --network host --ipc host thegra ros2 launch thegra_ros thegra.launch.py image:=/camera/image_raw
#
# --network host: DDS finds the other nodes by multicast. --ipc host: images come through shared memory from nodes of the same machine.
FROM ros:jazzy-ros-base

RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/*

# torch, gtsam, kornia, poselib are no packages of Ubuntu: they go into an environment that sees those of ROS, too
RUN python3 -m venv --system-site-packages /opt/thegra
ENV VIRTUAL_ENV=/opt/thegra PATH=/opt/thegra/bin:$PATH
# for a GPU leave this line out: the next pip then takes torch with CUDA, and the container wants --gpus all
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu torch

WORKDIR /workspace
COPY . src/thegra
RUN pip install --no-cache-dir ./src/thegra && thegra weights fetch
# setup.cfg lets the executables find their Python on PATH: the environment's
RUN . /opt/ros/jazzy/setup.sh && colcon build --packages-select thegra_ros

ENTRYPOINT ["/bin/bash", "-c", "source /opt/ros/jazzy/setup.bash && source /workspace/install/setup.bash && exec \"$@\"", "thegra"]
CMD ["ros2", "launch", "thegra_ros", "thegra.launch.py"]
