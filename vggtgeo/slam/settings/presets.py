"""Presets: which implementation plays each perception role. The one place where networks become role objects.

| role | classical | light | paper |
|---|---|---|---|
| point matches | SIFT | SIFT | MASt3R |
| line segments | LSD | M-LSD tiny | LETR |
| line matches | bands of gradients | DINOv3 S along the segments | DINOv3 L along the segments |
| metric depth | the sensor's | MoGe-2 S | MoGe-2 L |
| dense confidence | structure tensor | DINOv3 S | DINOv3 L |
| initial geometry | PnP, two views | PnP, two views | VGGT, judged by PnP |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

from vggtgeo.io.argument_checks import check_kind, check_positive, path_of
from vggtgeo.io.errors import InputError
from vggtgeo.io.network_files import networks_folder
from vggtgeo.models.classical import ConstantVelocity, OrbMatcher
from vggtgeo.models.onnx.bounds import (
    BoundedConfidence,
    BoundedDepth,
    BoundedLineMatcher,
    BoundedLines,
    BoundedPoints,
    BoundedWindow,
    Refusals,
)
from vggtgeo.models.onnx.cache import FolderCache, MemoryCache, OutputCache
from vggtgeo.models.onnx.contracts import NetworkFileError
from vggtgeo.models.onnx.dinov3 import DenseLineMatcher, DinoFeatures
from vggtgeo.models.onnx.line_detectors import LetrDetector, MlsdDetector
from vggtgeo.models.onnx.moge2 import MogeDepth
from vggtgeo.models.onnx.point_matchers import DensePointMatcher, Mast3rMatcher
from vggtgeo.models.onnx.registry import NETWORKS, files_of, players
from vggtgeo.models.onnx.session import Provider, Session, open_session
from vggtgeo.models.onnx.vggt import VggtWindow
from vggtgeo.models.window_locator import WindowLocator
from vggtgeo.slam.settings.slam_settings import Roles

PRESETS: dict[str, dict[str, str]] = {
    "classical": {},
    "light": {
        "line_matches": "dinov3-small",
        "confidence": "dinov3-small",
        "depth": "moge2-small",
        "lines": "mlsd",
    },
    "paper": {
        "geometry": "vggt",
        "line_matches": "dinov3",
        "confidence": "dinov3",
        "depth": "moge2",
        "lines": "letr",
        "points": "mast3r",
    },
}
"""The networks of each preset, by role."""
_OTHERS = {"points": ("orb",), "geometry": ("constant-velocity",)}
"""Classical implementations that are not the default."""
CHOICES = {
    role: ("classical", *_OTHERS.get(role, ()), *players(role))
    for role in ("points", "lines", "line_matches", "confidence", "geometry", "depth")
}
"""Choices for each role besides a preset's: the caller's own (`classical`), other classical implementations, networks.
"""
_BOUNDED: dict[str, Callable[[Any], Any]] = {
    "points": BoundedPoints,
    "lines": BoundedLines,
    "line_matches": BoundedLineMatcher,
    "depth": BoundedDepth,
    "confidence": BoundedConfidence,
}
"""Checks of the answers of a network in each role."""
_KINDS: dict[str, Callable[..., Any]] = {
    "alike": DensePointMatcher,
    "letr": LetrDetector,
    "mlsd": MlsdDetector,
    "moge2": MogeDepth,
    "xfeat": DensePointMatcher,
}
"""Adapters of one file for one role, by contract."""


def _files(roles: Mapping[str, str]) -> tuple[str, ...]:
    """Return the registry's names of the networks of some roles, each once."""
    return tuple(dict.fromkeys(file for name in roles.values() for file in files_of(name)))


NEEDED = {preset: _files(roles) for preset, roles in PRESETS.items()}
"""The networks of each preset, by their names in the registry."""


@dataclass(frozen=True, eq=False)
class Perception:
    """Role objects and the networks behind them, by their names in the registry; and the rejected answers, by role."""

    roles: Roles
    networks: Mapping[str, Session]
    refusals: Mapping[str, Refusals] = field(default_factory=dict)

    @property
    def random(self) -> list[str]:
        """Names of the networks whose weights are random."""
        return [name for name, session in self.networks.items() if session.random_weights]

    def facts(self) -> dict[str, Any]:
        """Return facts for the summary: each network's file, hash, weights, device, calls so far; and a warning, if
        any.
        """
        if not self.networks:
            return {}
        described = {
            name: {
                "file": session.path.name,
                "sha256": session.digest,
                "weights": session.metadata.get("vggtgeo.weights", "as published"),
                "runs_on": session.provider,
                "calls": session.tally.calls,
                "seconds": round(session.tally.seconds, 3),
            }
            for name, session in self.networks.items()
        }
        warning = {"meaningless": self.warning()} if self.random else {}
        refused = {role: asdict(counts) for role, counts in self.refusals.items()}
        return {"networks": described, "refused": refused, **warning}

    def warning(self) -> str:
        """Return a warning about results of random weights."""
        return f"the weights of {', '.join(self.random)} are random: this result means nothing"


