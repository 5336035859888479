"""Check what is in a wheel and a source archive: every source file, the licence, the version, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tomllib
from email.parser import Parser
from pathlib import Path, PurePosixPath
from zipfile import ZipFile

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("vggtgeo", "solvers", "models")


def main(folder: Path) -> None:
    """Check the one wheel and the one source archive in `folder`; exit with the differences."""
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    sources = {PurePosixPath(name) for name in listed if name.split("/")[0] in PACKAGES}
    installed = {name if name.parts[0] == "vggtgeo" else PurePosixPath("vggtgeo", name) for name in sources}
    wrong = []
    with ZipFile(wheel) as file:
        names = file.namelist()
        metadata = Parser().parsestr(file.read(next(name for name in names if name.endswith("/METADATA"))).decode())
    found = {PurePosixPath(name) for name in names if ".dist-info/" not in name}
    wrong += [f"{wheel.name} lacks {name}" for name in sorted(installed - found)]
    wrong += [f"{wheel.name} has {name}" for name in sorted(found - installed)]
    if not any(name.endswith("/licenses/LICENSE") for name in names):
        wrong.append(f"{wheel.name} has no licence")
    expected = {"Name": project["name"], "Version": project["version"], "License-Expression": project["license"]}
    wrong += [f"{key} is {metadata[key]}, not {value}" for key, value in expected.items() if metadata[key] != value]
    extras = set(metadata.get_all("Provides-Extra", []))
    if extras != set(project["optional-dependencies"]):
        wrong.append(f"extras are {sorted(extras)}")
    with tarfile.open(archive) as file:
        packed = {PurePosixPath(*PurePosixPath(name).parts[1:]) for name in file.getnames()}
    needed = sources | {PurePosixPath(name) for name in ("LICENSE", "README.md", "pyproject.toml", "setup.py")}
    wrong += [f"{archive.name} lacks {name}" for name in sorted(needed - packed)]
    if wrong:
        sys.exit("\n".join(wrong))
    print(f"{wheel.name}: {len(found)} files, {archive.name}: {len(packed)}; version {project['version']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
