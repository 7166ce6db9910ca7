"""The plan: names of results, and the photos that need work."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.batch.find import find_photos
from dior_rt.batch.journal import Print, Record
from dior_rt.batch.plan import Plan, hash_settings, make_plan
from dior_rt.errors import InputError

OUT = Path("out")


@pytest.fixture
def plan(make):
    """Return a plan for the folder `in`."""

    def call(records=(), settings: str = "s", overwrite: bool = False) -> Plan:
        return make_plan(find_photos(["in"]), None, OUT, "png", dict(records), settings, overwrite)

    make("in/a.jpg", "in/a.json")
    return call


def record(settings: str = "s") -> dict[str, Record]:
    """Return the journal's record of a.png once it is done."""
    prints = (Print.of(Path(name)) for name in ("in/a.jpg", "in/a.json", "out/a.png"))
    return {"a.png": Record(*prints, settings=settings)}


def counts(plan: Plan) -> tuple[int, int, int]:
    return len(plan.jobs), len(plan.done), len(plan.refused)


def test_new_work_is_done_and_finished_work_is_not(plan, make) -> None:
    assert counts(plan()) == (1, 0, 0)
    make("out/a.png")
    assert counts(plan(record())) == (0, 1, 0)
    assert counts(plan(record(), overwrite=True)) == (0, 1, 0)


@pytest.mark.parametrize("changed", ["in/a.jpg", "in/a.json"])
def test_changed_inputs_and_settings_are_done_again(plan, make, changed: str) -> None:
    make("out/a.png")
    before = record()
    assert counts(plan(before, settings="other")) == (1, 0, 0)
    Path(changed).write_text("changed")
    assert counts(plan(before)) == (1, 0, 0)


def test_a_result_that_is_gone_is_made_again(plan, make) -> None:
    make("out/a.png")
    before = record()
    Path("out/a.png").unlink()
    assert counts(plan(before)) == (1, 0, 0)


def test_what_a_killed_batch_began_may_be_replaced(plan, make) -> None:
    make("out/a.png")
    assert counts(plan({"a.png": Record()})) == (1, 0, 0)


def test_the_files_of_others_are_kept(plan, make) -> None:
    make("out/a.png")
    (refused,) = plan().refused
    assert "there already" in refused.reason and counts(plan(overwrite=True)) == (1, 0, 0)
    before = record()
    Path("out/a.png").write_text("retouched")
    (refused,) = plan(before).refused
    assert "changed after" in refused.reason and counts(plan(before, overwrite=True)) == (1, 0, 0)


def test_names_of_results(plan, make) -> None:
    make("in/a.cr2", "in/sub/a.jpg")
    jobs = plan().jobs
    assert {job.name for job in jobs} == {"a.cr2.png", "a.jpg.png"}
    assert [refused.name for refused in plan().refused] == ["sub/a.png"]  # it has no strokes


def test_two_photos_for_one_result_are_refused(make) -> None:
    make("x/a.jpg", "y/a.jpg")
    with pytest.raises(InputError, match="the same result"):
        make_plan(find_photos(["x", "y"]), Path("s.json"), OUT, "png", {}, "", False)


def test_settings_have_one_hash() -> None:
    assert hash_settings("b", {"seed": 1, "steps": None}) == hash_settings("b", {"steps": None, "seed": 1})
    assert (
        hash_settings("b", {"seed": 1}) != hash_settings("b", {"seed": 2}) != hash_settings("c", {"seed": 2})
    )
