"""The list of packages: all below `vggtgeo/`, and `solvers/` and `models/` under their imported names."""

from setuptools import find_packages, setup

setup(
    packages=[
        *find_packages(include=["vggtgeo", "vggtgeo.*"]),
        *(f"vggtgeo.{name}" for name in find_packages(include=["solvers", "solvers.*", "models", "models.*"])),
    ]
)
