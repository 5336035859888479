"""The built-in worlds by name: how each is built, and how it is walked through."""

from __future__ import annotations

from collections.abc import Callable

from vggtgeo.simulation.building import BUILDING_WALK, build_building
from vggtgeo.simulation.corridor import CORRIDOR_WALK, build_corridor
from vggtgeo.simulation.hall import HALL_WALK, build_hall
from vggtgeo.simulation.office import OFFICE_WALK, build_office
from vggtgeo.simulation.room import ROOM_WALK, build_room
from vggtgeo.simulation.scene import Scene
from vggtgeo.simulation.staircase import STAIRCASE_WALK, build_staircase
from vggtgeo.simulation.trajectories import Walk

WORLDS: dict[str, tuple[Callable[[int], Scene], Walk]] = {
    "room": (build_room, ROOM_WALK),
    "office": (build_office, OFFICE_WALK),
    "hall": (build_hall, HALL_WALK),
    "corridor": (build_corridor, CORRIDOR_WALK),
    "staircase": (build_staircase, STAIRCASE_WALK),
    "building": (build_building, BUILDING_WALK),
}
