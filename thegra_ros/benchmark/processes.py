"""The nodes as processes of their own, in a ROS domain of their own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from thegra_core.config import ThegraConfig, dump_config
from thegra_ros.environment import use_large_segments

NAMESPACE = "/thegra"
PATIENCE_S = 10.0


def use_own_domain() -> None:
    """Keep this process and those it starts apart from other nodes; called before ROS is initialised."""
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    use_large_segments()


@contextmanager
def running(nodes: Sequence[str], config: ThegraConfig, parameters: Mapping[str, object] | None = None) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Nodes by name, with a configuration; they end with the block."""
    with TemporaryDirectory(prefix="thegra_") as folder:
        file = Path(folder) / "config.yaml"
        file.write_text(dump_config(config))
        given = [text for name, value in {"config_file": file, **(parameters or {})}.items() for text in ("-p", f"{name}:={value}")]
        environment = {**os.environ, "ROS_LOG_DIR": folder}
        processes = [subprocess.Popen([sys.executable, "-m", f"thegra_ros.nodes.{name}", "--ros-args", "-r", f"__ns:={NAMESPACE}", *given], env=environment) for name in nodes]
        try:
            yield processes
        finally:
            end(processes)


def end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Tell processes to end, and see that they do."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in processes:
        try:
            process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
