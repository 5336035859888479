"""How one frame of a bag lies in another, by the messages of `/tf_static` and `/tf`."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.pose_files import poses_of

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of the messages: of ROS 2 and of ROS 1 since 2013, and those before."""
_STEADY = 1e-6
"""Change of a matrix that the digits of a publisher that repeats itself make."""


def frame_name(name: str) -> str:
    """Return a frame without the slash that tf wrote before its name until 2013."""
    return name.strip().lstrip("/")


def motion_between(messages: Iterable[Any], source: str, target: str) -> Float[np.ndarray, "4 4"] | None:
    """Return float64 [4, 4], coordinates of the frame `source` -> those of `target`; None if no transforms connect
    them, or they change with time (two moving bodies).
    """
    steps: dict[str, dict[str, np.ndarray]] = {}
    moving = set()
    for message in messages:
        for one in message.transforms:
            parent, child = frame_name(one.header.frame_id), frame_name(one.child_frame_id)
            pose = _matrix(one.transform)
            known = steps.get(child, {}).get(parent, pose)
            if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1.0) > _STEADY:  # no transform
                continue
            if not np.allclose(pose, known, atol=_STEADY):
                moving.add((parent, child))
            steps.setdefault(child, {})[parent] = pose
            steps.setdefault(parent, {})[child] = np.linalg.inv(pose)
    for parent, child in moving:
        steps[child].pop(parent, None)
        steps[parent].pop(child, None)
    return _along(steps, source, target)


def _along(steps: Mapping[str, Mapping[str, np.ndarray]], source: str, target: str) -> np.ndarray | None:
    reached, waiting = {source: np.eye(4)}, [source]
    while waiting and target not in reached:
        frame = waiting.pop(0)
        for other, step in steps.get(frame, {}).items():
            if other not in reached:
                reached[other] = step @ reached[frame]
                waiting.append(other)
    return reached.get(target)


def _matrix(transform: Any) -> np.ndarray:
    place, turn = transform.translation, transform.rotation
    quaternion = np.array([[turn.x, turn.y, turn.z, turn.w]])
    return poses_of(np.array([[place.x, place.y, place.z]]), quaternion)[0]
