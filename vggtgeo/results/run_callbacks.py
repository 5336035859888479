"""What is called while a run goes on: its own witnesses, and what the caller gave."""

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
    """All callbacks of a run, their time measured apart from that of the run."""

    members: tuple[Callback, ...]
    clock: Clock

    def __post_init__(self) -> None:
        for member in self.members:
            check_kind("callbacks", member, Callback, "objects of `vggtgeo.Callback` in it")

    def warm_up(self, settings: SlamSettings, roles: Roles, camera: Camera) -> None:
        """Compile what every window needs, every alignment with depth, and what the callbacks make of windows."""
        self.each("on_stage", "compiling")
        compiled = warm_up(settings, roles.metric)
        if roles.alignment is not None and roles.metric:
            compile_alignment(camera)
        for member in self.members:
            member.on_warm_up(*compiled)

    def so_far(self) -> dict[str, Any]:
        """What those that have something to keep give, by the names of their classes."""
        found = {type(member).__name__: member.so_far() for member in self.members}
        return {name: value for name, value in found.items() if value is not None}

    def resume(self, before: RunSoFar) -> None:
        """Each goes on from what it gave; InputError where that is something else than what it gives."""
        for member in self.members:
            name = type(member).__name__
            kept, fresh = before.callbacks.get(name), member.so_far()
            if fresh is not None and not isinstance(kept, type(fresh)):
                raise InputError(
                    f"the run that was killed kept {type(kept).__name__} of `{name}`; expected "
                    f"{type(fresh).__name__}: begin anew with `--no-resume`"
                )
            member.on_resume(kept, before.slam)

    def each(self, hook: str, *arguments: Any) -> None:
        """Call one hook of every member."""
        with self.clock.measure("record and draw"):
            for member in self.members:
                getattr(member, hook)(*arguments)
