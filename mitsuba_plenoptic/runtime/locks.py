"""Locks of outputs, so that no two processes compute the same one; imported by commands before their libraries."""

import contextlib
import os
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from hashlib import sha256
from pathlib import Path

from ..errors import InputError, refuse_if, warn

if sys.platform != "win32":
    import fcntl


@contextlib.contextmanager
def locked(path: Path, refusal: str | None) -> Iterator[None]:
    """Hold the lock file `path`; if another process holds it, refuse with a message, or wait without one.

    The system releases the lock when this process ends, however it ends. Windows and some network drives have no such
    lock; a warning tells of the latter. A lock that `claim` holds is not taken again.
    """
    if path in (_claims.get() or ()):
        yield
        return
    new = not path.parent.exists()
    mine = False
    while not mine:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("w")
        except OSError as error:
            raise InputError(f"{path.parent}: {error.strerror}") from error
        try:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if refusal else 0))
            # The process that had it may have removed the file between the two calls.
            mine = os.path.samestat(os.fstat(file.fileno()), path.stat())
        except (BlockingIOError, FileNotFoundError):
            pass
        except OSError as error:
            mine = True
            warn(f"{path.parent}: it cannot be locked: {error.strerror}")
        if not mine:
            file.close()
            refuse_if(refusal is not None, f"{refusal}; wait until it has ended")
    with file:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                if new:
                    path.parent.rmdir()


def lock_of(path: Path) -> Path:
    """Return the path of the lock file for a file, the same for all links to it."""
    path = Path(os.path.realpath(path))
    return path.with_name(f"{hidden(path)}.lock")


def hold(path: Path, lock: Path | None = None) -> contextlib.ExitStack:
    """Return what releases the lock of an output, which no other process is computing."""
    refusal = f"{path}: another process is computing this"
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(lock or lock_of(path), refusal))
            if sys.platform != "win32" and path.is_file() and path.stat().st_nlink > 1:
                # Hard links to a file have locks of their own.
                fcntl.flock(stack.enter_context(path.open("rb")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{refusal}; wait until it has ended") from None
        except (OSError, InputError) as error:
            # What cannot be locked cannot be written either, of which the writer tells.
            if isinstance(error, InputError) and error.__cause__ is None:
                raise
        return stack.pop_all()


_claims: ContextVar[dict[Path, contextlib.ExitStack] | None] = ContextVar("claims", default=None)
"""Lock files of the outputs of a command."""


@contextlib.contextmanager
def claiming() -> Iterator[None]:
    """Hold the locks of all outputs that are claimed in the context, as a command does, until it ends."""
    claims: dict[Path, contextlib.ExitStack] = {}
    before = _claims.set(claims)
    try:
        yield
    finally:
        _claims.reset(before)
        for stack in claims.values():
            stack.close()


def claim(path: Path, is_folder: bool = False) -> None:
    """Refuse an output that another process is computing; within `claiming`, keep it from others."""
    claims = _claims.get()
    lock = Path(os.path.realpath(path)) / ".lock" if is_folder else lock_of(path)
    if claims is None or lock in claims or any(folder / ".lock" in claims for folder in lock.parents):
        return
    if is_folder or lock.parent.is_dir():
        claims[lock] = hold(path, lock)


def hidden(path: Path) -> str:
    """Return what names of hidden files next to a file begin with, short enough for what is added."""
    return f".{path.name if len(os.fsencode(path.name)) < 230 else sha256(os.fsencode(path.name)).hexdigest()}"
