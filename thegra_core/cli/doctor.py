"""`thegra doctor`: what is installed and what is missing, one page to paste in a bug report."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
import sys
from typing import Any

from thegra_core.config import PROFILES, load_config
from thegra_core.errors import ConfigError
from thegra_core.features.registry import weights_for
from thegra_core.features.weights import cache_dir, verify
from thegra_core.outputs.write import installed_versions
from thegra_core.version import DISTRIBUTION, VERSION

_DISTRIBUTIONS = (
    "numpy", "scipy", "opencv-python-headless", "opencv-python", "scikit-image", "torch", "kornia", "gtsam", "poselib", "rosbags", "mcap", "pydantic",
    "typer", "rich", "jinja2", "matplotlib", "rerun-sdk",
)  # fmt: skip
_OPTIONAL = ("opencv-python", "rerun-sdk")


def doctor_command(as_json: bool) -> None:
    """Print the page, or the same facts as JSON."""
    facts = examine()
    print(json.dumps(facts, indent=2) if as_json else page(facts))


def examine() -> dict[str, Any]:
    """What is here; nothing of it fails."""
    return {
        "thegra": VERSION,
        "python": platform.python_version(),
        "executable": sys.executable,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpus": _usable_cpus(),
        "packages": installed_versions(_DISTRIBUTIONS),
        "networks": _networks(),
        "bundle_adjustment": "gtsam" if importlib.util.find_spec("gtsam") else None,
        "viewer": "rerun" if importlib.util.find_spec("rerun") else None,
        "ros": {"distro": os.environ.get("ROS_DISTRO"), "rclpy": importlib.util.find_spec("rclpy") is not None, "rmw": os.environ.get("RMW_IMPLEMENTATION")},
        "weights": {"cache": str(cache_dir()), "files": {status.weight.name: status.state for status in verify()}},
        "profiles": _profiles(),
    }


def page(facts: dict[str, Any]) -> str:
    """The facts as text, with what to type where something is missing."""
    packages = {name: version for name, version in facts["packages"].items() if version or name not in _OPTIONAL}
    networks, ros = facts["networks"], facts["ros"]
    lines = [
        f"thegra      {facts['thegra']}" + ("" if facts["thegra"] != "unknown" else f" (the distribution {DISTRIBUTION} is not installed: pip install -e .)"),
        f"python      {facts['python']} at {facts['executable']}",
        f"system      {facts['platform']}, {facts['cpus']} CPUs",
        f"networks    {networks['torch']}, device {networks['device']}" if networks["torch"] else f"networks    {networks['problem']}",
        f"bundle adj. {facts['bundle_adjustment'] or 'missing: pip install gtsam'}",
        f"viewer      {facts['viewer'] or 'none (optional): pip install rerun-sdk'}",
        f"ROS         {ros['distro'] or 'not sourced'}, rclpy {'importable' if ros['rclpy'] else 'not importable (needed for the nodes only)'}",
        f"weights     in {facts['weights']['cache']}",
        *(f"  {name:22s} {state}" for name, state in facts["weights"]["files"].items()),
        "profiles",
        *(f"  {name:22s} {state}" for name, state in facts["profiles"].items()),
        "packages",
        *(f"  {name:22s} {version or 'missing'}" for name, version in packages.items()),
    ]
    return "\n".join(lines)


def _usable_cpus() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _networks() -> dict[str, Any]:
    from thegra_core.features.device import resolve_device

    try:
        return {"torch": f"torch {installed_versions(('torch',))['torch']}", "device": str(resolve_device()), "problem": None}
    except (ImportError, OSError, ConfigError) as error:  # a broken CUDA installation fails with OSError
        return {"torch": None, "device": None, "problem": f"torch cannot be used: {error}"}


def _profiles() -> dict[str, str]:
    """Per profile `ready`, or the command that makes it so."""
    states = {status.weight.name: status.state for status in verify()}
    ready: dict[str, str] = {}
    for profile in PROFILES:
        config = load_config(profile)
        lacking = [name for name in weights_for(config.extractor, config.matcher) if states.get(name) != "ok"]
        ready[profile] = f"lacks {', '.join(lacking)}: thegra weights fetch --profile {profile}" if lacking else "ready"
    return ready
