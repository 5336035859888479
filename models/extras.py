"""How an optional package is installed: one sentence for all who need one."""


def install_hint(extra: str) -> str:
    """What to do to have the packages of an extra of `pyproject.toml`, in a clone and with a released package."""
    clone, release = f"pip install -e '.[{extra}]'", f"pip install 'vggtgeo[{extra}]'"
    return f"install the extra `{extra}`: `{clone}` in a clone, `{release}` elsewhere"
