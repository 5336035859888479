"""A walk rendered once for all variants of a seed, and the simulated roles that look at it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.models.stubs import SimulatedDino, SimulatedLetr, SimulatedMast3r, SimulatedMoge, SimulatedVggt
from vggtgeo.paper_bench.courses import Course
from vggtgeo.paper_bench.variants import Variant
from vggtgeo.simulation import SimulatedOracle, simulate
from vggtgeo.slam.settings import Roles


@dataclass(frozen=True, eq=False)
class Stage:
    """A `Sequence` whose frames lie ready, with the truth about them. About 3 MB a frame of 320 x 240."""

    course: Course
    seed: int
    oracle: SimulatedOracle
    rendered: tuple[Frame, ...]

    @classmethod
    def set(cls, course: Course, seed: int) -> Stage:
        """Render the walk. The scene, the walk and all noise follow from `seed`."""
        sequence = simulate(course.scene, course.frames, seed, course.size, rate=course.rate)
        oracle = SimulatedOracle(sequence, kept=course.frames)
        return cls(course, seed, oracle, tuple(oracle.frames()))

    @property
    def name(self) -> str:
        return self.oracle.name

    @property
    def camera(self) -> Camera:
        return self.oracle.camera

    @property
    def has_depth(self) -> bool:
        return self.oracle.has_depth

    def __len__(self) -> int:
        return len(self.rendered)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """The frames at positions start, start + stride, ... below end."""
        check_selection(self.name, len(self), start, end, stride)
        yield from self.rendered[start:end:stride]

    def ground_truth(self) -> Trajectory:
        return self.oracle.ground_truth()

    def roles(self, variant: Variant) -> Roles:
        """The five stubs with their standard error models; the depth's errors times what the variant says."""
        oracle, seed = self.oracle, self.seed
        moge, factor = SimulatedMoge(oracle, seed), variant.depth_errors
        return Roles(
            points=SimulatedMast3r(oracle, seed, count=self.course.key_points),
            lines=SimulatedLetr(oracle, seed),
            depth=replace(moge, error=factor * moge.error, wobble=factor * moge.wobble),
            confidence=SimulatedDino(oracle, seed),
            geometry=variant.start(SimulatedVggt(oracle, seed)),
            alignment=None,  # the paper has none, and the ablation of its start would be none beside one
        )
