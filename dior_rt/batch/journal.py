"""The journal of a batch: what was done, so that it is not done again, and what was begun.

A file of JSON lines in the folder of the results, one line an event:

    {"state": "begun", "result": "a.png"}
    {"state": "done", "result": "a.png", "settings": HASH, "photo": PRINT, "strokes": ..., "output": ...}
    {"state": "failed", "result": "a.png", "reason": "..."}

PRINT is [bytes, mtime in ns, sha256]. A result is written whole or not at all, and its name is "begun" before
that; so a process that is killed at any moment leaves a state that the next one can go on from: what is begun
and not done is done again, and replaces what the killed process may have written. What failed stays as it
was.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Final

from dior_rt.errors import InputError
from dior_rt.files import reason

NAME: Final = ".dior-batch.jsonl"


@dataclass(frozen=True)
class Print:
    """The data that shows whether a file has changed."""

    size: int
    mtime_ns: int
    sha256: str

    @classmethod
    def of(cls, path: Path) -> Print:
        """Return the print of a file in its present state. Raises OSError."""
        with path.open("rb") as file:
            stat = os.fstat(file.fileno())
            return cls(stat.st_size, stat.st_mtime_ns, hashlib.file_digest(file, "sha256").hexdigest())

    def fits(self, path: Path) -> bool:
        """Return whether the file still has this content.

        The file is read only where its time has changed.
        """
        try:
            stat = path.stat()
            if stat.st_size != self.size:
                return False
            return stat.st_mtime_ns == self.mtime_ns or Print.of(path).sha256 == self.sha256
        except OSError:
            return False


@dataclass(frozen=True)
class Record:
    """The latest record of a result: prints and settings once it is done, nothing if it was only begun."""

    photo: Print | None = None
    strokes: Print | None = None
    output: Print | None = None
    settings: str = ""

    @property
    def is_done(self) -> bool:
        return self.output is not None


class Journal:
    """The journal in a folder, held by one process at a time. Safe to use from several threads.

    records: the records by the results' names, as they were when the journal was opened.
    """

    def __init__(self, folder: Path) -> None:
        """Open or begin the journal. Raises InputError where it cannot be written, or another batch holds
        it.
        """
        self._path = folder / NAME
        self._mutex = Lock()
        try:
            self._file = self._path.open("a+b")
        except OSError as error:
            raise InputError(f"Cannot write {self._path}: {reason(error)}.") from error
        if not _hold(self._file.fileno()):
            self._file.close()
            raise InputError(f"Another batch is writing into {folder}; wait for it, or name another folder.")
        self._file.seek(0)
        data = self._file.read()
        self.records = read_records(data)
        if data and not data.endswith(b"\n"):  # the last line was cut off
            self._append(b"\n")

    def begin(self, result: str) -> None:
        """Record that the result may be written from now on."""
        self._write({"state": "begun", "result": result})

    def done(self, result: str, photo: Print, strokes: Print, output: Print, settings: str) -> None:
        """Record that the result is written."""
        prints = {name: _pack(p) for name, p in (("photo", photo), ("strokes", strokes), ("output", output))}
        self._write({"state": "done", "result": result, **prints, "settings": settings})

    def failed(self, result: str, why: str) -> None:
        """Record why there is no result."""
        self._write({"state": "failed", "result": result, "reason": why})

    def close(self) -> None:
        """Release the journal to other processes."""
        self._file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self, event: Mapping[str, Any]) -> None:
        self._append(json.dumps(event).encode() + b"\n")

    def _append(self, line: bytes) -> None:
        with self._mutex:
            try:
                self._file.write(line)
                self._file.flush()
            except OSError as error:
                raise InputError(f"Cannot write {self._path}: {reason(error)}.") from error


def read_journal(folder: Path) -> dict[str, Record]:
    """Return the records in a folder's journal, by result, without locking it. Empty where there is none."""
    try:
        return read_records((folder / NAME).read_bytes())
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"Cannot read {folder / NAME}: {reason(error)}.") from error


def read_records(data: bytes) -> dict[str, Record]:
    """Return the records by result. A damaged or cut line is ignored."""
    records: dict[str, Record] = {}
    for line in data.splitlines():
        try:
            event = json.loads(line)
            result, state = str(event["result"]), event["state"]
            if state == "begun":
                records[result] = Record()
            elif state == "done":
                prints = {name: Print(*event[name]) for name in ("photo", "strokes", "output")}
                records[result] = Record(**prints, settings=event["settings"])
        except (ValueError, LookupError, TypeError):
            continue
    return records


def _pack(mark: Print) -> list[Any]:
    return [mark.size, mark.mtime_ns, mark.sha256]


def _hold(descriptor: int) -> bool:
    """Lock the file until it is closed or the process ends. Returns False where another process holds it."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            os.lseek(descriptor, 1 << 40, os.SEEK_SET)  # beyond the lines, so that others may read them
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
