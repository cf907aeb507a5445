"""Conversion of file keys that earlier versions of the library wrote."""

import re
from collections.abc import Mapping
from typing import Any

_CAMERA_DATA = {"points": "pointcloud", "images": "rgbd", "clouds": "full_pointcloud"}
_CAMERA_MODELS = {"reference": "handoversim", "true": "pinhole"}
_CAMERA_NOISE = {
    "CameraImperfections(": "CameraNoise(",
    "depth_noise=": "depth_noise_std=",
    "edge_step=": "edge_threshold=",
    "edge_drop=": "edge_dropout=",
    "every=": "pixel_stride=",
}
# Keys of result folders and data sets that 0.7.0 named differently.
_KEYS = {
    "receiver_code": "receiver_hash",
    "giver_code": "giver_hash",
    "wait": "wait_s",
    "kept": "recorded",
    "without": "missing_package",
    "settings": "evaluation",
    "played": "simulated",
}
#: Keys of fluency metrics that 0.7.0 named differently.
FLUENCY_KEYS = {"peak_force": "max_robot_object_force"}
# Keys at any depth of a report that 0.7.0 named differently.
_REPORT_KEYS = {
    **_KEYS,
    **FLUENCY_KEYS,
    "episodes_run": "n_episodes",
    "episodes_from_an_earlier_run": "n_resumed",
    "episodes_in_split": "n_split_scenes",
    "plan_time": "plan_s",
    "exec": "exec_s",
    "plan": "plan_s",
    "total": "total_s",
    "interval": "interval_95",
}
# As version 0.7.0 wrote it, e.g. "sees points alone, rays, true geometry, CameraImperfections(...)".
_SIGHT = re.compile(
    r"sees (points|images|clouds)(?: (alone|and poses), (\w+), (reference|true) geometry(.*))?", re.DOTALL
)


def upgrade_keys(section: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the library's section of a `config.yaml` or a `metadata.json` to the current keys.

    Args:
        section: The section as it was read, written by this version or by 0.7.0.

    Raises:
        ValueError: A value under an old key does not have the format of version 0.7.0.
    """
    upgraded = {_KEYS.get(key, key): value for key, value in section.items()}
    if "sight" in upgraded:
        upgraded |= _split_sight(upgraded.pop("sight"))
    if "evaluation" in upgraded:
        upgraded["evaluation"] = upgrade_keys(upgraded["evaluation"])
    return upgraded


def upgrade_report(report: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the content of a `report.json` to the current keys.

    Args:
        report: The content as it was read, written by this version or by 0.7.0.

    Raises:
        ValueError: The value under `sight` does not have the format of version 0.7.0.
    """
    upgraded: dict[str, Any] = _rename_report_keys(report)
    return upgraded | _split_sight(upgraded.pop("sight")) if "sight" in upgraded else upgraded


def _rename_report_keys(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {_REPORT_KEYS.get(key, key): _rename_report_keys(part) for key, part in value.items()}
    return [_rename_report_keys(part) for part in value] if isinstance(value, list) else value


def _split_sight(sight: Any) -> dict[str, str]:
    if sight == "":
        return {"obs_mode": "state", "camera": ""}
    match = _SIGHT.fullmatch(str(sight))
    if match is None:
        raise ValueError(f"sight must be as version 0.7.0 wrote it, got {sight!r}")
    data, kind, renderer, geometry, noise = match.groups()
    for old, new in _CAMERA_NOISE.items():
        noise = (noise or "").replace(old, new)
    camera = "" if kind is None else f"renderer {renderer}, camera model {_CAMERA_MODELS[geometry]}{noise}"
    mode = _CAMERA_DATA[data]
    return {"obs_mode": mode if kind == "alone" else f"state+{mode}", "camera": camera}
