"""Callbacks of a run: its own recorders and the user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind
from vggtgeo.results.checkpoints import RunSoFar
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.perception.rgbd_alignment import compile_alignment
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.window.sliding_window import warm_up


@dataclass(frozen=True, eq=False)
class RunCallbacks:
    """All callbacks of a run; their time is measured as a stage of its own."""

    members: tuple[Callback, ...]
    clock: Clock

    def __post_init__(self) -> None:
        for member in self.members:
            check_kind("callbacks", member, Callback, "instances of `vggtgeo.Callback`")

    def warm_up(self, settings: SlamSettings, roles: Roles, camera: Camera) -> None:
        """Compile the window adjustment, the RGB-D alignment, and what the callbacks compute from windows."""
        self.each("on_stage", "compiling")
        compiled = warm_up(settings, roles.metric)
        if roles.alignment is not None and roles.metric:
            compile_alignment(camera)
        for member in self.members:
            member.on_warm_up(*compiled)

    def so_far(self) -> dict[str, Any]:
        """Return the state of each callback that has one, by class name, for a checkpoint."""
        found = {type(member).__name__: member.so_far() for member in self.members}
        return {name: value for name, value in found.items() if value is not None}

    def resume(self, before: RunSoFar) -> None:
        """Restore each callback from a checkpoint; raise InputError for a state of another type."""
        for member in self.members:
            name = type(member).__name__
            kept, fresh = before.callbacks.get(name), member.so_far()
            if fresh is not None and not isinstance(kept, type(fresh)):
                raise InputError(
                    f"`{name}` in the checkpoint must be {type(fresh).__name__}, got {type(kept).__name__}: start "
                    "again with `--no-resume`"
                )
            member.on_resume(kept, before.slam)

    def each(self, hook: str, *arguments: Any) -> None:
        """Call a hook of every callback."""
        with self.clock.measure("record and draw"):
            for member in self.members:
                getattr(member, hook)(*arguments)
