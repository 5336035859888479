"""Which topics of a bag are the images, their depth, and the truth."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vggtgeo.datasets.bag_images import COLOUR, DEPTH, GREY, Unread, encoding_of, kind_of
from vggtgeo.io.errors import InputError

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSES = ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")
_TRUTH = ("truth", "gt", "vicon", "mocap")
_REGISTERED = re.compile(r"registered|aligned(?!_depth_to_)|to_(rgb|colou?r)", re.IGNORECASE)
"""Depth that belongs to the colour camera pixel by pixel, by the names of RealSense's, OpenNI's and Azure's drivers."""
_INFRARED = re.compile(r"(^|[/_])(ir|infra\d?|infrared)([/_\d]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class Chosen:
    """Names of topics, "" for none. others: topics of the same kinds that are not read."""

    colour: str
    depth: str
    others: tuple[str, ...]


def chosen_topics(path: Path, first: Mapping[str, Any]) -> Chosen:
    """Return the best topic of images in colour, and the best of depth, by the first message of each.

    Colour goes before grey and infrared, depth that is registered to the colour camera before any other; then the
    order of their names. InputError where none is an image that can be read, with what they are.
    """
    depths = {name: _rank_of_depth(name) for name, message in first.items() if _is_depth(name, message)}
    images = {name: rank for name, message in first.items() if (rank := _rank_of_image(name, message)) is not None}
    images = {name: rank for name, rank in images.items() if name not in depths}
    if not images:
        found = ", ".join(f"`{name}` ({kind_of(message)})" for name, message in first.items()) or "none"
        raise InputError(
            f"`{path}` has no topic with images in colour or grey that can be read; its topics of images: {found}; "
            f"convert to what is read: JPEG, PNG, {', '.join(COLOUR)}"
        )
    colour, depth = _best(images), _best(depths)
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """Return the first topic of poses whose name says that they are the truth; topics: types by name."""
    named = (name for name, kind in topics.items() if kind in POSES and any(word in name.lower() for word in _TRUTH))
    return next(named, "")


def is_registered(topic: str) -> bool:
    """Return whether the name of a topic of depth says that it belongs to the colour camera pixel by pixel."""
    return bool(_REGISTERED.search(topic))


def _best(ranks: Mapping[str, tuple[int, ...]]) -> str:
    return min(sorted(ranks), key=lambda name: ranks[name], default="")


def _is_depth(name: str, message: Any) -> bool:
    """Return whether a topic is depth: by its encoding; 16 bits of grey (mono16) by the name of the topic.

    Old drivers gave depth as mono16.
    """
    if message is None or isinstance(message, Unread) or _INFRARED.search(name):
        return False
    if not hasattr(message, "encoding") and "compresseddepth" in f"{name} {message.format}".lower():
        return True
    encoding = encoding_of(message)
    return encoding in DEPTH and (encoding != "mono16" or "depth" in name.lower())


def _rank_of_depth(name: str) -> tuple[int]:
    return (0 if is_registered(name) else 1,)


def _rank_of_image(name: str, message: Any) -> tuple[int, int, int] | None:
    """Rank a message by its image; None without an image in colour or grey.

    Last are infrared, then depth in false colours, then grey.
    """
    if message is None or isinstance(message, Unread):
        return None
    encoding = encoding_of(message)
    if hasattr(message, "encoding") and encoding not in COLOUR:
        return None
    return int(bool(_INFRARED.search(name))), int("depth" in name.lower()), int(encoding in GREY)


def described_choice(chosen: Chosen, poses: str) -> str:
    """Describe what was chosen; empty if there was no choice. poses: the topic of the truth, "" for none."""
    if not chosen.others:
        return ""
    depth = f", depth of `{chosen.depth}`" if chosen.depth else ", no depth"
    truth = f", truth of `{poses}`" if poses else ""
    left = ", ".join(f"`{name}`" for name in chosen.others[:6]) + (", ..." if len(chosen.others) > 6 else "")
    return f"images of `{chosen.colour}`{depth}{truth}; not read: {left}"