def perception(
    preset: str = "classical",
    classical: Roles | None = None,
    folder: Path | None = None,
    cache: Path | None = None,
    provider: Provider = "auto",
    memory_limit_gb: float | None = None,
    mixed: Mapping[str, str] | None = None,
) -> Perception:
    """Return the roles of a preset, for `vggtgeo.reconstruct`; every file is opened, checked and warmed up here.

    Args:
        preset: classical, light or paper.
        classical: the roles that the preset has no network for; by default those with the sensor's depth.
        folder: of the networks' files; by default that of VGGTGEO_MODELS, else one in the user's data.
        cache: folder for what the networks answer; by default nothing is kept beyond the run.
        provider: where networks run: auto, cuda or cpu.
        memory_limit_gb: most GPU memory of each network.
        mixed: who plays a role in place of the preset's choice, by role, as `CHOICES` lists: `{"lines": "mlsd"}`.

    Raises:
        InputError: an unknown preset, a missing file, or a wrong one.

    Example:
        >>> import vggtgeo as vg
        >>> vg.perception("classical").roles.metric
        True

    """
    check_kind("mixed", mixed, Mapping | None, "a dictionary of names by role, or None")
    check_kind("classical", classical, Roles | None, "`vggtgeo.Roles`, or None")
    folder, cache = (
        None if given is None else path_of(name, given) for name, given in (("folder", folder), ("cache", cache))
    )
    if memory_limit_gb is not None:
        check_positive("memory_limit_gb", memory_limit_gb, "gigabytes")
    if provider not in get_args(Provider):
        raise InputError(f"`provider` must be one of {', '.join(get_args(Provider))}, got {provider!r:.60}")
    chosen = _parts(preset, mixed or {})
    classical = classical or Roles()
    if chosen.get("points") == "orb":
        classical = replace(classical, points=OrbMatcher())
    if chosen.get("geometry") == "constant-velocity":
        # The ablation is a start by motion alone: nothing else may mend the pose before the window does.
        classical = replace(classical, geometry=ConstantVelocity(), alignment=None)
    parts = {role: name for role, name in chosen.items() if name not in ("classical", *_OTHERS.get(role, ()))}
    if not parts:
        return Perception(classical, {})
    place = networks_folder(folder)
    files = {name: place / NETWORKS[name].file for name in _files(parts)}
    if missing := [file.name for file in files.values() if not file.is_file()]:
        raise InputError(
            f"what was chosen needs {', '.join(missing)}, not found in `{place}`; `vggtgeo models list` tells how to "
            "get each"
        )
    limits: dict[str, Any] = {"provider": provider, "memory_limit_gb": memory_limit_gb}
    networks = {name: open_session(file, NETWORKS[name].contract, **limits) for name, file in files.items()}
    players, refusals = _players(parts, classical, networks, cache)
    for session in networks.values():
        session.warm_up()
    return Perception(replace(classical, **players), networks, refusals)


def _parts(preset: str, mixed: Mapping[str, str]) -> dict[str, str]:
    """Return the implementation of each role that preset or caller name; raise InputError for an unknown name."""
    if preset not in tuple(PRESETS):  # a list has no hash
        raise InputError(f"`preset` must be one of {', '.join(PRESETS)}, got {preset!r}")
    for role, name in mixed.items():
        if name not in CHOICES.get(role, ()):
            known = "; ".join(f"{role}: {', '.join(names)}" for role, names in CHOICES.items())
            raise InputError(f"`{role}` is {name!r}; what can be mixed is {known}")
    return {**PRESETS[preset], **mixed}


def _players(
    parts: Mapping[str, str], classical: Roles, networks: Mapping[str, Session], cache: Path | None
) -> tuple[dict[str, Any], dict[str, Refusals]]:
    """Return the role objects of the networks, and their checks.

    One network in two roles answers both from one call.
    """

    def store() -> OutputCache:
        return MemoryCache() if cache is None else FolderCache(cache)

    features = {name: DinoFeatures(networks[name], store()) for name in parts.values() if name.startswith("dinov3")}

    def player(role: str, name: str) -> Any:
        if name in features:
            return DenseLineMatcher(features[name]) if role == "line_matches" else features[name]
        if name == "mast3r":
            return Mast3rMatcher(networks["mast3r_encoder"], networks["mast3r_decoder"], store())
        return _KINDS[NETWORKS[name].contract_name](session=networks[name], cache=store())

    bounded = {role: _BOUNDED[role](player(role, name)) for role, name in parts.items() if role in _BOUNDED}
    refusals = {role: part.refusals for role, part in bounded.items()}
    if "geometry" in parts:
        model = VggtWindow(networks[parts["geometry"]], store())
        if model.views is not None and model.views < 2:
            raise NetworkFileError(
                f"`{model.session.path}` takes {model.views} image at a time, expected at least 2, a keyframe and the "
                "frame; export it again with `--views 4`"
            )
        window = BoundedWindow(model)
        bounded["geometry"] = WindowLocator(window, classical.geometry, views=model.views)
        refusals["geometry"] = window.refusals
    if parts.get("points") == "mast3r" or "geometry" in parts:  # these ask for every frame's own points
        bounded["flow"] = None
    return bounded, refusals
