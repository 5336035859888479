"""Which runs make the tables: a plan is a list of jobs, in the order in which a rendered walk serves most of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from vggtgeo.io.errors import InputError
from vggtgeo.paper_bench.courses import Course
from vggtgeo.paper_bench.variants import FULL, VARIANTS

TABLE_6 = (FULL, "A", "B", "C", "D")
OURS = (
    *("pnp", "window-5", "window-15", "huber", "huber-B", "square", "alpha", "formula", "text"),
    *("two-ends", "heavy-lines", "manhattan", "global", "accurate-depth"),
)


@dataclass(frozen=True)
class Job:
    """One run."""

    course: Course
    seed: int
    variant: str

    @property
    def name(self) -> str:
        """Unique within a plan; the name of its file."""
        return f"{self.course.scene}-{self.seed}-{self.variant}"


@dataclass(frozen=True)
class Group:
    """Variants that run on a course for the first `seeds` seeds."""

    course: Course
    variants: tuple[str, ...]
    seeds: int


@dataclass(frozen=True)
class Plan:
    """groups: of runs. first_seed: where the seeds begin."""

    name: str
    groups: tuple[Group, ...]
    first_seed: int = 0

    def jobs(self) -> list[Job]:
        """All runs, each once; those of one scene and seed beside each other."""
        found: dict[str, Job] = {}
        for group in self.groups:
            for seed in range(self.first_seed, self.first_seed + group.seeds):
                for variant in group.variants:
                    job = Job(group.course, seed, variant)
                    found.setdefault(job.name, job)
        scenes = list(dict.fromkeys(group.course.scene for group in self.groups))
        return sorted(found.values(), key=lambda job: (job.seed, scenes.index(job.course.scene)))

    def courses(self) -> list[Course]:
        """The courses, each once."""
        return list(dict.fromkeys(group.course for group in self.groups))

    def limited(
        self,
        scenes: Iterable[str] | None = None,
        variants: Iterable[str] | None = None,
        seeds: int | None = None,
        first_seed: int | None = None,
    ) -> Plan:
        """The part of the plan that is named; None keeps all. Raises InputError where a name is not in the plan."""
        groups = self.groups
        if scenes is not None:
            wanted = _known("scenes", scenes, [group.course.scene for group in groups])
            groups = tuple(group for group in groups if group.course.scene in wanted)
        if variants is not None:
            wanted = _known("variants", variants, [key for group in groups for key in group.variants])
            groups = tuple(replace(g, variants=tuple(key for key in g.variants if key in wanted)) for g in groups)
            groups = tuple(group for group in groups if group.variants)
        if seeds is not None:
            if seeds < 1:
                raise InputError(f"`seeds` is {seeds}; it must be at least 1")
            groups = tuple(replace(group, seeds=seeds) for group in groups)
        if first_seed is not None and first_seed < 0:
            raise InputError(f"`first_seed` is {first_seed}; it must be at least 0")
        return replace(self, groups=groups, first_seed=self.first_seed if first_seed is None else first_seed)


def _known(name: str, wanted: Iterable[str], there: list[str]) -> set[str]:
    chosen = list(wanted)
    unknown = [key for key in chosen if key not in there]
    if unknown or not chosen:
        raise InputError(f"`{name}` holds {unknown or 'nothing'}; choose among {', '.join(dict.fromkeys(there))}")
    return set(chosen)


def _paper(name: str, office: Course, hall: Course, corridor: Course, seeds: int, ours: int) -> Plan:
    groups = (
        Group(office, TABLE_6, seeds),
        Group(hall, (FULL,), seeds),
        Group(corridor, TABLE_6, seeds),
        Group(office, (FULL, *OURS), ours),
        Group(corridor, (FULL, "manhattan", "accurate-depth"), ours),
    )
    assert all(key in VARIANTS for group in groups for key in group.variants)
    return Plan(name, groups)


_QUICK_OFFICE = Course("office", 80, 6.0, keyframe_distance=0.2, keyframe_angle=7.0)
_QUICK_HALL = Course("hall", 60, 5.0, keyframe_distance=0.3, keyframe_angle=7.0)
_LONG_CORRIDOR = Course("corridor", 380, 6.0, key_points=600, keyframe_distance=0.5, keyframe_angle=12.0)

PLANS: dict[str, Plan] = {
    # To see the machinery in a minute; walks of 1.5 m prove nothing.
    "small": Plan(
        "small",
        (
            Group(Course("room", 12, 4.0, (160, 120), key_points=300, keyframe_distance=0.1), (FULL, "A", "C"), 2),
            Group(Course("corridor", 12, 8.0, (160, 120), key_points=300), (FULL, "A", "C"), 2),
        ),
    ),
    "quick": _paper("quick", _QUICK_OFFICE, _QUICK_HALL, _LONG_CORRIDOR, seeds=5, ours=3),
    "full": _paper(
        "full",
        Course("office", 600, 15.0, (640, 480), 1500),
        Course("hall", 600, 15.0, (640, 480), 1500),
        Course("corridor", 975, 15.0, (640, 480), 1500, keyframe_distance=0.2),
        seeds=10,
        ours=5,
    ),
}
