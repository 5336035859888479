"""Where the networks' files lie, and the one way they are ever downloaded."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import platformdirs

from vggtgeo.errors import InputError
from vggtgeo.models.onnx.registry import NETWORKS, HubFile, Network

FOLDER_VARIABLE = "VGGTGEO_MODELS"


def networks_folder(given: Path | None = None) -> Path:
    """The folder given, else that of the environment variable VGGTGEO_MODELS, else one in the user's data."""
    if given is not None:
        return given
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named) if named else Path(platformdirs.user_data_dir("vggtgeo")) / "models"


def network_named(name: str) -> Network:
    """The entry of the registry; `InputError` for a name that is not there."""
    if name not in NETWORKS:
        raise InputError(f"`{name}` is no network; it must be one of {', '.join(NETWORKS)}")
    return NETWORKS[name]


def fetch_network(network: Network, folder: Path, endpoint: str | None = None) -> Path:
    """Download a published ONNX file into `folder`; a broken download goes on where it stopped.

    The file takes its name only when its SHA-256 is that of the registry. endpoint: address of the hub, None for the
    hub's own. Raises `InputError` where there is nothing to download, the server fails, or the content is another.
    """
    source = network.hub
    target = folder / network.file
    if source is None:
        raise InputError(
            f"`{network.name}` is not published as an ONNX file; export it: vggtgeo models export "
            f"{network.contract_name} --source CHECKOUT of {network.code} --checkpoint FILE -o {target}"
        )
    if target.exists() and _sha256(target) == source.sha256:
        return target
    folder.mkdir(parents=True, exist_ok=True)
    arrived = _download(source, folder / ".fetch" / network.name, endpoint)
    found = _sha256(arrived)
    if found != source.sha256:
        arrived.unlink()
        raise InputError(
            f"`{source.repository}/{source.path}` has the SHA-256 {found}, expected {source.sha256}: the download was "
            "damaged or the file was changed; nothing was kept, try again"
        )
    os.replace(arrived, target)
    return target


def _download(source: HubFile, folder: Path, endpoint: str | None) -> Path:
    hub = _hub_client()
    try:
        path = hub.hf_hub_download(
            source.repository, source.path, revision=source.revision, local_dir=folder, endpoint=endpoint
        )
    except (OSError, hub.errors.HfHubHTTPError, hub.errors.HFValidationError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"`{source.repository}/{source.path}` could not be downloaded: {reason}; try again") from error
    return Path(path)


def _hub_client() -> Any:
    try:
        import huggingface_hub
    except ImportError:
        raise InputError("fetching needs the package huggingface-hub; install it: pip install vggtgeo[fetch]") from None
    return huggingface_hub


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
