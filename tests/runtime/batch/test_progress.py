"""The output of a batch about its progress."""

from __future__ import annotations

from pathlib import Path

from dior_rt.batch.plan import Job
from dior_rt.batch.progress import Progress, duration
from dior_rt.batch.work import Outcome

JOB = Job(Path("a.jpg"), Path("a.json"), Path("out/a.png"), "a.png")


def test_rate_and_time_left(capsys) -> None:
    now = iter([0.0, *[20.0] * 20])
    progress = Progress(10, 3, clock=lambda: next(now))
    progress.note(Outcome(JOB))
    progress.note(Outcome(JOB, "it is damaged"))
    assert progress.line() == "2 of 10, 6.0 photos a minute, 1 min left"
    progress.finish()
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "dior-rt: a.jpg: it is damaged"
    assert said[-1].startswith("dior-rt: 1 relit, 3 done before, 1 failed, in 20 s")


def test_quiet_says_failures_alone(capsys) -> None:
    progress = Progress(2, 0, quiet=True)
    progress.note(Outcome(JOB, notices=("It has more than one frame.",)))
    progress.fail("b.jpg", "there is no such file")
    progress.finish()
    assert capsys.readouterr().err == "dior-rt: b.jpg: there is no such file\n"


def test_durations() -> None:
    assert [duration(s) for s in (8.2, 75, 7500)] == ["8 s", "1 min", "2 h 5 min"]
