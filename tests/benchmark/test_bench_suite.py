"""Suites: what their files may say, and the runs that follow from them."""

from dataclasses import replace
from pathlib import Path

import tiny_sequences
import tiny_suites as tiny
from reported import raises

from vggtgeo.benchmark.inputs import find_sequences
from vggtgeo.benchmark.jobs import jobs_of
from vggtgeo.benchmark.provenance import input_hash, source_digest
from vggtgeo.benchmark.suite import load_suite, read_suite, restrict, shipped
from vggtgeo.benchmark.tables import published

WANTED = {"paper", "tum", "7scenes", "euroc", "replica", "tanks", "simulated", "stress", "quick", "clips"}


def test_every_suite_that_comes_along_can_be_read() -> None:
    # Proves that the shipped files are right, their settings and their published tables too. Oracle: the checks of the
    # pipeline's settings, made when a suite is read; the list of the documentation.
    assert set(shipped()) >= WANTED
    for name in shipped():
        suite = load_suite(name)
        assert suite.title
        assert len({job.name for job in jobs_of(suite, ())}) == len(jobs_of(suite, ()))
        for table in suite.published:
            assert published(table).lines


def test_runs_are_settings_upon_the_sequence_upon_the_suite() -> None:
    # Proves the order in which settings of the pipeline are laid over each other, and seeds. Oracle: by hand.
    text = tiny.TEXT.replace("seeds = 3", "seeds = 3\nfirst_seed = 7")
    text = text.replace("\n[[seq", "\n[set.window]\nsize = 6\npoint_slots = 50\n\n[[seq", 1)
    text = text.replace("frames = 4 }\n\n[[seq", "frames = 4 }\n[sequence.set.window]\nsize = 7\n\n[[seq", 1)
    text += "[setting.set.window]\npoint_slots = 40\n"
    jobs = tiny.jobs(text)
    assert [job.name for job in jobs[:4]] == ["walk.full.7", "walk.bare.7", "walk.full.8", "walk.bare.8"]
    walk, bare = jobs[0].spec["set"], jobs[1].spec["set"]
    assert walk == {"window": {"size": 7, "point_slots": 50}}
    assert bare == {"line": {"use_lines": False}, "window": {"size": 7, "point_slots": 40}}


def test_a_fingerprint_changes_with_what_a_result_depends_on(tmp_path: Path) -> None:
    # Proves that settings, seed, code and the content of a recording count, and where it lies does not.
    jobs = tiny.jobs()
    prints = {job.fingerprint("a") for job in jobs} | {jobs[0].fingerprint("b")}
    assert len(prints) == len(jobs) + 1
    moved = replace(jobs[0], spec={**jobs[0].spec, "path": "/elsewhere"})
    assert moved.fingerprint("a") == jobs[0].fingerprint("a")
    folder = tiny_sequences.tum(tmp_path / "tum")
    before = input_hash(folder)
    assert before == input_hash(folder)
    (folder / "groundtruth.txt").write_text((folder / "groundtruth.txt").read_text().replace(" 0 ", " 1 ", 1))
    assert input_hash(folder) != before
    assert len(source_digest()) == 12


def test_a_part_of_a_suite_keeps_what_belongs_together() -> None:
    # Proves the choice of sequences, settings, seeds and frames, and the refusal of a name that is not there.
    part = restrict(tiny.suite(), ("hall",), ("bare",), seeds=1, first_seed=5, frames=2)
    (job,) = jobs_of(part, ())
    assert (job.name, job.spec["simulate"]["frames"], part.base) == ("hall.bare.5", 2, "bare")
    with raises("`settings`", "full, bare", "['E']"):
        restrict(tiny.suite(), settings=("E",))
    hall = restrict(load_suite("paper"), ("hall",))
    assert {job.setting for job in jobs_of(hall, ())} == {"full"}


def test_a_recording_is_found_below_any_data_folder(tmp_path: Path) -> None:
    # Proves that a benchmark's own folder may lie in between, that of two recordings one is taken, and that a missing
    # one is no error.
    tiny_sequences.tum(tmp_path / "b" / "tum" / "fr1" / "desk")
    folders = (tmp_path / "a", tmp_path / "b")
    assert find_sequences("fr1/desk", folders) == [(tmp_path / "b" / "tum" / "fr1" / "desk").resolve()]
    assert find_sequences("desk", folders) == [(tmp_path / "b" / "tum" / "fr1" / "desk").resolve()]
    assert find_sequences("xyz", folders) == []
    text = tiny.TEXT.replace('simulate = { scene = "hall", frames = 4 }', 'path = "desk"')
    jobs = jobs_of(read_suite(text, "t", "t"), folders)
    assert jobs[-1].present
    assert jobs_of(read_suite(text, "t", "t"), [tmp_path / "b" / "tum" / "fr1"])[-1].present
    tiny_sequences.tum(tmp_path / "b" / "older" / "desk")
    assert jobs_of(read_suite(text, "t", "t"), folders)[-1].spec["path"].endswith("older/desk")
