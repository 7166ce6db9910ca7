"""The journal: its content after any end of its process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dior_rt.batch.journal import NAME, Journal, Print, read_journal, read_records
from dior_rt.errors import InputError


def write_some(folder: Path) -> Print:
    (folder / "a.png").write_bytes(b"result")
    mark = Print.of(folder / "a.png")
    with Journal(folder) as journal:
        journal.begin("a.png")
        journal.begin("b.png")
        journal.done("a.png", mark, mark, mark, "settings")
        journal.failed("c.png", "it is damaged")
    return mark


def test_it_remembers_what_is_done_and_what_is_begun(tmp_path: Path) -> None:
    mark = write_some(tmp_path)
    records = read_journal(tmp_path)
    assert set(records) == {"a.png", "b.png"}
    assert records["a.png"].is_done and records["a.png"].output == mark
    assert records["a.png"].settings == "settings" and not records["b.png"].is_done


def test_cut_anywhere_it_can_be_read_and_continued(tmp_path: Path) -> None:
    mark = write_some(tmp_path)
    data = (tmp_path / NAME).read_bytes()
    for length in range(len(data)):
        (tmp_path / NAME).write_bytes(data[:length])
        with Journal(tmp_path) as journal:
            assert set(journal.records) <= {"a.png", "b.png"}
            journal.done("d.png", mark, mark, mark, "")
        assert read_journal(tmp_path)["d.png"].is_done
    assert read_records(b'\xff\xfe\n[]\n{"state": "done"}\n{"result": 1, "state": "done", "photo": 3}') == {}


def test_a_failure_does_not_forget_what_was_made_before(tmp_path: Path) -> None:
    write_some(tmp_path)
    with Journal(tmp_path) as journal:
        journal.failed("a.png", "the photo is gone")
    assert read_journal(tmp_path)["a.png"].is_done


def test_two_batches_cannot_write_into_one_folder(tmp_path: Path) -> None:
    with Journal(tmp_path), pytest.raises(InputError, match="Another batch"):
        Journal(tmp_path)
    Journal(tmp_path).close()


def test_without_a_journal_nothing_is_known(tmp_path: Path) -> None:
    assert read_journal(tmp_path) == {}
    with pytest.raises(InputError, match="Cannot write"):
        Journal(tmp_path / "none")


def test_a_print_notices_content_and_not_time(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"one")
    mark = Print.of(path)
    assert mark.fits(path)
    os.utime(path, (1, 1))
    assert mark.fits(path)
    path.write_bytes(b"two")
    assert not mark.fits(path)
    path.unlink()
    assert not mark.fits(path)
