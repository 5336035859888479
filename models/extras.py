"""How an optional package is installed, or put back: one sentence for all who need one."""


def install_hint(extra: str) -> str:
    """What to do to have the packages of an extra of `pyproject.toml`, in a clone and with a released package."""
    clone, release = f"pip install -e '.[{extra}]'", f"pip install 'vggtgeo[{extra}]'"
    return f"install the extra `{extra}`: `{clone}` in a clone, `{release}` elsewhere"


def put_back_hint(package: str, version: str) -> str:
    """Return how to restore a package whose files another package has overwritten."""
    return f"`pip install --force-reinstall --no-deps {package}=={version}` puts them back"
