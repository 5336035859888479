"""Dense indoor SLAM with a functional, differentiable bundle adjustment in JAX.

`import vggtgeo as vg` is all a user needs; each name is loaded when it is first asked for, so that the program's
`--help` imports neither JAX nor OpenCV.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from vggtgeo import _source_tree as _source_tree  # first: in a source tree it finds `solvers` and `models`

if TYPE_CHECKING:
    from vggtgeo import learning as learning
    from vggtgeo.benchmark.runner import BenchReport as BenchReport
    from vggtgeo.benchmark.runner import bench as bench
    from vggtgeo.bundle.analysis.covariances import Covariances as Covariances
    from vggtgeo.bundle.analysis.covariances import covariances as covariances
    from vggtgeo.bundle.analysis.observability import observability as observability
    from vggtgeo.bundle.analysis.observability_report import Observability as Observability
    from vggtgeo.bundle.batches import pack_batch as pack_batch
    from vggtgeo.bundle.batches import solve_batch as solve_batch
    from vggtgeo.bundle.graduation import Graduation as Graduation
    from vggtgeo.bundle.marginalisation import marginalise as marginalise
    from vggtgeo.bundle.marginalisation import no_prior as no_prior
    from vggtgeo.bundle.marginalisation import reorder as reorder
    from vggtgeo.bundle.objective import energy as energy
    from vggtgeo.bundle.objective import energy_terms as energy_terms
    from vggtgeo.bundle.observations import FlatTerm as FlatTerm
    from vggtgeo.bundle.observations import Observations as Observations
    from vggtgeo.bundle.packing import pack as pack
    from vggtgeo.bundle.padding import PaddedSize as PaddedSize
    from vggtgeo.bundle.padding import SlotIndex as SlotIndex
    from vggtgeo.bundle.problem import Problem as Problem
    from vggtgeo.bundle.problem import State as State
    from vggtgeo.bundle.problem_file import load_problem as load_problem
    from vggtgeo.bundle.problem_file import save_problem as save_problem
    from vggtgeo.bundle.residuals import ResidualSizes as ResidualSizes
    from vggtgeo.bundle.residuals import residual_sizes as residual_sizes
    from vggtgeo.bundle.residuals import residuals_at as residuals_at
    from vggtgeo.bundle.sliding import slide as slide
    from vggtgeo.bundle.solution import Solution as Solution
    from vggtgeo.bundle.solution import solve as solve
    from vggtgeo.bundle.solver_choice import choose_reduced_solver as choose_reduced_solver
    from vggtgeo.bundle.terms.baseline import BaselinePrior as BaselinePrior
    from vggtgeo.bundle.terms.depth import DepthPrior as DepthPrior
    from vggtgeo.bundle.terms.edge import EdgeTerm as EdgeTerm
    from vggtgeo.bundle.terms.edge import ImageTerm as ImageTerm
    from vggtgeo.bundle.terms.host_pixel import HostPixel as HostPixel
    from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior as IntrinsicsPrior
    from vggtgeo.bundle.terms.line import LineTerm as LineTerm
    from vggtgeo.bundle.terms.marginal import MarginalPrior as MarginalPrior
    from vggtgeo.bundle.terms.node import CameraTerm as CameraTerm
    from vggtgeo.bundle.terms.node import DenseTerm as DenseTerm
    from vggtgeo.bundle.terms.node import PairTerm as PairTerm
    from vggtgeo.bundle.terms.node import PoseTerm as PoseTerm
    from vggtgeo.bundle.terms.point import PointTerm as PointTerm
    from vggtgeo.bundle.terms.relative_pose import RelativePose as RelativePose
    from vggtgeo.bundle.terms.rotation import RotationPrior as RotationPrior
    from vggtgeo.bundle.terms.slot import SlotTerm as SlotTerm
    from vggtgeo.bundle.terms.term import AbstractTerm as AbstractTerm
    from vggtgeo.bundle.terms.term import shared_field as shared_field
    from vggtgeo.bundle.terms.view import View as View
    from vggtgeo.datasets import Frame as Frame
    from vggtgeo.datasets import open_sequence as open_sequence
    from vggtgeo.evaluation import evaluate_trajectory as evaluate_trajectory
    from vggtgeo.figures.plot import plot as plot
    from vggtgeo.geometry.camera import Camera as Camera
    from vggtgeo.geometry.cameras import AbstractCamera as AbstractCamera
    from vggtgeo.geometry.cameras import KannalaBrandt as KannalaBrandt
    from vggtgeo.geometry.cameras import Pinhole as Pinhole
    from vggtgeo.geometry.cameras import RadialTangential as RadialTangential
    from vggtgeo.geometry.cameras import SquareKannalaBrandt as SquareKannalaBrandt
    from vggtgeo.geometry.cameras import SquarePinhole as SquarePinhole
    from vggtgeo.geometry.cameras import SquarePixels as SquarePixels
    from vggtgeo.geometry.cameras import SquareRadialTangential as SquareRadialTangential
    from vggtgeo.geometry.trajectory import Trajectory as Trajectory
    from vggtgeo.io.errors import InputError as InputError
    from vggtgeo.learning.window_dataset import RunWindows as RunWindows
    from vggtgeo.learning.window_dataset import WindowDataset as WindowDataset
    from vggtgeo.learning.window_dataset import WindowWriter as WindowWriter
    from vggtgeo.learning.window_dataset import stack_windows as stack_windows
    from vggtgeo.mapping.fusion import SurfaceFusion as SurfaceFusion
    from vggtgeo.results.checkpoints import Checkpoints as Checkpoints
    from vggtgeo.results.reading import evaluate as evaluate
    from vggtgeo.results.reading import read as read
    from vggtgeo.results.reconstruction import reconstruct as reconstruct
    from vggtgeo.results.result import Result as Result
    from vggtgeo.simulation import SimulatedWindow as SimulatedWindow
    from vggtgeo.simulation import simulate as simulate
    from vggtgeo.simulation import simulate_window as simulate_window
    from vggtgeo.slam.callback import Callback as Callback
    from vggtgeo.slam.run import finish as finish
    from vggtgeo.slam.run import frame_trajectory as frame_trajectory
    from vggtgeo.slam.run import run as run
    from vggtgeo.slam.settings.groups import CameraSettings as CameraSettings
    from vggtgeo.slam.settings.groups import DepthSettings as DepthSettings
    from vggtgeo.slam.settings.groups import KeyframeSettings as KeyframeSettings
    from vggtgeo.slam.settings.groups import LineSettings as LineSettings
    from vggtgeo.slam.settings.groups import MatchingSettings as MatchingSettings
    from vggtgeo.slam.settings.groups import RefinementSettings as RefinementSettings
    from vggtgeo.slam.settings.groups import TrackingSettings as TrackingSettings
    from vggtgeo.slam.settings.groups import WeightSettings as WeightSettings
    from vggtgeo.slam.settings.groups import WindowSettings as WindowSettings
    from vggtgeo.slam.settings.presets import perception as perception
    from vggtgeo.slam.settings.slam_settings import Roles as Roles
    from vggtgeo.slam.settings.slam_settings import SlamSettings as SlamSettings
    from vggtgeo.slam.sparse_map.known_map import load_map as load_map
    from vggtgeo.slam.verdict.finding import Verdict as Verdict
    from vggtgeo.slam.verdict.witness import EvidenceRecorder as EvidenceRecorder
    from vggtgeo.solvers.adjoint import ArrowAdjoint as ArrowAdjoint
    from vggtgeo.solvers.kernels import AbstractKernel as AbstractKernel
    from vggtgeo.solvers.kernels import Barron as Barron
    from vggtgeo.solvers.kernels import Cauchy as Cauchy
    from vggtgeo.solvers.kernels import GemanMcClure as GemanMcClure
    from vggtgeo.solvers.kernels import Huber as Huber
    from vggtgeo.solvers.kernels import Square as Square
    from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt as SchurLevenbergMarquardt

_HOME = {
    "bundle.batches": ("pack_batch", "solve_batch"),
    "figures.plot": ("plot",),
    "geometry.camera": ("Camera",),
    "datasets": ("Frame", "open_sequence"),
    "bundle.objective": ("energy", "energy_terms"),
    "io.errors": ("InputError",),
    "evaluation": ("evaluate_trajectory",),
    "bundle.graduation": ("Graduation",),
    "bundle.terms.baseline": ("BaselinePrior",),
    "bundle.terms.depth": ("DepthPrior",),
    "bundle.terms.host_pixel": ("HostPixel",),
    "bundle.terms.edge": ("EdgeTerm", "ImageTerm"),
    "bundle.terms.intrinsics": ("IntrinsicsPrior",),
    "bundle.terms.line": ("LineTerm",),
    "bundle.terms.marginal": ("MarginalPrior",),
    "bundle.terms.node": ("CameraTerm", "DenseTerm", "PairTerm", "PoseTerm"),
    "bundle.terms.point": ("PointTerm",),
    "bundle.terms.relative_pose": ("RelativePose",),
    "bundle.terms.rotation": ("RotationPrior",),
    "bundle.terms.slot": ("SlotTerm",),
    "bundle.terms.term": ("AbstractTerm", "shared_field"),
    "bundle.terms.view": ("View",),
    "geometry.cameras": (
        *("AbstractCamera", "KannalaBrandt", "Pinhole", "RadialTangential"),
        *("SquareKannalaBrandt", "SquarePinhole", "SquarePixels", "SquareRadialTangential"),
    ),
    "bundle.marginalisation": ("marginalise", "no_prior", "reorder"),
    "bundle.analysis.observability": ("observability",),
    "bundle.analysis.observability_report": ("Observability",),
    "bundle.observations": ("FlatTerm", "Observations"),
    "bundle.packing": ("pack",),
    "bundle.padding": ("PaddedSize", "SlotIndex"),
    "benchmark.runner": ("BenchReport", "bench"),
    "bundle.problem": ("Problem", "State"),
    "bundle.problem_file": ("load_problem", "save_problem"),
    "bundle.residuals": ("ResidualSizes", "residual_sizes", "residuals_at"),
    "learning.window_dataset": ("RunWindows", "WindowDataset", "WindowWriter", "stack_windows"),
    "mapping.fusion": ("SurfaceFusion",),
    "results.result": ("Result",),
    "results.reading": ("evaluate", "read"),
    "results.reconstruction": ("reconstruct",),
    "simulation": ("SimulatedWindow", "simulate", "simulate_window"),
    "slam.callback": ("Callback",),
    "results.checkpoints": ("Checkpoints",),
    "slam.sparse_map.known_map": ("load_map",),
    "slam.settings.presets": ("perception",),
    "slam.run": ("finish", "frame_trajectory", "run"),
    "slam.settings.groups": (
        "CameraSettings",
        "WeightSettings",
        "DepthSettings",
        "KeyframeSettings",
        "LineSettings",
        "MatchingSettings",
        "RefinementSettings",
        "TrackingSettings",
        "WindowSettings",
    ),
    "slam.settings.slam_settings": ("Roles", "SlamSettings"),
    "slam.verdict.witness": ("EvidenceRecorder",),
    "slam.verdict.finding": ("Verdict",),
    "bundle.sliding": ("slide",),
    "bundle.solution": ("Solution", "solve"),
    "bundle.solver_choice": ("choose_reduced_solver",),
    "solvers.adjoint": ("ArrowAdjoint",),
    "solvers.kernels": ("AbstractKernel", "Barron", "Cauchy", "GemanMcClure", "Huber", "Square"),
    "solvers.levenberg_marquardt": ("SchurLevenbergMarquardt",),
    "geometry.trajectory": ("Trajectory",),
    "bundle.analysis.covariances": ("Covariances", "covariances"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

_PACKAGES = ("learning",)
"""Reached as `vggtgeo.learning.train`, say: what is research on top of the library."""

__all__ = sorted(_MODULE_OF)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return importlib.import_module(f"vggtgeo.{name}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module `vggtgeo` has no attribute `{name}`")
    return getattr(importlib.import_module(f"vggtgeo.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, *_PACKAGES]
