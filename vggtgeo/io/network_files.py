"""Find the folder of network files, and download published ones."""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path
from typing import Any

import platformdirs

from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.models.onnx.registry import NETWORKS, HubFile, Network

FOLDER_VARIABLE = "VGGTGEO_MODELS"


def networks_folder(given: Path | None = None) -> Path:
    """Return `given`, else the folder in the variable VGGTGEO_MODELS, else a folder in the user's data folder."""
    if given is not None:
        return given
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named) if named else Path(platformdirs.user_data_dir("vggtgeo")) / "models"


def network_named(name: str) -> Network:
    """Return a network of the registry; raise `InputError` for an unknown name."""
    if name not in NETWORKS:
        raise InputError(f"the network must be one of {', '.join(NETWORKS)}, got `{name}`")
    return NETWORKS[name]


def fetch_network(network: Network, folder: Path, endpoint: str | None = None) -> Path:
    """Download a published ONNX file into `folder`; an interrupted download is resumed.

    The file is moved to its name when its SHA-256 equals that of the registry. endpoint: address of the hub; None for
    the default. Raises `InputError` if the file is not published, the server fails, or the content differs.
    """
    source = network.hub
    target = folder / network.file
    if source is None:
        raise InputError(
            f"`{network.name}` is not published as an ONNX file; export it from a checkout of "
            f"{network.publication.code} and its weights ({network.weights}): {network.export_command}, in `{folder}`"
        )
    if target.exists() and _sha256(target) == source.sha256:
        return target
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f".{network.file}.{source.sha256[:16]}.part"
    _download(network, source, part, endpoint)
    found = _sha256(part)
    if found != source.sha256:
        part.unlink()
        raise InputError(
            f"{_mismatch(source, found)}: the authors replaced the file, or the download was damaged and was deleted; "
            f"try again, {_export_hint(network)}"
        )
    os.replace(part, target)
    return target


def _download(network: Network, source: HubFile, part: Path, endpoint: str | None) -> None:
    """Append the missing bytes to `part`; raise InputError if the server announces another SHA-256.

    `hf_hub_download` of the client is not used, since it discards interrupted downloads.
    """
    hub, http_get, broken = _hub_client()
    try:
        url = hub.hf_hub_url(source.repository, source.path, revision=source.revision, endpoint=endpoint)
        remote = hub.get_hf_file_metadata(url, token=False, endpoint=endpoint)
        announced = remote.etag if len(remote.etag or "") == 64 else None
        if announced not in (None, source.sha256):
            raise InputError(
                f"{_mismatch(source, announced)}: the authors replaced the file; nothing was downloaded; "
                f"{_export_hint(network)}"
            )
        with part.open("ab") as file:
            http_get(remote.location, file, resume_size=file.tell(), expected_size=remote.size)
    except (OSError, hub.errors.HfHubHTTPError, hub.errors.HFValidationError, broken) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"`{source.repository}/{source.path}` could not be downloaded: {reason}; call again to resume"
        ) from error


def _export_hint(network: Network) -> str:
    """Return what to do if the published file has changed."""
    return f"or export it from the weights: {network.export_command} (checkout of {network.publication.code})"


def _mismatch(source: HubFile, found: str | None) -> str:
    return f"`{source.repository}/{source.path}` must have the SHA-256 {source.sha256}, got {found}"


def _hub_client() -> tuple[Any, Any, type[Exception]]:
    """Return the client of the hub, its function to download into an open file, and its connection error."""
    try:
        import huggingface_hub
        from huggingface_hub.file_download import http_get
    except ImportError:
        raise InputError(f"`vggtgeo models fetch` needs the package huggingface-hub; {install_hint('fetch')}") from None
    # The client raises errors of its HTTP library, which differs between versions of the client.
    library = type(huggingface_hub.get_session()).__module__.split(".")[0]
    return huggingface_hub, http_get, sys.modules[library].HTTPError


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
